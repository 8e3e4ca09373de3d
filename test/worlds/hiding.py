"""
Sessions with something hidden in them.

As large as a search could just detect, or any multiple of it; recorded through a bag.
"""

import tempfile
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.references.turntable.selection.investigation import investigate
from imu_calibration.references.turntable.selection.window_evidence import EVIDENCE_FOLDS
from imu_calibration.selection.search import FAMILY_WISE, MIN_GAIN_NATS, PENALTY, least_angle

from worlds import physics
from worlds.physics_draw import EFFECTS, POSITIVE, draw_value, generator

NOT_SIZED = {'earth_rate'}
"""The Earth turns as fast as it does."""
LEAST_CLIPPED_SHARE = 2e-4
"""Smallest detectable share of clipped samples: about six in five minutes at 100 Hz."""


@dataclass(frozen=True, eq=False)
class Recording:
    """What the searcher gets, and the truth."""

    table: Table
    windows: list
    truth: dict

    @property
    def model(self):
        """The baseline: bias and matrix."""
        return SensorModel(joint_names=self.table.joint_names)


def record(seed, hidden=None, noise='white', through_bag=True, **options):
    """
    Return the Recording of a session made by physics (`physics.make_session`).

    The session is written to a bag and read again.
    """
    kind, _, grade = noise.partition('@')
    session = physics.make_session(
        seed, hidden, kind, **({'grade': grade} if grade else {}) | options
    )
    table = Table.from_mapping(session.table)
    gatherer = MotionGatherer(table)
    windows = []
    if through_bag:
        from msg_adapters.bag import open_recording

        with tempfile.TemporaryDirectory() as folder:
            physics.write_bag(session, Path(folder) / 'bag')
            with open_recording(Path(folder) / 'bag') as bag:
                for block in bag.blocks():
                    windows += gatherer.push(block)
    else:
        windows += gatherer.push(session.block)
    windows += gatherer.finish()
    return Recording(table, windows, session.truth['values'])


def options_of(*effects):
    """Return the options of sessions that hide effects."""
    wanted = {'_hysteresis': {'temperature': 'cycle'}, '_rectification': {'machine': True}}
    return {
        key: value
        for ending, options in wanted.items()
        if any(name.endswith(ending) for name in effects)
        for key, value in options.items()
    }


@lru_cache(maxsize=8)
def _empty(seed, noise, options):
    return Sizes(record(seed, None, noise, **dict(options)))


def sizes_for(seed, noise, effects, options):
    """
    Return the Sizes in the session of a seed that hides nothing.

    It is of the kind that shows the effects.
    """
    return _empty(seed, noise, tuple(sorted({**options, **options_of(*effects)}.items())))


def pattern(effect, seed, n_joints=3):
    """Return a random value of an effect of magnitude one, and for a warm-up its time constant."""
    return np.atleast_1d(
        np.asarray(
            draw_value(effect, 1.0, n_joints, generator(seed, 'pattern of ' + effect)), float
        )
    )


@lru_cache(maxsize=None)
def threshold_noncentrality(n_parameters, n_questions):
    """
    Return the noncentrality at which an effect passes the rules of the search half of the time.

    Its threshold, its penalties, its held-out windows.
    """
    return brentq(
        lambda value: passing(value, n_parameters, n_questions).mean() - 0.5, 1.0, 1000.0, xtol=0.1
    )


def passing(noncentrality, n_parameters, n_questions, draws=4000):
    """
    Return which draws of an effect pass the rules of the search, shape (draws,).

    Where the noise is Gaussian and each fold knows as much as the others.

    The chi-square test over all questions, the gain of held-out log likelihood with its least value
    and its penalty for each parameter, and the fall of the residual from window to window in the
    unit of the sensor, for sure (95 %). Shares of a rest and halves are no part of it.
    """
    noise = np.random.default_rng(1).normal(size=(draws, EVIDENCE_FOLDS, n_parameters)) * np.sqrt(
        EVIDENCE_FOLDS
    )
    parts = noise + np.sqrt(noncentrality) * np.eye(1, n_parameters)[0]
    whole = parts.mean(axis=1)
    others = (EVIDENCE_FOLDS * whole[:, None] - parts) / (EVIDENCE_FOLDS - 1)
    gain = 0.5 * ((parts**2).sum(axis=2) - ((parts - others) ** 2).sum(axis=2)).mean(axis=1)
    fall = (whole**2).sum(axis=1)
    return (
        (chi2.sf(fall, n_parameters) * n_questions < FAMILY_WISE)
        & (gain > max(MIN_GAIN_NATS, PENALTY * n_parameters))
        & (gain > 1.96 * np.sqrt(fall))
    )


class Sizes:
    """
    Smallest detectable sizes.

    The search finds half of them, the baseline projected out, from the session that hides nothing.
    """

    def __init__(self, recording):
        self.recording, start = recording, time.process_time()
        self.found = investigate(recording.windows, recording.table, recording.model)
        self.seconds, self.problem = time.process_time() - start, self.found.problem
        evidence, used = self.problem.evidence, np.array(self.problem.search.baseline)
        prior = np.diag(1 / self.problem.space.prior_sd[used] ** 2)
        normal = evidence.total[:-1, :-1]
        self.information = normal - normal[:, used] @ np.linalg.solve(
            normal[np.ix_(used, used)] + prior, normal[used]
        )

    def hidden(self, effect, seed, factor, component=None):
        """
        Return what to hide: of random shape, `factor` times as large as detectable.

        None where nature gives the size. With a component all others are zero.
        """
        if effect in NOT_SIZED:
            return None
        if effect.endswith('_saturation'):
            return factor * LEAST_CLIPPED_SHARE
        value = pattern(effect, seed)
        if component is not None:
            # A time constant behind the amplitudes stays as it is.
            number = np.arange(value.size).reshape(value.shape)
            amplitudes = self._question(effect, value)[0].effect.n_amplitudes
            value = np.where((number == component) | (number >= amplitudes), value, 0.0)
        direction, n_parameters = self._direction(effect, value)
        strength = direction @ self.information @ direction
        seen = np.sqrt(
            threshold_noncentrality(n_parameters, len(self.problem.questions)) / strength
        )
        read = least_angle(
            self._question(effect, value)[0].effect, self.problem.search.encoder_step
        ) / np.max(np.abs(value))
        size = factor * max(seen, read)
        if effect.endswith('_bias_drift'):
            return np.append(size * value[:3], value[3])
        if effect.endswith(POSITIVE):
            return float(abs(size * value[0]))
        return (size * value).reshape(
            np.shape(draw_value(effect, 1.0, 3, generator(seed, effect))) or (1,)
        )

    def beside(self, hidden):
        """
        Return how many times the smallest detectable size is left of each hidden effect.

        It is left where the other one of the two hidden effects may have any value, and there is no
        limit for limits.
        """
        sized = {
            name: self._direction(name, np.ravel(value))
            for name, value in hidden.items()
            if not name.endswith('_saturation') and value is not None
        }
        left = {name: np.inf for name in hidden}
        for name, (direction, n_parameters) in sized.items():
            others = [
                k
                for other in sized
                if other != name
                for q in self.problem.questions
                if q.name == other
                for k in q.parameters
            ]
            known = self.information[np.ix_(others, others)] + np.diag(
                1 / self.problem.space.prior_sd[others] ** 2
            )
            shared = self.information[others] @ direction
            strength = direction @ self.information @ direction - shared @ np.linalg.solve(
                known, shared
            )
            left[name] = float(
                np.sqrt(
                    max(strength, 0.0)
                    / threshold_noncentrality(n_parameters, len(self.problem.questions))
                )
            )
        return left

    def _direction(self, effect, value):
        question, shape = self._question(effect, value)
        direction = np.zeros(self.problem.space.size)
        direction[list(question.parameters)] = shape
        return direction, value.size

    def _question(self, effect, value):
        asked = [q for q in self.problem.questions if q.name == effect]
        if not effect.endswith('_bias_drift'):
            return asked[0], value.ravel()
        nearest = int(np.argmin(np.abs(np.log(self.problem.constants / value[3]))))
        return asked[nearest], value[:3]


def all_effects():
    """Return the names of all effects that can be hidden."""
    return tuple(EFFECTS)

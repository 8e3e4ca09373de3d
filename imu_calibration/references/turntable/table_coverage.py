"""Coverage of directions by a calibration on a table, and the next motion of the table."""

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from imu_calibration.calibration.coverage import Coverage, Step, is_done, sd_excess, share_gained
from imu_calibration.effects.base import Role
from imu_calibration.estimation.prior import GAUGE_SD, make_prior
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.solution import LACKING, REMEDY_KEYS
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.references.turntable.needs import possible_motions
from imu_calibration.references.turntable.observability import MotionInformation
from imu_calibration.references.turntable.standard_motions import MOTIONS, REST_WITH_UP, Motion
from imu_calibration.references.turntable.window_observations import TableResult, WindowObservations

MAX_MOTIONS_AHEAD, MIN_MOTION_GAIN = 20, 0.01
"""
Most standard motions that are planned ahead, and the least share of the excess that the best one
must remove.
"""


GAUGE_SHOWN = 1e-7
"""m; how exactly the origin is the mean of the sensitive points here."""


MAX_MOTION_SECONDS = 300.0
"""s; longer standard motions gain too little per second, and their computation is slow."""


def table_coverage(result: TableResult, frame_id: str = '') -> Coverage:
    """
    Return the Coverage of a calibration on a table.

    Each cell is a rest of five seconds with that direction up.

    The next step is the standard motion with the largest gain per second; `seconds` is the time of
    it and of all later ones needed. If these do not suffice, or no motion determines what is
    missing, it is what the solution proposes for the parameter with the largest sd in tolerances.

    Parameters
    ----------
    result : TableResult
    frame_id : str

    """
    solution = result.solution
    requested = result.calibration.requested
    # No motion determines a parameter with another remedy.
    wanted = np.array(
        [
            name in requested and not _has_remedy(result, name)
            for name in result.calibration.param_names
        ]
    )
    prior = make_prior(solution.model)
    gauge = GAUGE_SD / GAUGE_SHOWN * prior.gauge  # as exact as sums of squares bear it
    base = solution.information + np.diag(1 / prior.sd**2) + gauge.T @ gauge

    def expected_sd(information: np.ndarray) -> np.ndarray:
        return np.sqrt(np.clip(np.diag(inverse_normal(information)), 0, None))

    # unmodelled effects widen the standard deviations beyond those of the information matrix; the
    # same factor is predicted
    wider = np.maximum(result.calibration.sd / np.maximum(expected_sd(base), 1e-300), 1.0)

    def left(information: np.ndarray) -> np.ndarray:
        return sd_excess((wider * expected_sd(information))[wanted], result.tolerances[wanted])

    added = MotionInformation(
        solution.model, solution.values, solution.noise, result.gravity
    ).added_by
    after = np.array([left(base + added(rest)) for rest in REST_WITH_UP])
    worth = share_gained(left(base), after)
    possible = possible_motions(cast(WindowObservations, result.data).table)
    motions = []
    for motion in MOTIONS if possible is None else possible:
        if motion.seconds < MAX_MOTION_SECONDS:
            motions.append(motion)
    first, seconds = _foretold(base, left, added, motions)
    step = _next_on_table(result) if first is None else _step(first.text)
    errors = result.window_errors()
    # Without an accelerometer no directions of gravity are shown.
    force = errors.true.get('accelerometer', np.zeros((len(errors.kind), 3)))
    force = force[(np.asarray(errors.kind) == 'static') & force.any(axis=1)]
    return Coverage(
        worth, unit_rows(force), None, step, seconds, is_done(result), _arms(result), frame_id
    )


def _has_remedy(result: TableResult, name: str) -> bool:
    """Return whether a parameter needs something that is no motion."""
    return name in result.needed and result.needed[name][0] in REMEDY_KEYS


def _foretold(
    information: np.ndarray,
    left: Callable[[np.ndarray], np.ndarray],
    added: Callable[[Motion], np.ndarray],
    motions: Sequence[Motion],
) -> tuple[Motion | None, float]:
    """
    Return (first motion, seconds of all) of the motions that remove the excess.

    (None, NaN) if these motions do not suffice.
    """
    first = None
    seconds = 0.0
    missing = left(information)
    more = [added(motion) for motion in motions] if missing else []
    for _ in range(MAX_MOTIONS_AHEAD):
        if not missing:
            return first, seconds
        remaining = [left(information + each) for each in more]
        best = max(
            range(len(motions)),
            key=lambda k: (missing - remaining[k]) / motions[k].seconds,
            default=None,
        )
        if best is None or missing - remaining[best] < MIN_MOTION_GAIN * missing:
            break
        first = first or motions[best]
        seconds = seconds + motions[best].seconds
        information = information + more[best]
        missing = remaining[best]
    return None, float('nan')


def _next_on_table(result: TableResult) -> Step:
    """Return the motion that serves the parameter worst off."""
    requested = result.calibration.requested
    needed = {name: need for name, need in result.needed.items() if name in requested}
    if not needed:
        return Step('')
    names = list(result.calibration.param_names)
    worst = max(
        needed,
        key=lambda name: (
            result.calibration.sd[names.index(name)] / result.tolerances[names.index(name)]
        ),
    )
    return _step(needed[worst][0])


def _step(text: str) -> Step:
    motion = next((motion for motion in MOTIONS if motion.text == text), None)
    return Step(
        text, axis=None if motion is None or motion.axis is None else np.array(motion.axis, float)
    )


def _arms(result: TableResult) -> np.ndarray | None:
    """Return the sensitive points, None while one of them is not determined."""
    effect = result.model.find('accelerometer', Role.ARMS)
    if effect is None:
        return None
    part = result.model.slices[effect.key]
    known = not set(LACKING) & set(result.calibration.status[part])
    return result.calibration.values[part].reshape(3, 3) if known else None

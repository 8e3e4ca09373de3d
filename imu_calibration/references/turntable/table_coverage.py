"""Coverage of directions by a calibration on a table, and the next motion of the table."""

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from imu_calibration.calibration.coverage import Coverage, Step, is_done, sd_excess, share_gained
from imu_calibration.effects.base import Role
from imu_calibration.estimation.prior import GAUGE_SD, make_prior
from imu_calibration.estimation.solution import LACKING, REMEDY_KEYS
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.references.turntable.needs import possible_motions
from imu_calibration.references.turntable.observability import (
    MotionInformation,
    sd_of_information,
)
from imu_calibration.references.turntable.standard_motions import MOTIONS, REST_WITH_UP, Motion
from imu_calibration.references.turntable.window_observations import TableResult, WindowObservations

MAX_MOTIONS_AHEAD, MIN_MOTION_GAIN = 20, 0.01
"""
Most standard motions that are planned ahead, and the least share of the excess that the best one
must remove.
"""


GAUGE_SHOWN = 1e-7
"""
Standard deviation of the origin about the mean of the sensitive points here, m. That of the
estimate, `GAUGE_SD`, is too small for sums of squares in double precision.
"""


MAX_MOTION_SECONDS = 300.0
"""s; longer standard motions gain too little per second, and their computation is slow."""


def table_coverage(result: TableResult, frame_id: str = '') -> Coverage:
    """
    Return the Coverage of a calibration on a table.

    The worth of a direction is the gain of a rest of five seconds with it up. The next step is the
    standard motion with the largest gain per second; `seconds` is the time of it and of all later
    motions until the parameters are determined. If standard motions do not suffice, the next step
    is the need of the parameter with the largest sd in tolerances.

    Parameters
    ----------
    result : TableResult
    frame_id : str

    """
    # 1. Parameters that motions can determine: not the ones with another remedy.
    solution = result.solution
    requested = result.calibration.requested
    wanted = np.zeros(len(solution.values), bool)
    for index, name in enumerate(result.calibration.param_names):
        need, _ = result.needed.get(name, ('', 0.0))
        wanted[index] = name in requested and need not in REMEDY_KEYS

    # 2. Information of the recording and of the prior, with a gauge that double precision allows.
    #    Unmodelled effects make the standard deviations larger than it predicts; the same factor is
    #    assumed after further motions.
    prior = make_prior(solution.model)
    gauge = GAUGE_SD / GAUGE_SHOWN * prior.gauge
    base = solution.information + np.diag(1 / prior.sd**2) + gauge.T @ gauge
    factor = np.maximum(result.calibration.sd / sd_of_information(base), 1.0)

    def excess(information: np.ndarray) -> np.ndarray:
        """Return the excess of the standard deviations over the tolerances (`sd_excess`)."""
        return sd_excess(
            (factor * sd_of_information(information))[wanted], result.tolerances[wanted]
        )

    # 3. Gain of a rest with each direction up.
    added = MotionInformation(
        solution.model, solution.values, solution.noise, result.gravity
    ).added_by
    after = np.array([excess(base + added(rest)) for rest in REST_WITH_UP])
    worth = share_gained(excess(base), after)

    # 4. The next motion, of those that the table can do.
    possible = possible_motions(cast(WindowObservations, result.data).table)
    if possible is None:
        possible = MOTIONS
    motions = [motion for motion in possible if motion.seconds < MAX_MOTION_SECONDS]
    first, seconds = _plan_ahead(base, excess, added, motions)
    step = _next_on_table(result) if first is None else _step(first.text)

    # 5. Directions of gravity in the rests; none are shown without an accelerometer.
    errors = result.window_errors()
    force = errors.true.get('accelerometer', np.zeros((len(errors.kind), 3)))
    force = force[(np.asarray(errors.kind) == 'static') & force.any(axis=1)]
    return Coverage(
        worth=worth,
        seen=unit_rows(force),
        up=None,
        next=step,
        seconds=seconds,
        done=is_done(result),
        arms=_arms(result),
        frame_id=frame_id,
    )


def _plan_ahead(
    information: np.ndarray,
    excess: Callable[[np.ndarray], np.ndarray],
    added: Callable[[Motion], np.ndarray],
    motions: Sequence[Motion],
) -> tuple[Motion | None, float]:
    """
    Return (first motion, seconds of all motions) of a sequence that removes the excess.

    Greedy: each motion has the largest reduction of the excess per second. (None, NaN) if the
    motions do not suffice.

    Parameters
    ----------
    information : array, shape (n_params, n_params)
        Of the recording and the prior.
    excess : callable
        Excess of the standard deviations that an information matrix gives.
    added : callable
        Information of a motion.
    motions : sequence of Motion

    """
    first = None
    seconds = 0.0
    current = excess(information)
    added_by = [added(motion) for motion in motions] if current else []
    for _ in range(MAX_MOTIONS_AHEAD):
        if not current:
            return first, seconds
        after = [excess(information + of_motion) for of_motion in added_by]
        best = max(
            range(len(motions)),
            key=lambda k: (current - after[k]) / motions[k].seconds,
            default=None,
        )
        if best is None or current - after[best] < MIN_MOTION_GAIN * current:
            break
        first = first or motions[best]
        seconds = seconds + motions[best].seconds
        information = information + added_by[best]
        current = after[best]
    return None, float('nan')


def _next_on_table(result: TableResult) -> Step:
    """Return the need of the undetermined parameter with the largest sd in tolerances."""
    requested = result.calibration.requested
    needed = {name: need for name, need in result.needed.items() if name in requested}
    if not needed:
        return Step('')
    in_tolerances = result.calibration.sd / result.tolerances
    sd_of = dict(zip(result.calibration.param_names, in_tolerances))
    worst = max(needed, key=lambda name: sd_of[name])
    text, _ = needed[worst]
    return _step(text)


def _step(text: str) -> Step:
    """Return the step with a text, and with the axis of the standard motion of that text."""
    for motion in MOTIONS:
        if motion.text == text and motion.axis is not None:
            return Step(text, axis=np.array(motion.axis, float))
    return Step(text)


def _arms(result: TableResult) -> np.ndarray | None:
    """Return the sensitive points, None while one of them is not determined."""
    effect = result.model.find('accelerometer', Role.ARMS)
    if effect is None:
        return None
    part = result.model.slices[effect.key]
    if set(LACKING) & set(result.calibration.status[part]):
        return None
    return result.calibration.values[part].reshape(3, 3)

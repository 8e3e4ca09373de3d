"""
Calibration without a table.

Gravity is the reference, poses held still and the turns between them are the data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from imu_calibration.core.errors import InputError, NotObservableError
from imu_calibration.core.progress import report
from imu_calibration.core.samples import ImuSamples
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.sensor_model import BASE, G_SENSITIVE, SensorModel
from imu_calibration.estimation.solution import (
    DRIFT,
    GRAVITY,
    PLACEMENTS,
    SAMPLE_NOISE,
    Solution,
    Status,
    bounded_by_prior,
    of_fit,
    statuses,
    tolerances_of,
    total,
    with_term,
)
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.preprocessing.rest_detection import find_still
from imu_calibration.references.gravity.bias_movement import (
    bias_movements,
    with_movement,
    without_movement,
)
from imu_calibration.references.gravity.equations import (
    COMPONENTS,
    GravityRows,
    Poses,
    State,
    TurnData,
)
from imu_calibration.references.gravity.g_sensitivity import (
    NO_EVIDENCE,
    g_sensitivity_evidence,
    shown,
)
from imu_calibration.references.gravity.hand_parameters import (
    CROSS_TERMS,
    HandModel,
    HandOptions,
    KnownTurn,
)
from imu_calibration.references.gravity.moved_attitudes import require_no_sway
from imu_calibration.references.gravity.placements import covariance_of_placements, excess
from imu_calibration.references.gravity.pose_solver import (
    CONTRADICTED_TURNS,
    first_state,
    possible_turns,
    solve_joint,
    without_outlying_poses,
)
from imu_calibration.references.gravity.poses import (
    average_poses,
    collect_turns,
    distinct_attitudes,
    full_scale_factor,
    known_turn_data,
    missed_angle,
    noise_statistics,
    sample_times,
)
from imu_calibration.references.gravity.tested_directions import (
    TESTING_TURNS,
    contradicted_by_turns,
    directions,
    fit_placements,
    off_axis_lacking,
    placements_demand,
    turns_between,
)
from imu_calibration.references.rows.row_estimate import RowEstimate
from imu_calibration.selection.questions import at_time_constants

GAUGE = {'origin': 'not_needed', 'axes': 'accelerometer_lower_triangular'}
"""x along the accelerometer's x input axis, y in the plane of its x and y input axes."""
MIN_ATTITUDES = 4
"""With fewer attitudes even the accelerometer's biases are determined by the prior."""
CROSS_TERM_RATIO = 1.96**2
"""
Likelihood ratio above which the data contradict a cross term of zero: 95 % of chi-square with one
degree of freedom.
"""
MAX_HAND_PASSES = 4
"""
Largest number of solutions, when the columns of a warm-up are recomputed or poses and turns are
excluded.
"""
MAX_SETTLED_CHANGE = 0.03
"""Relative change of a time constant below which its columns are not recomputed."""
ABSENT_SD = 1.0
"""
Standard deviation of the means of an absent sensor, SI: without weight against any reading. Its
parameters are held, so that it enters no result.
"""
POSES_FULL = 12
"""
The nine accelerometer parameters need one equation per attitude; further ones determine the scatter
of the poses.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class HandCalibration(Solution):
    """
    Solution of both sensors' equations with gravity as the reference.

    The equation is ``measured = bias + matrix @ true (+ further effects)``.
    """

    judged_without = (GRAVITY,)

    hand_model: HandModel
    """The model with gravity; its effects are those of `model`."""
    tolerances: np.ndarray
    """Sufficient standard deviation, shape (n,)."""
    statistics: dict
    """Counts, noise, scatter, chi-square: plain numbers."""
    poses: Poses
    """The poses that were used."""
    state: State
    """Directions and drifts of the poses, and the parameters."""
    used_poses: Poses
    """The poses as weighted: excluded ones with negligible weight, a drifting bias at its mean."""
    used_turns: list
    """`TurnData` without excluded turns."""

    @property
    def gravity(self) -> float:
        """Reference, m/s^2."""
        return self.hand_model.gravity

    @property
    def prior_mean(self) -> np.ndarray:
        """Values before any data, shape (n,)."""
        return self.hand_model.nominal

    @property
    def replacement_limit(self) -> np.ndarray:
        """
        Likelihood ratio for cross terms, otherwise the smallest expected error.

        The cross terms are terms of the accelerometer.

        Near the six faces the poses determine cross terms only through small tilts.
        """
        return np.where(np.isin(self.param_names, CROSS_TERMS), CROSS_TERM_RATIO, 1.0)

    @property
    def statuses(self) -> tuple[Status, ...]:
        """
        Status of each parameter relative to gravity as used.

        Without its uncertainty (`common_scale`).
        """
        return statuses(self.judged_sd, self.held, self.tolerances)

    @property
    def accelerometer(self) -> tuple[np.ndarray, np.ndarray]:
        """(bias, matrix) of the accelerometer."""
        return self.hand_model.linear(self.values)[:2]

    @property
    def gyroscope(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        (bias, matrix, g-sensitivity) of the gyroscope; zeros where the model has no g-sensitivity.
        """
        effect = self.model.find('gyroscope', Role.CROSS)
        response = (
            np.zeros((3, 3))
            if effect is None
            else self.values[self.model.slices[effect.key]].reshape(3, 3)
        )
        return *self.hand_model.linear(self.values)[2:], response

    def compensate(
        self,
        force: np.ndarray,
        rate: np.ndarray,
        time: np.ndarray | None = None,
        *,
        temperature_c: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return true specific force and rate for readings of shape (n, 3).

        The readings are at `time` s and `temperature_c` for effects that need them.
        """
        return self.hand_model.compensate(
            self.values, force, rate, time=time, temperature_c=temperature_c
        )

    def norm_residuals(self) -> np.ndarray:
        """Return ``|compensated force| - gravity`` of the poses, shape (k,)."""
        poses = self.poses
        return self.hand_model.norm_rows(self.values, poses.force, **poses.conditions)[0]

    def rate_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the residual rates of the poses, shape (k, 3), and their columns, shape (k, 3, n).
        """
        return self.hand_model.rate_rows(
            self.values, self.gravity * self.state.up, self.poses.rate, **self.poses.conditions
        )


def calibrate_by_hand(
    imu: ImuSamples,
    options: HandOptions = HandOptions(),
    stills: Sequence | None = None,
    *,
    known_turns: Sequence[KnownTurn] = (),
    temperature_c: np.ndarray | None = None,
) -> HandCalibration:
    """
    Calibrate accelerometer and gyroscope from poses held still and the turns between them.

    One weighted least-squares system: ``force_k = bias + matrix @ gravity u_k`` in pose k, ``C u_i
    = u_j`` for the turn from pose i to j with C integrated from the rates, ``rate_k = bias +
    drift_k`` at rest. Scatter beyond the noise of poses, drifts and turns is estimated as well. A
    wrong gravity is equivalent to a common scale of the accelerometer.

    Parameters
    ----------
    imu : ImuSamples
        Stamps must not go backwards.
    options : HandOptions
        Reference, effects, tolerances.
    stills : sequence of slices or (start, stop), optional
        Intervals at rest; found by `find_still` when not given.
    known_turns : sequence of KnownTurn
        Full turns by hand, in addition to gravity as reference.
    temperature_c : array, optional
        Temperature at the samples, degrees Celsius, shape (n,).

    Returns
    -------
    HandCalibration

    Raises
    ------
    NotObservableError
        With fewer than four different attitudes.

    """
    data = gather_by_hand(imu, stills, known_turns=known_turns, temperature_c=temperature_c)
    return solve_by_hand(data, options)


@dataclass(frozen=True, eq=False)
class HandData:
    """Poses and turns of a recording without a table."""

    poses: Poses
    """Means over the intervals at rest."""
    turns: list
    """`TurnData` between consecutive poses, then those of known angle."""
    statistics: dict
    """Attitudes, excluded turns, noise and period of the samples."""
    absent: tuple[str, ...] = ()
    """Sensors without readings."""


def gather_by_hand(
    imu: ImuSamples,
    stills: Sequence | None = None,
    *,
    known_turns: Sequence[KnownTurn] = (),
    temperature_c: np.ndarray | None = None,
) -> HandData:
    """Return the `HandData` of samples; arguments and errors as in `calibrate_by_hand`."""
    time = sample_times(imu)
    poses = average_poses(imu, _as_ranges(imu, stills), temperature_c)
    attitudes = distinct_attitudes(poses.force)
    # Without an accelerometer gravity is not measured: rests determine the gyroscope's bias.
    if attitudes < MIN_ATTITUDES and 'accelerometer' not in imu.absent:
        require_no_sway(imu, poses.force, list(zip(poses.start, poses.stop)), least=MIN_ATTITUDES)
        raise NotObservableError(
            f'calibration by hand needs at least {MIN_ATTITUDES} different attitudes held still'
            f' ({POSES_FULL} or more for all parameters), got {attitudes} in {len(poses)}'
            ' intervals at rest; hold the IMU still in more attitudes, or describe the table or'
            ' arm that moved it',
            key='table',
            code='too_few_attitudes',
        )
    if imu.absent:
        # A turn relates both sensors.
        statistics = {'attitudes': attitudes, 'turns_dropped': {}, **noise_statistics(poses)}
        return HandData(without_sensors(poses, imu.absent), [], statistics, imu.absent)
    turns, dropped = collect_turns(time, imu, poses=poses, temperature_c=temperature_c)
    turns += [
        known_turn_data(time, imu, turn, poses=poses, temperature_c=temperature_c)
        for turn in known_turns
    ]
    return HandData(
        poses, turns, {'attitudes': attitudes, 'turns_dropped': dropped, **noise_statistics(poses)}
    )


def solve_by_hand(data: HandData, options: HandOptions) -> HandCalibration:
    """
    Estimate from given poses and turns.

    See `calibrate_by_hand`. Cross terms of the accelerometer that no attitude tests are held at
    their prior (`tested_directions`).
    """
    report('solving')
    free = _solved(data, options)
    if 'accelerometer' in data.absent:
        return free
    model, poses = free.hand_model, free.used_poses
    up = directions(model, poses)
    names = off_axis_lacking(up)
    if not names:
        return free
    testing = turns_between(up, free.used_turns)
    held = _solved(data, options, untested=names)
    if len(testing) < TESTING_TURNS:
        # Norms decide, with one error for all rests of a placement. The readings are those of the
        # recording: outliers and a wandering bias were estimated with one of the models, whose
        # errors they would hide.
        measured = data.poses
        used = np.zeros(len(up), bool)
        for hand in (free, held):
            used |= np.all(hand.used_poses.force_sem <= measured.force_sem, axis=1)
        demanded = placements_demand(model, held.hand_model, measured, up=up, used=used)
        chosen = free if demanded else held
        fit = fit_placements(chosen.hand_model, chosen.values, measured, up=up, used=used)
        if fit.covariance is None:
            return chosen
        more = excess(fit.covariance, total(chosen.terms), fit.index)
        return replace(chosen, terms=with_term(chosen.terms, SAMPLE_NOISE, more))
    errors = [np.array([_missed_by(hand, turn) for turn in testing]) for hand in (free, held)]
    return held if contradicted_by_turns(*errors) else free


def _missed_by(hand: HandCalibration, turn: TurnData) -> float:
    """Return the angle between rotated and measured gravity after a turn, rad."""
    force = hand.compensate(hand.poses.force, hand.poses.rate, **hand.poses.conditions)[0]
    state = replace(hand.state, up=unit_rows(force))
    return missed_angle(state, hand.poses, turn, matrix=hand.gyroscope[1])


def _solved(
    data: HandData, options: HandOptions, *, untested: tuple[str, ...] = ()
) -> HandCalibration:
    """Return the calibration with the cross terms `untested` held at their prior."""
    poses, turns = data.poses, data.turns
    if data.absent:
        # The g-sensitivity relates both sensors.
        default = BASE
        evidence = dict(NO_EVIDENCE)
    else:
        default, evidence = default_gyroscope(poses)
    reference_c = (
        25.0 if poses.temperature_c is None else float(np.round(np.mean(poses.temperature_c)))
    )
    sensors = SensorModel(
        options.accelerometer or BASE,
        options.gyroscope or default,
        temperature_ref_c=reference_c,
        point=options.point,
        catalogue=options.catalogue,
    )
    for sensor, name in options.added:
        if (sensor, name) not in sensors.slices:
            sensors = sensors.with_effect(sensor, name)
    model = HandModel(sensors, options.gravity, untested=untested, absent=data.absent)
    thermal = [effect.name for effect in model.extras if 'temperature' in effect.needs]
    if thermal and poses.temperature_c is None:
        raise InputError(
            f'{", ".join(thermal)} needs temperatures, the recording has none; record'
            ' imu/temperature or omit it'
        )
    state = first_state(model, poses)
    model = replace(model, gyro_factor=full_scale_factor(state, poses, turns))
    turns, contradicted = possible_turns(model, state, poses, turns=turns)
    left = {CONTRADICTED_TURNS: contradicted} if contradicted else {}
    solved = partial(solve_joint, gravity_sd=options.gravity_sd)
    for effect in model.extras:
        # A time constant distant from the prior does not converge from there.
        if effect.time_constant and effect.name not in options.point:
            trials = [
                replace(model, model=each)
                for each in at_time_constants(model.model, effect, float(poses.time[-1]))
            ]
            scatter = [
                solved(trial, poses, turns)[0].scatter.variance[SENSORS.index(effect.sensor)]
                for trial in trials
            ]
            model = trials[int(np.argmin(scatter))]
    for _ in range(MAX_HAND_PASSES):
        found, integrated = solved(model, poses, turns)
        # The columns below are computed at the estimate.
        integrated = {} if model.model.relinearised else integrated
        settled = _settled(model, found)
        model = model.at(found.state.values)
        poses, turns, out = without_outlying_poses(
            model, found, poses=poses, turns=turns, integrated=integrated
        )
        left |= {
            f'outlying {kind}': left.get(f'outlying {kind}', 0) + count
            for kind, count in out.items()
        }
        if settled and not out:
            break
    movements = bias_movements(model, found.state.values, poses)
    if 'accelerometer' in movements:
        poses = without_movement(poses, movements)
        found, _ = solved(model, poses, turns)
    terms = with_term(
        found.terms,
        DRIFT,
        with_movement(covariance := total(found.terms), model, movements) - covariance,
    )
    terms = with_term(terms, DRIFT, _hidden_covariance(model, poses))
    rows = GravityRows(model, poses, turns).linearise(found.state)
    common = covariance_of_placements(rows, found)
    if common.any():
        # These errors also scatter the parameters between parts of the recording: added is what
        # exceeds the other terms.
        free = np.flatnonzero(found.free)
        expected = (of_fit(found.terms) + common)[np.ix_(free, free)]
        terms[PLACEMENTS] = excess(expected, total(terms), free)
    terms = bounded_by_prior(terms, found.held, model.priors)
    # The result has all poses unchanged, also excluded and drifting ones.
    used = poses
    poses = data.poses
    goals = tolerances_of(model.model, options.tolerances)
    statistics = {
        **data.statistics,
        **evidence,
        'gyro_factor': model.gyro_factor,
        'left_out': left,
        'bias_moved': {
            sensor: float(np.linalg.norm(movement.size)) for sensor, movement in movements.items()
        },
        **_statistics(model, found, poses, turns),
    }
    if options.gravity_sd:
        sd = options.gravity_sd / options.gravity
        goal = float(goals[3])
        statistics['common_scale'] = {
            'sd': sd,
            'tolerance': goal,
            'status': str(statuses([sd], [False], [goal])[0]),
        }
    noise = {
        sensor: replace(poses.noise[sensor], offset_sd=statistics[f'{name}_scatter_sd'])
        for sensor, name in zip(SENSORS, COMPONENTS)
    }
    return HandCalibration(
        model=model.model,
        values=found.state.values,
        terms=terms,
        held=found.held,
        noise=noise,
        residual_rms={},
        chi2_per_dof={sensor: {'mean': None} for sensor in SENSORS},
        information=found.factor.T @ found.factor,
        hand_model=model,
        tolerances=goals,
        statistics=statistics,
        poses=poses,
        state=found.state,
        used_poses=used,
        used_turns=turns,
    )


def _hidden_covariance(model: HandModel, poses: Poses) -> np.ndarray:
    """
    Return the covariance of the biases from errors that are the same at every rest.

    A dead band hides any bias up to its threshold h: ``h^2 / 3``. Rounding errors of slow readings
    act at rest and at both ends of a turn.
    """
    covariance = np.zeros((len(model.model.param_names),) * 2)
    if poses.hidden is not None:
        variance = np.square(poses.hidden.dead_band) / 3.0 + np.square(poses.hidden.rounding_sd)
        covariance[model.gyro_bias, model.gyro_bias] = np.diag(variance)
    return covariance


def _settled(model: HandModel, found: RowEstimate) -> bool:
    """Return whether the columns of warm-ups were computed close enough to the solution."""
    known = []
    for e in model.extras:
        if e.time_constant:
            known.append((model.model.slices[e.key].stop - 1, model.model.point_of(e)[-1]))
    return all(
        found.held[k] or abs(found.state.values[k] / time - 1) <= MAX_SETTLED_CHANGE
        for k, time in known
    )


def without_sensors(poses: Poses, absent: Sequence[str]) -> Poses:
    """Return poses in which the means of absent sensors have no weight."""
    if 'accelerometer' in absent:
        poses = replace(poses, force_sem=np.full_like(poses.force_sem, ABSENT_SD))
    if 'gyroscope' in absent:
        # The mean rate less the creep of the accelerometer is not zero.
        no_rate = np.zeros_like(poses.rate)
        no_weight = np.full_like(poses.rate_sem, ABSENT_SD)
        poses = replace(poses, rate=no_rate, rate_sem=no_weight)
    return poses


def default_gyroscope(poses: Poses) -> tuple[tuple[str, ...], dict]:
    """
    Return (the gyroscope's effects without a request, the evidence of the poses for g-sensitivity).
    """
    evidence = g_sensitivity_evidence(poses)
    return G_SENSITIVE if shown(evidence) else BASE, evidence


def _statistics(
    model: HandModel, found: RowEstimate, poses: Poses, turns: Sequence[TurnData]
) -> dict[str, float | None]:
    before, after = (
        model.norm_rows(values, poses.force, **poses.conditions)[0]
        for values in (model.nominal, found.state.values)
    )
    sem = np.sqrt(np.mean(poses.force_sem**2, axis=1))
    of_accelerometer = model.model.mask(lambda effect: effect.sensor == 'accelerometer')
    spare = len(after) - int(np.sum(of_accelerometer & found.free))
    result = {
        'poses': len(poses),
        'turns': len(turns),
        'steps': found.steps,
        'norm_residual_rms_before': float(np.sqrt(np.mean(before**2))),
        'norm_residual_rms': float(np.sqrt(np.mean(after**2))),
        'norm_chi2_per_dof': float(np.sum((after / sem) ** 2) / spare) if spare > 0 else None,
    }
    for index, name in enumerate(COMPONENTS):
        result[f'{name}_scatter_sd'] = float(np.sqrt(found.scatter.variance[index]))
        result[f'{name}_dof'] = float(found.scatter.dof[index])
    return result


def _as_ranges(imu: ImuSamples, stills: Sequence[slice] | None) -> list[tuple[int, int]]:
    if stills is None:
        stills = find_still(imu)
    ranges = [(s.start, s.stop) if isinstance(s, slice) else (int(s[0]), int(s[1])) for s in stills]
    ranges = [(a, b) for a, b in ranges if b - a >= 2]
    if not ranges:
        require_no_sway(imu, np.zeros((0, 3)), [], least=MIN_ATTITUDES)
        raise NotObservableError(
            f'calibration by hand needs at least {MIN_ATTITUDES} different attitudes held still, '
            'got no interval at rest; hold the IMU still for a second or more in each attitude, '
            'or describe the table or arm that moved it',
            key='table',
            code='no_rest',
        )
    return ranges

"""
Calibration without a table.

Gravity is the reference, poses held still and the turns between them are the data.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from imu_calibration.core.errors import InputError, NotObservableError
from imu_calibration.core.progress import report
from imu_calibration.core.samples import ImuSamples
from imu_calibration.effects.base import SENSORS, Effect, Role
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
    BiasMovement,
    bias_movements,
    with_movement,
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


class GyroscopeParameters(NamedTuple):
    """Bias, matrix and g-sensitivity of the gyroscope."""

    bias: np.ndarray
    """Bias, rad/s, shape (3,)."""
    matrix: np.ndarray
    """Matrix, shape (3, 3)."""
    g_sensitivity: np.ndarray
    """Response to specific force, (rad/s)/(m/s^2), shape (3, 3); zeros if the model has none."""


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
    """Counts, noise, scatter, chi-square: plain numbers, by name."""
    poses: Poses
    """The poses that were used."""
    state: State
    """Directions and drifts of the poses, and the parameters."""
    used_poses: Poses
    """The poses as weighted: excluded ones with negligible weight, a drifting bias at its mean."""
    used_turns: list[TurnData]
    """Turns without the excluded ones."""

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
        Largest ``(value - prior)^2 / variance`` of a weak parameter that its prior replaces.

        It is `CROSS_TERM_RATIO` for cross terms of the accelerometer, because near the six faces
        the poses determine them only through small tilts. Otherwise it is 1, which gives the
        smallest expected error.
        """
        return np.where(np.isin(self.param_names, CROSS_TERMS), CROSS_TERM_RATIO, 1.0)

    @property
    def statuses(self) -> tuple[Status, ...]:
        """
        Status of each parameter with gravity as used.

        The uncertainty of gravity has a separate status (`common_scale` of the statistics).
        """
        return statuses(self.judged_sd, self.held, self.tolerances)

    @property
    def accelerometer(self) -> tuple[np.ndarray, np.ndarray]:
        """(bias, matrix) of the accelerometer."""
        return self.hand_model.linear(self.values)[:2]

    @property
    def gyroscope(self) -> GyroscopeParameters:
        """Bias, matrix and g-sensitivity of the gyroscope."""
        linear = self.hand_model.linear(self.values)
        g_sensitivity = self.model.value('gyroscope', Role.CROSS, self.values)
        if g_sensitivity is None:
            g_sensitivity = np.zeros((3, 3))
        return GyroscopeParameters(linear.gyro_bias, linear.gyro_matrix, g_sensitivity)

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
    turns: list[TurnData]
    """Turns between consecutive poses, then those of known angle."""
    statistics: dict
    """Attitudes, excluded turns, noise and period of the samples, by name."""
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
    poses = average_poses(imu, _ranges_at_rest(imu, stills), temperature_c)
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
    statistics = {'attitudes': attitudes, 'turns_dropped': {}, **noise_statistics(poses)}
    if imu.absent:
        # A turn relates both sensors.
        return HandData(without_sensors(poses, imu.absent), [], statistics, imu.absent)
    turns, statistics['turns_dropped'] = collect_turns(
        time, imu, poses=poses, temperature_c=temperature_c
    )
    for turn in known_turns:
        turns.append(known_turn_data(time, imu, turn, poses=poses, temperature_c=temperature_c))
    return HandData(poses, turns, statistics)


def solve_by_hand(data: HandData, options: HandOptions) -> HandCalibration:
    """
    Return the calibration from given poses and turns (`calibrate_by_hand`).

    Cross terms of the accelerometer that no attitude tests are held at their prior, unless turns or
    placements demand them (`tested_directions`).
    """
    report('solving')
    free = _solve(data, options)
    if 'accelerometer' in data.absent:
        return free
    up = directions(free.hand_model, free.used_poses)
    terms_without_test = off_axis_lacking(up)
    if not terms_without_test:
        return free

    # The model with these cross terms against the one with their priors.
    held = _solve(data, options, held_terms=terms_without_test)
    testing_turns = turns_between(up, free.used_turns)
    if len(testing_turns) < TESTING_TURNS:
        return _chosen_by_placements(data.poses, free, held, up=up)
    free_errors = np.array([_turn_error(free, turn) for turn in testing_turns])
    held_errors = np.array([_turn_error(held, turn) for turn in testing_turns])
    return held if contradicted_by_turns(free_errors, held_errors) else free


def _chosen_by_placements(
    poses: Poses, free: HandCalibration, held: HandCalibration, *, up: np.ndarray
) -> HandCalibration:
    """
    Return `free` if the lengths of gravity in the placements demand cross terms, otherwise `held`.

    The covariance of the accelerometer is at least that of a fit with one error per placement.

    Parameters
    ----------
    poses : Poses
        Readings of the recording. Outliers and a wandering bias were estimated with one of the
        models, whose errors they would hide.
    free, held : HandCalibration
        Solutions with estimated cross terms, and with cross terms at their prior.
    up : array, shape (k, 3)
        Direction of gravity in each pose (`directions`).

    """
    # Poses that at least one of the models does not exclude as outliers.
    used = np.zeros(len(up), bool)
    for hand in (free, held):
        used |= np.all(hand.used_poses.force_sem <= poses.force_sem, axis=1)
    demanded = placements_demand(free.hand_model, held.hand_model, poses, up=up, used=used)
    chosen = free if demanded else held

    # One error for all rests of a placement gives a larger covariance than one for each rest, which
    # is in `terms` already: only the excess is added.
    fit = fit_placements(chosen.hand_model, chosen.values, poses, up=up, used=used)
    if fit.covariance is None:
        return chosen
    additional = excess(fit.covariance, total(chosen.terms), fit.index)
    return replace(chosen, terms=with_term(chosen.terms, SAMPLE_NOISE, additional))


def _turn_error(hand: HandCalibration, turn: TurnData) -> float:
    """Return the angle between rotated and measured gravity after a turn, rad."""
    force, _ = hand.compensate(hand.poses.force, hand.poses.rate, **hand.poses.conditions)
    state = replace(hand.state, up=unit_rows(force))
    return missed_angle(state, hand.poses, turn, matrix=hand.gyroscope.matrix)


def _solve(
    data: HandData, options: HandOptions, *, held_terms: tuple[str, ...] = ()
) -> HandCalibration:
    """Return the calibration with the cross terms `held_terms` at their prior."""
    poses = data.poses

    # 1. Model. The g-sensitivity relates both sensors, so that it needs both.
    evidence = dict(NO_EVIDENCE) if data.absent else g_sensitivity_evidence(poses)
    default = G_SENSITIVE if shown(evidence) else BASE
    sensors = _requested_effects(options, poses, default_gyroscope=default)
    model = HandModel(sensors, options.gravity, held_terms=held_terms, absent=data.absent)
    thermal = [effect.name for effect in model.extras if 'temperature' in effect.needs]
    if thermal and poses.temperature_c is None:
        raise InputError(
            f'{", ".join(thermal)} needs temperatures, the recording has none; record'
            ' imu/temperature or omit it'
        )

    # 2. First guess, and the turns that contradict gravity with it.
    state = first_state(model, poses)
    model = replace(model, gyro_factor=full_scale_factor(state, poses, data.turns))
    turns, n_contradicted = possible_turns(model, state, poses, turns=data.turns)
    n_excluded = {}  # kind -> number of poses or turns
    if n_contradicted:
        n_excluded[CONTRADICTED_TURNS] = n_contradicted

    # 3. Time constants of warm-ups. Gauss-Newton does not converge from a distant one, so the best
    #    of several is the point of the first linearisation.
    for effect in model.extras:
        if effect.time_constant and effect.name not in options.point:
            model = _best_time_constant(model, effect, poses, turns, options.gravity_sd)

    # 4. Solve, relinearise and exclude outliers until neither changes the solution.
    for _ in range(MAX_HAND_PASSES):
        estimate, integrated_turns = solve_joint(model, poses, turns, gravity_sd=options.gravity_sd)
        settled = _settled(model, estimate)
        if model.model.relinearised:
            integrated_turns = {}  # they belong to the columns of the previous linearisation
        model = model.at(estimate.state.values)
        inliers = without_outlying_poses(
            model, estimate, poses=poses, turns=turns, integrated=integrated_turns
        )
        poses = inliers.poses
        turns = inliers.turns
        for kind, count in inliers.n_outliers.items():
            key = f'outlying {kind}'
            n_excluded[key] = n_excluded.get(key, 0) + count
        if settled and not inliers.n_outliers:
            break

    # 5. Drift of the biases. That of the accelerometer is subtracted from the poses; that of the
    #    gyroscope is a nuisance of every pose already.
    drifts = bias_movements(model, estimate.state.values, poses)
    if 'accelerometer' in drifts:
        poses = replace(poses, force=poses.force - drifts['accelerometer'].course)
        estimate, integrated_turns = solve_joint(model, poses, turns, gravity_sd=options.gravity_sd)

    # 6. Statistics, of all poses: also of the excluded and drifting ones.
    goals = tolerances_of(model.model, options.tolerances)
    bias_moved = {sensor: float(np.linalg.norm(drift.size)) for sensor, drift in drifts.items()}
    statistics = {
        **data.statistics,
        **evidence,
        'gyro_factor': model.gyro_factor,
        'left_out': n_excluded,
        'bias_moved': bias_moved,
        **_statistics(model, estimate, data.poses, turns),
    }
    if options.gravity_sd:
        sd = options.gravity_sd / options.gravity
        # A wrong gravity scales all axes: the tolerance is that of the scale factor of x.
        goal = float(goals[3])
        statistics['common_scale'] = {
            'sd': sd,
            'tolerance': goal,
            'status': str(statuses([sd], [False], [goal])[0]),
        }
    noise = {}
    for sensor, component in zip(SENSORS, COMPONENTS):
        scatter_sd = statistics[f'{component}_scatter_sd']
        noise[sensor] = replace(data.poses.noise[sensor], offset_sd=scatter_sd)
    return HandCalibration(
        model=model.model,
        values=estimate.state.values,
        terms=_with_common_errors(
            GravityRows(model, poses, turns, integrated_turns), estimate, drifts
        ),
        held=estimate.held,
        noise=noise,
        residual_rms={},
        chi2_per_dof={sensor: {'mean': None} for sensor in SENSORS},
        information=estimate.factor.T @ estimate.factor,
        hand_model=model,
        tolerances=goals,
        statistics=statistics,
        poses=data.poses,
        state=estimate.state,
        used_poses=poses,
        used_turns=turns,
    )


def _requested_effects(
    options: HandOptions, poses: Poses, *, default_gyroscope: tuple[str, ...]
) -> SensorModel:
    """Return the requested and the added effects, with the mean temperature as the reference."""
    reference_c = 25.0
    if poses.temperature_c is not None:
        reference_c = float(np.round(np.mean(poses.temperature_c)))
    sensors = replace(
        options.model,
        gyroscope=options.gyroscope or default_gyroscope,
        temperature_ref_c=reference_c,
        point=options.point,
    )
    for sensor, name in options.added:
        if (sensor, name) not in sensors.slices:
            sensors = sensors.with_effect(sensor, name)
    return sensors


def _best_time_constant(
    model: HandModel, effect: Effect, poses: Poses, turns: list[TurnData], gravity_sd: float
) -> HandModel:
    """
    Return the model linearised at the best of several time constants of an effect.

    The best one has the smallest scatter of the sensor between poses.
    """
    # The first two of `COMPONENTS`: the scatter of poses is that of the accelerometer, the drift
    # that of the gyroscope.
    component = SENSORS.index(effect.sensor)
    trials = []
    variances = []
    for sensors in at_time_constants(model.model, effect, float(poses.time[-1])):
        trial = replace(model, model=sensors)
        estimate, _ = solve_joint(trial, poses, turns, gravity_sd=gravity_sd)
        trials.append(trial)
        variances.append(estimate.scatter.variance[component])
    return trials[int(np.argmin(variances))]


def _with_common_errors(
    reference: GravityRows, estimate: RowEstimate, drifts: Mapping[str, BiasMovement]
) -> dict[str, np.ndarray]:
    """
    Return the terms of the covariance of an estimate, with those of errors that rests share.

    They are the drift of the biases, errors common to all rests, and those common to the rests of
    a placement.
    """
    model = reference.model
    covariance = total(estimate.terms)
    drift_covariance = with_movement(covariance, model, drifts) - covariance
    terms = with_term(estimate.terms, DRIFT, drift_covariance)
    terms = with_term(terms, DRIFT, _hidden_covariance(model, reference.poses))
    placement_covariance = covariance_of_placements(reference.linearise(estimate.state), estimate)
    if placement_covariance.any():
        # Errors of placements also scatter the parameters between parts of the recording, which is
        # in the terms already: only the excess over them is added.
        free = np.flatnonzero(estimate.free)
        expected = (of_fit(estimate.terms) + placement_covariance)[np.ix_(free, free)]
        terms[PLACEMENTS] = excess(expected, total(terms), free)
    return bounded_by_prior(terms, estimate.held, model.priors)


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


def _settled(model: HandModel, estimate: RowEstimate) -> bool:
    """Return whether the columns of warm-ups were computed close enough to the solution."""
    for effect in model.extras:
        if not effect.time_constant:
            continue
        # The time constant is the last value of an effect.
        index = model.model.slices[effect.key].stop - 1
        linearised_at = model.model.point_of(effect)[-1]
        if estimate.held[index]:
            continue
        if not abs(estimate.state.values[index] / linearised_at - 1) <= MAX_SETTLED_CHANGE:
            return False
    return True


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


def _statistics(
    model: HandModel, estimate: RowEstimate, poses: Poses, turns: Sequence[TurnData]
) -> dict[str, float | None]:
    """Return counts, residuals of the lengths of gravity, and scatter of an estimate, by name."""
    before, _ = model.norm_rows(model.nominal, poses.force, **poses.conditions)
    after, _ = model.norm_rows(estimate.state.values, poses.force, **poses.conditions)
    sem = np.sqrt(np.mean(poses.force_sem**2, axis=1))
    of_accelerometer = model.model.mask(lambda effect: effect.sensor == 'accelerometer')
    spare = len(after) - int(np.sum(of_accelerometer & estimate.free))
    result = {
        'poses': len(poses),
        'turns': len(turns),
        'steps': estimate.steps,
        'norm_residual_rms_before': float(np.sqrt(np.mean(before**2))),
        'norm_residual_rms': float(np.sqrt(np.mean(after**2))),
        'norm_chi2_per_dof': float(np.sum((after / sem) ** 2) / spare) if spare > 0 else None,
    }
    for index, name in enumerate(COMPONENTS):
        result[f'{name}_scatter_sd'] = float(np.sqrt(estimate.scatter.variance[index]))
        result[f'{name}_dof'] = float(estimate.scatter.dof[index])
    return result


def _ranges_at_rest(imu: ImuSamples, stills: Sequence | None) -> list[tuple[int, int]]:
    """
    Return the ranges (start, stop) of at least two samples at rest.

    `stills` as in `calibrate_by_hand`; None: found here.

    Raises
    ------
    NotObservableError
        When there is none.

    """
    if stills is None:
        stills = find_still(imu)
    ranges = []
    for still in stills:
        if isinstance(still, slice):
            still = (still.start, still.stop)
        start, stop = int(still[0]), int(still[1])
        if stop - start >= 2:
            ranges.append((start, stop))
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

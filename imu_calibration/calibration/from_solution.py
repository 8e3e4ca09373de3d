"""The document from a solution, and changes of the model that it reports."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from typing import Any, TypeVar, cast

import numpy as np

import imu_calibration
from imu_calibration.calibration.mount_check import common_turn_deg
from imu_calibration.core.readings import RawReadings
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.proof_entry import Proof
from imu_calibration.document.reference_texts import MOUNT_AXES
from imu_calibration.document.statistics import (
    AttitudeScatter,
    RecordingStatistics,
    SensorEntry,
)
from imu_calibration.document.trust import Uncorrected
from imu_calibration.document.verdict import incomplete_windows, judged
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import centred
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation import observability
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.solution import (
    AZIMUTH_REMEDY,
    BIAS_PROCESS,
    HELD_PRIORS,
    PLACE_REMEDY,
    REJECTED,
    WANDER_REMEDY,
    Solution,
    reasons_held,
    remedy,
    statuses,
    with_term,
)
from imu_calibration.estimation.standard_motions import Motion, motions_about
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import unusable, visible_findings
from imu_calibration.preprocessing.window_cutter import dropped
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.references.turntable.session_data import SessionData

Estimate = TypeVar('Estimate', bound=Solution)
"""Solution of a reference."""


@dataclass(frozen=True)
class ModelChanges:
    """Names of effects, the strongest first, and the residual that none of them explains."""

    added: tuple[str, ...] = ()
    """Added to the model because the data support them."""
    unstable: tuple[str, ...] = ()
    """
    Not added because the estimates of parts of the recording differ; the standard deviations allow
    for them.
    """
    implausible: dict[str, float] = field(default_factory=dict)
    """
    Not added because no known instrument has effects of this size -> explained share of the excess
    variance; the standard deviations allow for them.
    """
    lacking: tuple[str, ...] = ()
    """
    Demanded, but the motion of before is no longer kept, so that they cannot join; the standard
    deviations allow for them.
    """
    unexplained: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Sensor -> rms and axes of its unexplained residual, by the test of `diagnose`."""
    stamp_jitter: dict[str, Any] = field(default_factory=dict)
    """
    Sd of independent errors of the stamps and the variance ratios they cause (`StampJitter`), empty
    where not significant.
    """
    changed_at: float | None = None
    """
    Time of a change of parameters at one moment (`find_onset`), s: effects and residual are of the
    longer part.
    """

    def to_mapping(self) -> dict:
        """Return the part of a document's statistics."""
        return {
            {'unstable': 'denied'}.get(name, name): (
                list(value) if isinstance(value, tuple) else value
            )
            for name, value in vars(self).items()
            if value
        }


@dataclass(frozen=True, eq=False)
class ModelExtension:
    """
    Effects that a recording supports.

    The result of a search as needed for further solutions of the same and more windows.
    """

    added: tuple[tuple[str, str], ...] = ()
    """(sensor, effect) in addition to the requested ones."""
    point: dict[str, np.ndarray] = field(default_factory=dict)
    """Effect -> values of the first linearisation."""
    changes: ModelChanges = ModelChanges()
    """The same as text, for the document."""
    moves: tuple[tuple[Mapping[str, float], float], ...] = ()
    """(parameter -> its change under another choice of effects, weight of that choice)."""
    clipped: Solution | None = None
    """The solution without saturated samples if the search found a limit of a sensor."""

    def options(self, asked: CalibrationOptions) -> CalibrationOptions:
        """Return the options of the model that is solved."""
        return replace(asked, added=self.added, point=self.point)

    def disagreement(self, names: Sequence[str]) -> np.ndarray:
        """
        Return the covariance of the changes of parameters by other choices of effects.

        Shape (n_params, n_params).
        """
        total = np.zeros((len(names),) * 2)
        for moved, weight in self.moves:
            shift = np.array([moved.get(name, 0.0) for name in names])
            total += weight * np.outer(shift, shift)
        return total

    def applied(self, solution: Estimate) -> Estimate:
        """
        Return a solution of `options`, or that without clipped samples.

        With the covariance of rejected and collinear effects.
        """
        # A clipped solution is of the same reference.
        found = cast('Estimate', self.clipped or solution)
        return replace(
            found, terms=with_term(found.terms, REJECTED, self.disagreement(found.param_names))
        )

    @property
    def is_nothing(self) -> bool:
        """Whether the solution of the requested model and its notes are unchanged."""
        return not (self.added or self.moves or self.clipped or self.changes != ModelChanges())


def motions_needed(
    solution: Solution, tolerances: np.ndarray, table: Table, *, quality: Mapping
) -> dict[str, tuple[str, float]]:
    """
    Return undetermined parameter -> (best motion, its sd after a minute of it).

    The motion is the one that would serve best a parameter that is not determined; where no motion
    serves it, the remedy for the cause and NaN (`estimation.solution.remedy`).

    Parameters
    ----------
    solution : Solution
    tolerances : ndarray, shape (n_params,)
    table : Table
    quality : mapping
        Statistics of the document, from which it follows whether the model is incomplete
        (`verdict.incomplete_windows`).

    """
    prior_sd = make_prior(solution.model).sd
    needed = observability.needed_motions(
        solution,
        tolerances,
        table.gravity_value,
        prior_sd=prior_sd,
        possible=possible_motions(table),
    )
    data_sd = observability.sd_of_data(solution, prior_sd)
    of_bias_process = np.diag(solution.terms[BIAS_PROCESS])
    counted = _counted(solution)
    is_shown = dict(zip(solution.param_names, data_sd <= tolerances, strict=True))
    of_place = PLACE_REMEDY if table.latitude is None else AZIMUTH_REMEDY
    of_known_size: set[str] = set()
    for effect in solution.model.effects:
        if effect.known_size:
            of_known_size.update(effect.param_names())
    for name in list(needed):
        if name not in counted:
            del needed[name]
            continue
        if name in of_known_size:
            needed[name] = (of_place, float('nan'))
            continue
        index = solution.param_names.index(name)
        section = name.partition('.')[0]
        # Both sensors determine table and clock.
        sensors = (section,) if section in SENSORS else SENSORS
        of_misfit: tuple[str, ...] = ()
        if any(incomplete_windows(quality, sensor) for sensor in sensors):
            # Bias processes describe the error of the model.
            of_misfit = (BIAS_PROCESS,)
        if any(each.startswith(sensors) and is_shown[each] for each in solution.not_believed):
            # A parameter that the motions determine is held for a misfit, not for their lack.
            of_misfit = (BIAS_PROCESS, HELD_PRIORS)
        text = remedy(solution.terms, index, tolerances[index], of_misfit=of_misfit)
        wanders = any(_wanders(solution, sensor) for sensor in sensors)
        if not text and wanders and of_bias_process[index] > tolerances[index] ** 2:
            # The mean of the bias over the recording is as uncertain after more motions.
            text = WANDER_REMEDY
        if text:
            needed[name] = (text, float('nan'))
    return needed


def _wanders(solution: Solution, sensor: str) -> bool:
    """
    Return whether the scatter of window means is that of a bias that wanders.

    The offsets of windows are independent, so that more windows reduce their part; a bias that
    wanders keeps its value from window to window.
    """
    noise = solution.noise.get(sensor)
    return noise is not None and noise.bias_variance > noise.offset_sd**2


def possible_motions(table: Table) -> tuple[Motion, ...] | None:
    """Return the standard motions that a table with a single joint can do; None: any."""
    if len(table.joints) != 1 or not table.joints[0].turns:
        return None
    return motions_about(
        *(table.mat_sl @ np.asarray(direction) for direction in (table.joints[0].axis, table.up))
    )


def document(
    solution: Solution,
    tolerances: np.ndarray,
    gathered: SessionData,
    *,
    gravity: float,
    gauge: dict,
    undetermined: tuple[dict, ...],
    statistics: dict,
    provenance: dict | None,
    proof: Proof | None,
    changes: ModelChanges,
    uncorrected: Uncorrected,
    tested: Collection[str] = (),
    absent: tuple[str, ...] = (),
    readings: RawReadings | None = None,
) -> Calibration:
    """
    Return the Calibration for a solution, with statuses and the verdict.

    Parameters
    ----------
    solution : Solution
    tolerances : ndarray, shape (n_params,)
    gathered : SessionData
        Data of the recording.
    gravity : float
        Of the reference, m/s^2.
    gauge, undetermined, statistics, provenance, proof
        Parts of the document.
    changes : ModelChanges
    uncorrected : Uncorrected
        Effects in time that compensation does not correct; their centres are included in the
        values.
    tested : names, optional
        Parameters that are replaced by a likelihood-ratio test.
    absent : sensors, optional
        Sensors without readings.
    readings : RawReadings, optional
        Units and axes of the recording; None: SI, axes not stated.

    """
    final = solution.model.at(solution.values)
    values, slope = centred(final, solution.values, uncorrected.centre)
    terms = {name: slope @ term @ slope.T for name, term in solution.terms.items()}
    moved = replace(solution, values=values, terms=terms)
    found = {
        **statistics,
        'preflight': [finding.to_mapping() for finding in visible_findings(gathered.findings)],
        'unusable': unusable(gathered.findings),
        **changes.to_mapping(),
        **uncorrected.to_mapping(),
    }
    calibration = Calibration(
        replace(final, centre=dict(uncorrected.centre)),
        values,
        moved.covariance,
        statuses(moved.judged_sd, moved.held, tolerances),
        gathered.frame_id,
        gauge,
        undetermined,
        found,
        conditions(gathered, gravity),
        {'software': imu_calibration.__version__, **(provenance or {})},
        proof=proof or {},
        covariance_terms={name: np.diag(term) for name, term in terms.items()},
        held_reason=reasons_held(
            solution.held, solution.param_names, solution.replaced, tested=tested
        ),
        absent=absent,
        readings=readings or RawReadings(),
    )
    return judged(calibration, tolerances)


def weak_on_table(
    solution: Solution, tolerances: np.ndarray, needed: dict[str, tuple[str, float]]
) -> tuple[dict, ...]:
    """
    Return the weak directions with helpful motions, and the unnamed parameters.

    The motions would help with the weak directions. The parameters are the ones that none of the
    directions names.
    """
    names = _counted(solution)
    present = np.isin(solution.param_names, names)
    directions = observability.weak_directions(
        solution.covariance[np.ix_(present, present)], tolerances[present], names
    )
    others = _besides(directions, needed, dict(zip(solution.param_names, solution.sd / tolerances)))
    known = [(weights, _need(weights, needed)) for weights in directions]
    return tuple({'parameters': weights, 'needs': need} for weights, need in (*known, *others))


def _counted(solution: Solution) -> list[str]:
    """
    Return the parameters for which a motion can be asked.

    Those of an absent sensor are nominal. The other one may not see the table and the clock: only
    its own parameters count.
    """
    if not solution.absent:
        return solution.param_names
    present = tuple(solution.noise)
    return [name for name in solution.param_names if name.startswith(present)]


def gauge_of(model: SensorModel) -> dict[str, Any]:
    """Return the conventions of origin and axes on a table."""
    both_arms = {effect.role for effect in model.arms} == {Role.ARMS, Role.ARM}
    gauge: dict[str, Any] = {
        'origin': 'mean_of_sensitive_points' if both_arms else 'mount',
        'axes': MOUNT_AXES,
    }
    if model.joint_names.angle_sd is not None:
        gauge['zeros_as_described'] = list(model.joint_names.taken_as_described)
    return gauge


def _need(weights: Mapping[str, float], needed: Mapping[str, tuple[str, float]]) -> str:
    """Return the motion for the parameter of a direction with the largest weight."""
    for name in sorted(weights, key=lambda name: -abs(weights[name])):
        if name in needed:
            return needed[name][0]
    return 'more of the same motion'


def _besides(
    directions: Sequence[Mapping[str, float]],
    needed: Mapping[str, tuple[str, float]],
    in_tolerances: Mapping[str, float],
) -> list[tuple[dict[str, float], str]]:
    """
    Return (sds in tolerances, motion) of the parameters that none of the worst directions names.
    """
    named: set[str] = set().union(*directions)
    others: dict[str, dict[str, float]] = {}
    for name, (text, _) in needed.items():
        if name not in named:
            others.setdefault(text, {})[name] = round(float(in_tolerances[name]), 3)
    return [(names, text) for text, names in others.items()]


def noise_entry(noise: NoiseModel) -> SensorEntry:
    """Return the statistics of the noise of one sensor and of the scatter of its means."""
    return SensorEntry(
        noise_sd=noise.white_sd,
        between_window_sd=noise.offset_sd,
        wander_sd=float(np.sqrt(noise.bias_variance)),
    )


def statistics(solution: Solution, gathered: SessionData) -> RecordingStatistics:
    """Return the statistics of windows: noise, residuals, chi-square, dropped samples."""
    sensors = {}
    for sensor, noise in solution.noise.items():
        attitude = None
        if sensor in solution.attitude:
            dependence = solution.attitude[sensor]
            attitude = AttitudeScatter(variance_ratio=dependence.ratio, p_value=dependence.p_value)
        has_biases = sensor in solution.session_biases
        moving, of_means = solution.residual_rms[sensor]
        sensors[sensor] = replace(
            noise_entry(noise),
            low_frequency_factor=noise.inflation,
            wander_time_s=float('nan') if noise.bias_time is None else noise.bias_time,
            residual_rms_moving=moving,
            residual_rms_window_means=of_means,
            chi2_per_dof=solution.chi2_per_dof[sensor],
            slow_over_fast=solution.slow_over_fast.get(sensor, {}),
            attitude=attitude,
            between_recordings_sd=noise.session_sd if has_biases else None,
            bias_of_recordings=solution.session_biases.get(sensor),
            left_out_s=[time for _, time in sorted(noise.left_out)] or None,
        )
    accumulator = gathered.accumulator
    lost = dropped(gathered.counts)
    return RecordingStatistics(
        sensors=sensors,
        not_believed=solution.not_believed or None,
        windows=dict(sorted(accumulator.windows.items())),
        samples_used=dict(sorted(accumulator.samples.items())),
        dropped=lost,
        stream={key: n for key, n in sorted(gathered.counts.items()) if key not in lost},
        common_turn_deg=common_turn_deg(solution),
        unusable_sensors=gathered.unusable or None,
    )


def conditions(gathered: SessionData, gravity: float) -> dict:
    """Return the conditions section."""
    date = datetime.fromtimestamp((gathered.first_stamp_ns or 0) // 10**9, timezone.utc).strftime(
        '%Y-%m-%dT%H:%M:%SZ'
    )
    return {
        'temperature_range_c': gathered.temperature_c,
        'largest_rate': gathered.largest_rate,
        'largest_force': gathered.largest_force,
        'gravity': gravity,
        'duration_s': gathered.duration,
        'date': date,
    }

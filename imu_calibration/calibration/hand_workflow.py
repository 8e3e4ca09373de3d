"""
A calibration by hand.

With the effects that it supports, and with the document and result of a calibration on a table.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from imu_calibration.calibration.advice import missing_motion
from imu_calibration.calibration.check_result import CheckResult
from imu_calibration.calibration.from_solution import ModelChanges, document
from imu_calibration.calibration.hand_proof import (
    TURN_ANGLE_UNIT,
    TURNS_LEAST,
    entry_of,
    folds_by_hand,
    prove_by_hand,
    turn_error,
    uncorrected_by_hand,
    values_without,
)
from imu_calibration.calibration.plain_fit import (
    PlainFit,
    changes_with,
    plain_entries,
    with_plain_fits,
)
from imu_calibration.calibration.plain_fit_by_hand import better_plain_fits_by_hand
from imu_calibration.calibration.result import (
    GRAVITY_SD,
    CalibrationResult,
    ErrorBudget,
    WindowErrors,
)
from imu_calibration.compensation.stream import compensate_samples
from imu_calibration.core.errors import InputError, NotObservableError
from imu_calibration.core.exit_codes import dropped_text
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples, JoinedParts, SampleBlock, TemperatureSamples
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.document.calibration import Calibration, one_significant
from imu_calibration.document.proof_entry import Proof, ProofEntry
from imu_calibration.effects.base import SENSORS, UNITS, Role
from imu_calibration.effects.sensor_model import BASE
from imu_calibration.estimation.solution import REJECTED, with_term, with_weak_replaced
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.preprocessing.absent_sensor import without_sensor
from imu_calibration.preprocessing.checks import Preflight, unusable
from imu_calibration.preprocessing.joint_checks import check_force
from imu_calibration.preprocessing.recording_evidence import WARNING, CheckFinding
from imu_calibration.preprocessing.sensor_join import GyroscopeDelay, delay_of
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner, ContinuedStamps, outside
from imu_calibration.preprocessing.window import Window, WindowKind
from imu_calibration.references.gravity.bias_movement import notes
from imu_calibration.references.gravity.equations import TurnData
from imu_calibration.references.gravity.hand_calibration import (
    GAUGE,
    HandCalibration,
    HandData,
    default_gyroscope,
    gather_by_hand,
    solve_by_hand,
)
from imu_calibration.references.gravity.hand_parameters import (
    CROSS_TERMS,
    HandOptions,
    hand_options,
)
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.references.turntable.session_data import SessionData
from imu_calibration.selection.questions import Question

if TYPE_CHECKING:
    from imu_calibration.references.gravity.model_selection import HandInvestigation


@dataclass(frozen=True, eq=False)
class EvidentHand:
    """A calibration by hand with the search results of its model."""

    hand: HandCalibration
    """The calibration."""
    found: 'HandInvestigation | None' = None
    """Search result; None with too few poses, or without a search."""
    changes: ModelChanges = ModelChanges()
    """Changes of the requested model by the evidence."""


def solve_hand_by_evidence(
    data: HandData, options: HandOptions = HandOptions(), *, as_asked: bool = False
) -> EvidentHand:
    """
    Estimate from poses and turns.

    With the supported effects in addition to the requested model (`investigate_by_hand`).

    Parameters
    ----------
    data : HandData
    options : HandOptions
    as_asked : bool
        Whether the model is exactly the requested one.

    Raises
    ------
    NotObservableError
        As `solve_by_hand`.

    """
    # Here, because its import is slow.
    from imu_calibration.references.gravity.model_selection import (
        MIN_FOLD_POSES,
        investigate_by_hand,
    )

    # The search compares both sensors in poses and turns: with one sensor it has no data.
    if as_asked or data.absent or len(data.poses.start) < MIN_FOLD_POSES:
        return EvidentHand(solve_by_hand(data, options))
    found, asked = investigate_by_hand(data, options), _asked(data, options)
    while faint := _faint(hand := _solved(data, found, options), found, asked):
        found = replace(
            found,
            named=[q for q in found.named if q not in faint],
            unstable=[*found.unstable, *faint],
        )
    added = tuple(q.name for q in found.adopted if q.name not in asked[q.sensor])
    changes = ModelChanges(
        added,
        tuple(question.name for question in found.unstable),
        {
            question.name: found.problem.explained.share(found.named, question)
            for question in found.implausible
        },
        unexplained={
            sensor: rest.entry for sensor, rest in found.unexplained.items() if rest.significant
        },
    )
    return EvidentHand(hand, found, changes)


def _solved(data: HandData, found: 'HandInvestigation', options: HandOptions) -> HandCalibration:
    """
    Return the calibration with the requested model and the findings.

    If the model is unchanged, the one of the search.
    """
    asked, names, base = _asked(data, options), found.names, found.baseline.model
    same = all(getattr(base, sensor) == _joined(asked[sensor], names[sensor]) for sensor in SENSORS)
    return (
        found.baseline
        if same and not (found.unstable or found.implausible)
        else extended_by_hand(data, found, options)
    )


def _faint(
    hand: HandCalibration, found: 'HandInvestigation', asked: Mapping[str, Collection[str]]
) -> list[Question]:
    """Return the effects that were added and are implausible or have no significant coefficient."""
    faint = []
    for question in found.adopted:
        effect, part = question.effect, hand.model.slices[question.effect.key]
        at = np.arange(part.start, part.start + effect.n_amplitudes)
        values, sd = hand.values[at], hand.sd[at]
        if question.name not in asked[question.sensor] and (
            effect.surpasses(values) or not one_significant(values, sd)
        ):
            faint.append(question)
    return faint


def extended_by_hand(
    data: HandData, found: 'HandInvestigation', options: HandOptions
) -> HandCalibration:
    """
    Return the calibration with the requested model and the findings.

    Unstable or implausible effects increase its covariance.
    """
    asked, names = _asked(data, options), found.names
    extended = replace(
        options,
        accelerometer=_joined(asked['accelerometer'], names['accelerometer']),
        gyroscope=_joined(asked['gyroscope'], names['gyroscope']),
    )
    hand = solve_by_hand(data, extended, found.point(found.problem, found.named))
    terms = hand.terms
    for question in (*found.unstable, *found.implausible):
        moved = found.search.moved_by(found.named, question, found.baseline.param_names)
        shift = np.array([moved.get(name, 0.0) for name in hand.param_names])
        terms = with_term(terms, REJECTED, np.outer(shift, shift))
    return replace(hand, terms=terms)


def _asked(data: HandData, options: HandOptions) -> dict[str, tuple[str, ...]]:
    return {
        'accelerometer': options.accelerometer or BASE,
        'gyroscope': options.gyroscope or default_gyroscope(data.poses)[0],
    }


def _joined(asked: tuple[str, ...], found: Iterable[str]) -> tuple[str, ...]:
    return asked + tuple(name for name in found if name not in asked)


@dataclass(frozen=True, eq=False, kw_only=True)
class HandResult(CalibrationResult):
    """A calibration by hand with the data for its report."""

    hand: HandCalibration
    """Parameters as applied, poses, noise and residuals."""
    solution: HandCalibration
    """The same with the parameters of the estimate by weights."""
    fits: tuple[PlainFit, ...] = ()
    """Plain fits that are applied in place of it."""

    observations: ClassVar[str] = 'poses'

    def window_errors(self) -> WindowErrors:
        """
        Return the errors of the poses, after: held out.

        Relative to gravity along its estimated direction, and to zero rate.
        """
        hand, poses = self.hand, self.hand.poses
        force, rate = poses.force, poses.rate
        true, zero = hand.gravity * hand.state.up, np.zeros_like(rate)
        corrected_force, corrected_rate = hand.compensate(
            force, rate, poses.time, temperature_c=poses.temperature_c
        )
        folds = folds_by_hand(poses)
        without = values_without(self.solution, hand.used_turns, folds)
        for fit in self.fits:
            without = fit.merged(without)
        for out, values in zip(folds, without, strict=True):
            corrected = hand.hand_model.compensate(values, force, rate, **poses.conditions)
            corrected_force[out], corrected_rate[out] = (part[out] for part in corrected)
        samples = max(int(poses.stop[-1]), 1)
        time = (poses.start + poses.stop) / 2 * self.gathered.duration / max(samples - 1, 1)
        scatter = [
            float(hand.statistics.get(f'{name}_scatter_sd', 0.0)) for name in ('pose', 'drift')
        ]
        return WindowErrors(
            time,
            np.full(len(force), WindowKind.STATIC),
            {'accelerometer': force, 'gyroscope': rate},
            {'accelerometer': true, 'gyroscope': zero},
            {'accelerometer': force - true, 'gyroscope': rate},
            {'accelerometer': corrected_force - true, 'gyroscope': corrected_rate},
            {
                'accelerometer': np.hypot(poses.force_sem, scatter[0]),
                'gyroscope': np.hypot(poses.rate_sem, scatter[1]),
            },
        )

    def residuals_of(self, window: Window) -> dict[str, np.ndarray]:
        """Empty: by hand no windows are stored."""
        return {}

    def error_budget(self) -> ErrorBudget:
        """
        Return noise and gravity, the only reference.

        The sds contain the uncertainty of a gravity that was not given.
        """
        model, values, known = (
            self.calibration.model,
            self.calibration.values,
            self.options.gravity is not None,
        )
        relative = self.calibration.common_scale.get('sd', GRAVITY_SD / self.gravity)
        part, gravity, gravity_sd = (
            model.part('accelerometer', Role.LINEAR),
            np.zeros(len(values)),
            relative * self.gravity,
        )
        gravity[part] = np.abs(values[part]) * relative
        return ErrorBudget(
            tuple(model.param_names),
            {'noise': self.calibration.own_sd, 'gravity': gravity},
            {
                'noise': 'noise, scatter of poses and turns, as this recording shows them',
                'gravity': (
                    f'gravity {"known" if known else "not given: the standard one is known"} to'
                    f' {gravity_sd:.2g} m/s²'
                ),
            },
        )


@dataclass(frozen=True, eq=False)
class HandRecording:
    """A recording without joints, cleaned."""

    imu: ImuSamples
    """Accepted samples."""
    temperature_c: np.ndarray | None
    """Temperature at the samples, degrees Celsius, shape (n,), when it was recorded."""
    counts: dict
    """Reason -> number of unusable samples."""
    findings: tuple[CheckFinding, ...] = ()
    """Findings of the checks of the recording."""
    delay: GyroscopeDelay | None = None
    """Delay of the gyroscope's stamps; None where the motion does not determine it."""
    unusable: dict[str, str] = field(default_factory=dict)
    """Sensor with readings that cannot be used -> why; `imu` marks it as absent."""

    @property
    def gathered(self) -> SessionData:
        """Data of the recording for the document, without parameters."""
        imu, warm = self.imu, self.temperature_c
        return SessionData(
            counts=self.counts,
            frame_id=imu.frame_id,
            first_stamp_ns=int(imu.stamp_ns[0]),
            last_stamp_ns=int(imu.stamp_ns[-1]),
            largest_rate=float(np.sqrt(np.einsum('ij,ij->i', imu.rate_s, imu.rate_s).max())),
            largest_force=float(max(imu.force_s.max(), -imu.force_s.min())),
            temperature_c=None if warm is None else (float(warm.min()), float(warm.max())),
        )


def read_by_hand(
    blocks: Iterable[SampleBlock],
    nominal: RawReadings | None = None,
    preflight: Preflight | None = None,
) -> HandRecording:
    """
    Return the `HandRecording` of a complete stream of SampleBlock.

    With the findings of `preflight`; `nominal` as for the `BlockCleaner`.

    Raises
    ------
    InputError
        When no usable sample remains.

    """
    watchers = []
    if preflight is not None:
        watchers.append(preflight)
    cleaner = BlockCleaner(nominal=nominal, watchers=watchers, one_sensor=True)
    joined, temperatures = JoinedParts(), []
    # each epoch of the clock is a part of its own: no turn is used across a reset
    stamps, shifts = ContinuedStamps(), {}
    for cleaned in cleaner.all_of(blocks):
        for epoch, imu in cleaned.imu:
            joined.add(stamps.moved(epoch, imu))
            shifts[epoch] = stamps.shift_ns
        temperatures += cleaned.temperature
    if not len(joined):
        raise InputError(
            'the recording must hold Imu messages that can be used, it holds none; check the topic'
        )
    imu = joined.samples()
    findings: tuple[CheckFinding, ...] = ()
    unusable_sensors: dict[str, str] = {}
    if preflight is not None:
        unusable_sensors = preflight.unusable
        imu = _readings_only(imu, preflight.without_readings)
        for sensor in unusable_sensors:
            imu = without_sensor(imu, sensor)
    delay = delay_of(imu)
    if preflight is not None:
        findings = (*preflight.findings, *late_gyroscope(delay))
        preflight.findings = findings
    warm = None
    if temperatures:
        moved = [
            replace(part, stamp_ns=part.stamp_ns + shifts.get(epoch, stamps.shift_ns))
            for epoch, part in temperatures
        ]
        known = TemperatureSamples.concatenate(moved)
        start = imu.stamp_ns[0]  # epochs in nanoseconds do not fit a float
        warm = np.interp(
            (imu.stamp_ns - start).astype(float),
            (known.stamp_ns - start).astype(float),
            known.temperature_c,
        )
    counts = cleaner.lost | {
        reason: count for reason, count in cleaner.counts.items() if reason.startswith('imu ')
    }
    return HandRecording(
        imu,
        warm,
        {reason: count for reason, count in counts.items() if count},
        findings,
        delay,
        unusable_sensors,
    )


def late_gyroscope(delay: GyroscopeDelay | None) -> Iterator[CheckFinding]:
    """Both sensors have the stamps of one moment."""
    if delay is not None and delay.is_large:
        yield CheckFinding(
            'gyroscope_delay',
            WARNING,
            'accelerometer and gyroscope must be stamped together, the gyroscope is'
            f' {delay.text} relative to the accelerometer; correct the stamps or the filters'
            ' in the driver (a calibration by hand does not suffer, navigation does)',
        )


def _readings_only(imu: ImuSamples, ranges: np.ndarray) -> ImuSamples:
    """Return the samples that are in none of the ranges of `Preflight.without_readings`."""
    kept = outside(ranges, np.arange(len(imu)))
    if not kept.any():
        raise InputError(
            f'the recording must hold readings, in all of its {len(imu)} samples an output is'
            ' frozen; check the sensor and its driver',
            code='frozen',
        )
    return imu if kept.all() else imu.select(kept)


def calibrate_without_table(
    sources: Sequence[Callable],
    options: CalibrationOptions = CalibrationOptions(),
    provenance: dict | None = None,
) -> HandResult:
    """
    Calibrate by hand and return the HandResult: gravity is the reference (see `calibrate_by_hand`).

    Parameters
    ----------
    sources : sequence of callables
        One, which returns an iterator of SampleBlock.
    options : CalibrationOptions
    provenance : dict, optional
        Bag names, hashes and options for the document.

    Raises
    ------
    InputError
        When more than one recording is given, or a requested effect needs a table.

    """
    if len(sources) != 1:
        raise InputError(
            f'calibration by hand needs one recording, got {len(sources)}; calibrate them'
            ' separately and compare the results'
        )
    return evident_result(
        read_by_hand(sources[0](), options.nominal, Preflight(options.gravity, one_sensor=True)),
        options,
        provenance,
    )[0]


def evident_result(
    recording: HandRecording,
    options: CalibrationOptions = CalibrationOptions(),
    provenance: dict | None = None,
    *,
    stills: Sequence[slice] | None = None,
) -> tuple[HandResult, EvidentHand]:
    """Return (the HandResult, the search results); `stills` as in `calibrate_by_hand`."""
    asked = hand_options(options)
    data = gather_by_hand(recording.imu, stills, temperature_c=recording.temperature_c)
    evident = solve_hand_by_evidence(data, asked, as_asked=options.as_asked)
    return (
        hand_result(evident, recording, options, provenance=provenance, turns=data.turns),
        evident,
    )


def hand_result(
    evident: EvidentHand,
    recording: HandRecording,
    options: CalibrationOptions = CalibrationOptions(),
    *,
    provenance: dict | None = None,
    turns: Sequence[TurnData] = (),
) -> HandResult:
    """
    Return an EvidentHand as a result for reports and documents.

    It is evaluated on its poses and `turns` if these are enough.

    Raises
    ------
    InputError
        When the specific force at rest is clearly in another unit.

    """
    solution = with_weak_replaced(evident.hand, evident.hand.tolerances)
    check_force(float(np.median(np.linalg.norm(solution.poses.force, axis=1))))
    used_turns = solution.used_turns if turns else ()
    fits = better_plain_fits_by_hand(
        solution,
        used_turns,
        under_test=evident.changes.unexplained,
        as_asked=options.as_asked,
    )
    hand = with_plain_fits(solution, fits)
    gathered = recording.gathered
    gathered.findings = (
        *recording.findings,
        *notes(hand.statistics['bias_moved'], gathered.duration),
    )
    advice = missing_motion(hand)
    statistics = _statistics(hand, gathered.counts, len(recording.imu))
    if recording.unusable:
        statistics['unusable_sensors'] = dict(recording.unusable)
    if recording.delay is not None:
        statistics['gyroscope_delay'] = recording.delay.to_mapping()
    calibration = document(
        hand,
        hand.tolerances,
        gathered,
        gravity=hand.gravity,
        gauge=dict(GAUGE),
        undetermined=advice,
        statistics=statistics | plain_entries(fits),
        provenance=provenance,
        proof=prove_by_hand(solution, used_turns, fits),
        changes=changes_with(evident.changes, fits),
        uncorrected=uncorrected_by_hand(hand),
        tested=CROSS_TERMS,
        absent=hand.hand_model.absent,
        readings=options.nominal,
    )
    needed = {
        name: (item['needs'], float('nan'))
        for item in reversed(advice)
        for name in item['parameters']
    }
    return HandResult(
        calibration=calibration,
        gathered=gathered,
        tolerances=hand.tolerances,
        needed=needed,
        options=options,
        reference='gravity, by hand',
        gravity=hand.gravity,
        period=float(hand.statistics['period']),
        hand=hand,
        solution=solution,
        fits=fits,
    )


def _statistics(
    hand: HandCalibration, counts: Mapping[str, int], n_samples: int
) -> dict[str, dict[str, Any]]:
    found = hand.statistics
    keys = {
        'accelerometer': ('force_noise_sd', 'pose_scatter_sd', 'pose_dof'),
        'gyroscope': ('rate_noise_sd', 'drift_scatter_sd', 'drift_dof'),
    }
    per_sensor = {
        s: {
            'noise_sd': [float(v) for v in found[keys[s][0]]],
            'between_window_sd': float(found[keys[s][1]]),
            'between_window_dof': float(found[keys[s][2]]),
            'wander_sd': 0.0,
        }
        for s in SENSORS
    }
    return {
        **per_sensor,
        'windows': {'static': found.get('poses', 0), 'turns': found.get('turns', 0)},
        'samples_used': {'all': n_samples},
        'by_hand': found,
        'dropped': {reason: int(count) for reason, count in sorted(counts.items())},
    }


def check_by_hand(
    source: Callable, calibration: Calibration, options: CalibrationOptions = CalibrationOptions()
) -> CheckResult:
    """
    Prove a calibration on a recording of its IMU held still in some attitudes.

    With turns between them.

    The error of the accelerometer is the length of its mean reading in a pose less gravity; that of
    the gyroscope the angle between gravity rotated by its rates and gravity in the pose at the end
    of a turn, and its mean reading at rest. Before: readings unchanged; after: as corrected by
    compensation. Directions of gravity are those of the corrected accelerometer for both.

    Parameters
    ----------
    source : callable
        Returns an iterator of SampleBlock.
    calibration : Calibration
        From a table or by hand.
    options : CalibrationOptions
        The local gravity, if it differs from that of the calibration, and the conversion of volts
        or counts.

    Raises
    ------
    InputError
        When the recording cannot be used.

    """
    preflight = Preflight(options.gravity, one_sensor=True)
    recording = read_by_hand(source(), options.nominal, preflight)
    try:
        data = gather_by_hand(recording.imu, temperature_c=recording.temperature_c)
    except NotObservableError as error:
        return CheckResult({}, recording.findings, str(error))
    lost = {**recording.counts, 'unusable': unusable(recording.findings)}
    check_force(float(np.median(np.linalg.norm(data.poses.force, axis=1))))
    warm = (
        None
        if recording.temperature_c is None
        else TemperatureSamples(recording.imu.stamp_ns, recording.temperature_c)
    )
    corrected = compensate_samples(calibration, recording.imu, warm)
    # Of an absent sensor either the readings or the parameters have no meaning.
    absent = {*calibration.absent, *recording.imu.absent}
    if absent == set(SENSORS):
        raise InputError(
            'a calibration must be of a sensor that the recording has, it is of the'
            f' {calibration.sensors[0]} only and the recording has no readings of it; give another'
            ' recording',
            code='absent',
        )
    gravity = gravity_of(calibration, options)
    return CheckResult(
        prove_hand_readings(data, recording.imu, corrected, gravity=gravity, absent=absent),
        recording.findings,
        dropped=dropped_text(lost, len(recording.imu)),
    )


def gravity_of(calibration: Calibration, options: CalibrationOptions) -> float:
    """
    Return the reference gravity for readings at rest, m/s^2.

    The given one, or that of the calibration.
    """
    return options.gravity or calibration.conditions.get('gravity') or STANDARD_GRAVITY


def prove_hand_readings(
    data: HandData,
    before: ImuSamples,
    after: ImuSamples,
    *,
    gravity: float,
    absent: Collection[str] = (),
) -> Proof:
    """
    Return the proof of corrected samples `after` against the raw ones.

    None of the sensors `absent`.
    """
    poses, turns = data.poses, [turn for turn in data.turns if turn.rotation is None]
    ranges = [slice(start, stop) for start, stop in zip(poses.start, poses.stop, strict=True)]
    (raw_force, raw_rate), (force, rate) = (_means(imu, ranges) for imu in (before, after))
    rested = float(np.sum(poses.stop - poses.start) * poses.period)
    lengths = (np.linalg.norm(mean, axis=1, keepdims=True) - gravity for mean in (raw_force, force))
    proof: dict[str, ProofEntry] = {}
    for sensor, errors in zip(SENSORS, (lengths, (raw_rate, rate)), strict=True):
        if sensor not in absent:
            rest = entry_of(errors, UNITS[sensor], seconds=rested)
            proof[sensor] = replace(rest, regimes={'rest': rest})
    # The directions at both ends of a turn are those of the corrected accelerometer.
    if not absent and len(turns) >= TURNS_LEAST:
        up = unit_rows(force)
        # the first corrected readings are NaN where they need an angular acceleration
        errors = (
            np.array(
                [
                    [
                        turn_error(
                            poses,
                            turn,
                            imu.rate_s[poses.stop[turn.first] - 1 : poses.start[turn.last] + 1],
                            up=up,
                        )
                    ]
                    for turn in turns
                ]
            )
            for imu in (before, after)
        )
        turning = float(sum(turn.time[-1] - turn.time[0] for turn in turns))
        angles = entry_of(errors, TURN_ANGLE_UNIT, seconds=turning)
        regimes = {**proof['gyroscope'].regimes, 'turns': angles}
        proof['gyroscope'] = replace(angles, regimes=regimes)
    return proof


def _means(imu: ImuSamples, ranges: Sequence[slice]) -> tuple[np.ndarray, ...]:
    return tuple(
        np.array([np.nanmean(values[part], axis=0) for part in ranges])
        for values in (imu.force_s, imu.rate_s)
    )

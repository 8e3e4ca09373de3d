"""A calibration by hand with the same document and result as a calibration on a table."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

import imu_calibration
from imu_calibration.calibration.advice import missing_motion
from imu_calibration.calibration.from_solution import conditions, preflight_statistics
from imu_calibration.calibration.hand_by_evidence import EvidentHand, solve_by_evidence
from imu_calibration.calibration.hand_proof import prove_by_hand, uncorrected_by_hand
from imu_calibration.calibration.hand_result import HandResult
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, NominalScaling, SampleBlock, TemperatureSamples
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.verdict import judged
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import centred
from imu_calibration.estimation.covariance_terms import GRAVITY
from imu_calibration.estimation.solution import HELD, reasons_held, statuses
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.joint_checks import check_force
from imu_calibration.preprocessing.recording_evidence import CheckFinding
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner, Watcher
from imu_calibration.references.gravity.bias_movement import notes
from imu_calibration.references.gravity.equations import TurnData
from imu_calibration.references.gravity.hand_calibration import gather_by_hand, with_weak_replaced
from imu_calibration.references.gravity.hand_options import hand_options
from imu_calibration.references.gravity.hand_parameters import CROSS_TERMS
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.references.turntable.gathered import Gathered


@dataclass(frozen=True, eq=False)
class HandRecording:
    """A recording without joints, cleaned."""

    imu: ImuSamples
    """Accepted samples."""
    temperature_c: np.ndarray | None
    """Temperature at the samples, degrees Celsius, shape (n,), when it was recorded."""
    counts: dict
    """Reason -> number of unusable samples."""

    @property
    def gathered(self) -> Gathered:
        """Data of the recording for the document, without parameters."""
        imu, warm = self.imu, self.temperature_c
        return Gathered(counts=self.counts, frame_id=imu.frame_id, first_stamp_ns=int(imu.stamp_ns[0]), last_stamp_ns=int(imu.stamp_ns[-1]),
                        largest_rate=float(np.sqrt((imu.rate_s**2).sum(axis=1).max())), largest_force=float(np.abs(imu.force_s).max()),
                        temperature_c=None if warm is None else (float(warm.min()), float(warm.max())))


def read_by_hand(blocks: Iterable[SampleBlock], nominal: NominalScaling | None = None, watchers: Sequence[Watcher] = ()) -> HandRecording:
    """
    Return the `HandRecording` of a complete stream of SampleBlock; `nominal` and `watchers` as for the `BlockCleaner`.

    Raises
    ------
    InputError
        When no usable sample remains.

    """
    cleaner, imus, temperatures = BlockCleaner(nominal=nominal, watchers=watchers), [], []
    for cleaned in cleaner.all_of(blocks):
        imus += [imu for _, imu in cleaned.imu]
        temperatures += [temperature for _, temperature in cleaned.temperature]
    if not imus:
        raise InputError('the recording must hold Imu messages that can be used, it holds none; check the topic')
    imu, warm = ImuSamples.concatenate(imus), None
    if temperatures:
        known = TemperatureSamples.concatenate(temperatures)
        start = imu.stamp_ns[0]  # epochs in nanoseconds do not fit a float
        warm = np.interp((imu.stamp_ns - start).astype(float), (known.stamp_ns - start).astype(float), known.temperature_c)
    counts = cleaner.lost | {reason: count for reason, count in cleaner.counts.items() if reason.startswith('imu ')}
    return HandRecording(imu, warm, {reason: count for reason, count in counts.items() if count})


def read_imu(blocks: Iterable[SampleBlock], watchers: Sequence[Watcher] = ()) -> tuple[ImuSamples, dict[str, int]]:
    """Return (ImuSamples, counts of dropped samples) of a recording, cleaned; raises as `read_by_hand`."""
    recording = read_by_hand(blocks, watchers=watchers)
    return recording.imu, recording.counts


def calibrate_without_table(sources: Sequence[Callable], options: CalibrationOptions = CalibrationOptions(),
                            provenance: dict | None = None) -> HandResult:
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
        raise InputError(f'calibration by hand needs one recording, got {len(sources)}; calibrate them separately and compare the results')
    preflight = Preflight(options.gravity)
    recording = read_by_hand(sources[0](), options.nominal, [preflight])
    return calibrate_samples_by_hand(recording, options, provenance, findings=preflight.findings)


def calibrate_samples_by_hand(recording: HandRecording, options: CalibrationOptions = CalibrationOptions(), provenance: dict | None = None,
                              *, stills: Sequence[slice] | None = None, findings: Sequence[CheckFinding] = ()) -> HandResult:
    """Return the HandResult of a HandRecording; `stills` as in `calibrate_by_hand`, `findings` of a check of the recording."""
    return evident_result(recording, options, provenance, stills=stills, findings=findings)[0]


def evident_result(recording: HandRecording, options: CalibrationOptions = CalibrationOptions(), provenance: dict | None = None, *,
                   stills: Sequence[slice] | None = None, findings: Sequence[CheckFinding] = (),
                   progress: Callable | None = None) -> tuple[HandResult, EvidentHand]:
    """Return (the HandResult, the search results); arguments as in `calibrate_samples_by_hand`, `progress` of the search."""
    asked = hand_options(options)
    data = gather_by_hand(recording.imu, stills, asked.settings, temperature_c=recording.temperature_c)
    evident = solve_by_evidence(data, asked, as_asked=options.as_asked, progress=progress)
    return hand_result(evident, recording, options, provenance=provenance, findings=findings, turns=data.turns), evident


def hand_result(evident: EvidentHand, recording: HandRecording, options: CalibrationOptions = CalibrationOptions(), *,
                provenance: dict | None = None, findings: Sequence[CheckFinding] = (), turns: Sequence[TurnData] = ()) -> HandResult:
    """
    Return an EvidentHand as a result for reports and documents, evaluated on its poses and `turns` if these are enough.

    Raises
    ------
    InputError
        When the specific force at rest is clearly in another unit.

    """
    hand = with_weak_replaced(evident.hand)
    check_force(float(np.median(np.linalg.norm(hand.poses.force, axis=1))))
    model, gathered = hand.model.model, recording.gathered
    gathered.findings = findings = (*findings, *notes(hand.statistics['bias_moved'], gathered.duration))
    uncorrected = uncorrected_by_hand(hand)
    values, slope = centred(final := model.at(hand.values), hand.values, uncorrected.centre)
    terms = {name: np.diag(slope @ term @ slope.T) for name, term in hand.terms.items()}
    covariance, held, tolerances = slope @ hand.covariance @ slope.T, np.array(hand.statuses) == HELD, hand.tolerances
    statistics = _statistics(hand, gathered.counts, len(recording.imu)) | preflight_statistics(findings) | evident.changes.to_mapping()
    statistics |= uncorrected.to_mapping()
    status = statuses(np.sqrt(sum(term for name, term in terms.items() if name != GRAVITY)), held, tolerances)
    advice = missing_motion(hand)
    calibration = Calibration(replace(final, centre=dict(uncorrected.centre)), values, covariance, status,
                              gathered.frame_id, dict(hand.gauge), advice, statistics,
                              conditions(gathered, hand.gravity), {'software': imu_calibration.__version__, **(provenance or {})},
                              proof=prove_by_hand(hand, hand.used_turns if turns else (), hand_options(options).settings),
                              covariance_terms=terms, held_reason=reasons_held(held, model.param_names, hand.replaced, tested=CROSS_TERMS))
    needed = {name: (item['needs'], float('nan')) for item in reversed(advice) for name in item['parameters']}
    return HandResult(calibration=judged(calibration, tolerances), gathered=gathered, tolerances=tolerances, needed=needed,
                      options=options, hand=hand)


def _statistics(hand, counts, n_samples):
    found = hand.statistics
    keys = {'accelerometer': ('force_noise_sd', 'pose_scatter_sd'), 'gyroscope': ('rate_noise_sd', 'drift_scatter_sd')}
    per_sensor = {s: {'noise_sd': [float(v) for v in found[keys[s][0]]], 'between_window_sd': float(found[keys[s][1]]), 'wander_sd': 0.0}
                  for s in SENSORS}
    return {**per_sensor, 'windows': {'static': found.get('poses', 0), 'turns': found.get('turns', 0)}, 'samples_used': {'all': n_samples},
            'by_hand': found, 'dropped': {reason: int(count) for reason, count in sorted(counts.items())}}

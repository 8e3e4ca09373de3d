"""From a recording and a calibration to corrected samples, in memory or in a new bag."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

import numpy as np

from imu_calibration.allan.figures import NoiseFigures
from imu_calibration.api.choices import noise_of, readings_for, topics_of
from imu_calibration.api.recordings import (
    Topics,
    existing,
    open_bag,
    read_split,
    temperatures,
)
from imu_calibration.compensation.compensate import Corrected, Transfer
from imu_calibration.compensation.stream import (
    CompensationStream,
    late_ns,
    refuse_corrected,
    requested_transfer,
)
from imu_calibration.compensation.unit_gate import GravityScale, corrected_rates_text
from imu_calibration.core.errors import InputError
from imu_calibration.core.exit_codes import dropped_text, exit_code_of
from imu_calibration.core.progress import counter
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples, SampleBlock, TemperatureSamples
from imu_calibration.core.scales import DOUBTFUL, IMPOSSIBLE, scale_range
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.document import files
from imu_calibration.document.calibration import ABSENT, Calibration
from imu_calibration.document.trust import Usable, caveats, usable, with_measured_noise
from imu_calibration.effects.base import Role
from imu_calibration.preprocessing.checks import (
    frozen_lines,
    is_one_stamp,
    one_stamp_text,
    refuse,
)
from imu_calibration.preprocessing.exclusion import ExclusionMask, parse_exclusions
from imu_calibration.preprocessing.recording_evidence import EvidenceGatherer
from imu_calibration.preprocessing.scan import FrozenSearch
from imu_calibration.preprocessing.sensor_join import OtherSensor
from imu_calibration.preprocessing.stream_cleaning import StreamCheck
from imu_calibration.preprocessing.value_checks import rate_unit, refuse_units
from msg_adapters.bag import Recording
from msg_adapters.csv_log import (
    corrected_log,
    is_log_folder,
    is_text_log,
    read_directly,
)

CORRECTED_TOPIC = '/imu/data_corrected'
UNIT_READINGS = 20000
"""Readings at the start of a bag that the unit is checked on before anything is written."""


@dataclass(frozen=True, eq=False)
class Compensated:
    """Result of a compensation."""

    imu: ImuSamples | None
    """
    The corrected samples, NaN where a reading cannot be corrected; None when they were written into
    a bag.
    """
    count: int
    """Samples that passed."""
    warnings: list[str]
    """
    Caveats of the calibration, readings outside its conditions, and uncorrected readings, a line
    each.
    """
    lost: dict[str, int]
    """Reason -> messages that could not be read."""
    refused: dict[str, str] = field(default_factory=dict)
    """Sensor that was not corrected -> why."""
    cautions: tuple[str, ...] = ()
    """A line for each sensor that was corrected although the decision on it is not `helps`."""
    frozen: int = 0
    """Samples in which a sensor repeats one reading that its noise does not allow."""
    wrapped: int = 0
    """Samples in motions whose readings wrap around at the end of the range of the converter."""

    @property
    def exit_code(self) -> int:
        """
        0 when all is corrected, otherwise 3.

        The code is 3 when more than 1 % of the samples could not be read or are no readings, or
        when the decision on a sensor is not `helps`.
        """
        return exit_code_of(self.reasons)

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is 3, a line each."""
        lines = [f'the {sensor} is not corrected: {why}' for sensor, why in self.refused.items()]
        lines += self.cautions
        dropped = dict(self.lost)
        if self.frozen:
            dropped['frozen output'] = self.frozen
        if self.wrapped:
            dropped['wrapped'] = self.wrapped
        lost = dropped_text(dropped, self.count - self.frozen - self.wrapped)
        if lost:
            lines.append(lost)
        return lines

    def __repr__(self):
        return '\n'.join([f'<Compensated: {self.count} samples>', *self.warnings])


def compensate_recording(
    recording: str | PathLike | ImuSamples | SampleBlock,
    calibration: Calibration | str | PathLike,
    *,
    output: str | PathLike | None = None,
    corrected_topic: str = CORRECTED_TOPIC,
    target_frame: str = '',
    target_xyz: Sequence[float] = (0.0, 0.0, 0.0),
    target_rpy: Sequence[float] = (0.0, 0.0, 0.0),
    correct_stamps: bool = False,
    anyway: bool = False,
    noise: NoiseFigures | str | PathLike | None = None,
    imu_topic: str | None = None,
    gyroscope_topic: str | None = None,
    temperature_topic: str | None = None,
    frame_id: str | None = None,
    nominal: str | PathLike | RawReadings | None = None,
    accelerometer_unit: str | None = None,
    gyroscope_unit: str | None = None,
    increments: float | None = None,
    columns: Sequence[str] = (),
    where: Sequence[str] = (),
    exclude: str | None = None,
) -> Compensated:
    """
    Correct the calibrated errors in a recording.

    Parameters
    ----------
    recording : path-like, ImuSamples or SampleBlock
        A bag, or samples in memory (a block may bring temperatures).
    calibration : Calibration or path-like
    output : path-like, optional
        A rosbag2 folder to make: all topics of the recording, and the corrected one. For text logs
        also a text log to make (.csv): their columns, with corrected readings. Without it the
        corrected samples are returned.
    corrected_topic : str
        Name of the topic to add.
    target_frame : str
        Another frame of the same rigid body to move the readings to, in which the sensor sits at
        `target_xyz` (m), turned by `target_rpy` (roll, pitch, yaw, rad).
    correct_stamps : bool
        Move the stamps back by the calibration's time_offset.
    anyway : bool
        Also correct a sensor whose decision is `harms`. One whose decision is `unproven` is always
        corrected, with a warning.
    noise : NoiseFigures or path-like, optional
        noise.yaml of this IMU: the covariances of the corrected readings follow from it where the
        messages bring none.
    imu_topic, gyroscope_topic, temperature_topic : str, optional
        Topics to read; `gyroscope_topic` where the rates have one of their own. The corrected topic
        then follows the messages of the slower sensor.
    frame_id : str, optional
        frame_id of the Imu messages; required if the topic has messages of several.
    nominal, accelerometer_unit, gyroscope_unit, increments : optional
        Units of these readings where they differ from those of the calibration, see `Choices`.
    columns, where : sequence of str
        Columns and rows of a text log, see `Choices`.
    exclude : str, optional
        Times without corrected readings, 'A:B,...' in s since the first stamp of the IMU.

    Raises
    ------
    ImuCalibrationError
        When the calibration is not fit for correction, the recording is corrected already or lacks
        required temperatures, or the output exists.

    """
    choices = dict(locals())  # the arguments by name, among them some of `Choices`
    used = usable(files.given_calibration(calibration), anyway=anyway)
    calibration = used.calibration
    figures = noise_of(noise)
    if figures is not None:
        calibration = with_measured_noise(calibration, figures)
    readings = readings_for(calibration, choices)
    correction = _Correction(
        calibration=calibration,
        used=used,
        transfer=requested_transfer(target_frame, target_xyz, target_rpy),
        shift_ns=late_ns(calibration, correct_stamps),
        readings=readings,
        topics=topics_of(choices, readings),
        mask=ExclusionMask(parse_exclusions(exclude) if exclude else ()),
    )

    # Samples in memory, and text logs.
    if isinstance(recording, (ImuSamples, SampleBlock)):
        return _in_memory(recording, correction)
    if output is not None and Path(output).exists():
        raise InputError(
            f'the output {output} must not exist yet; choose another name or remove it',
            code='exists_already',
        )
    if output is not None and is_text_log(output):
        return _into_text_log(recording, output, correction)
    _refuse_corrected_log(recording)

    # A bag, block by block: into memory, or into another bag.
    if output is None:
        return _bag_in_memory(recording, correction)
    return _into_bag(
        recording,
        output,
        correction,
        corrected_topic=corrected_topic,
        target_frame=target_frame,
        excludes=bool(exclude),
    )


@dataclass(frozen=True, eq=False)
class _Correction:
    """A calibration, and the options of its application to one recording."""

    calibration: Calibration
    """The calibration as applied: without unusable sensors, with the measured noise."""
    used: Usable
    """Sensors that are not corrected, and cautions on the corrected ones."""
    transfer: Transfer | None
    """Move to another frame of the rigid body; None: none."""
    shift_ns: int
    """Subtracted from the stamps, ns."""
    readings: RawReadings
    """Units and axes of the readings."""
    topics: Topics
    """Topics of the recording."""
    mask: ExclusionMask
    """Times without corrected readings."""

    def samples(self, imu: ImuSamples, corrected: Corrected) -> ImuSamples:
        """Return corrected readings as samples; `imu`: the raw ones."""
        frame_id = imu.frame_id if self.transfer is None else self.transfer.frame_id
        return ImuSamples(imu.stamp_ns - self.shift_ns, corrected.force, corrected.rate, frame_id)


class _CorrectionRun:
    """Correction of the samples of one recording in order, with the checks of its raw readings."""

    def __init__(
        self,
        correction: _Correction,
        checks: 'RawChecks',
        temperature: TemperatureSamples | None,
        advance: Callable[[int], object] = lambda count: None,
    ):
        self.correction = correction
        self.checks = checks
        self.stream = CompensationStream(
            correction.calibration, temperature=temperature, transfer=correction.transfer
        )
        # Search for parts in which a sensor repeats one reading.
        self._frozen = FrozenSearch()
        # Called with the number of samples of each block, to show the progress.
        self._advance = advance

    def check(self, imu: ImuSamples) -> None:
        """Add raw samples to the checks."""
        self._advance(len(imu))
        self.checks.push(imu)
        self._frozen.push(imu.stamp_ns, imu.force_s, imu.rate_s)

    def correct(self, imu: ImuSamples) -> Corrected:
        """Check and correct the next raw samples."""
        self.check(imu)
        return self.stream.correct(self.correction.readings.apply(imu))

    def propagate(
        self, force_cov: np.ndarray | None, rate_cov: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the covariances of corrected readings, see `CompensationStream.propagate`."""
        # Measured covariances are in the units of the readings.
        readings = self.correction.readings
        if force_cov is not None:
            force_cov = readings.accelerometer.convert_covariance(force_cov)
        if rate_cov is not None:
            rate_cov = readings.gyroscope.convert_covariance(rate_cov)
        return self.stream.propagate(force_cov, rate_cov)

    def require_valid(self) -> None:
        """Raise for an excluded time without samples, or raw readings that no correction suits."""
        self.correction.mask.require_used()
        self.checks.require()

    def outcome(self, imu: ImuSamples | None, lost: dict[str, int]) -> Compensated:
        """
        Return the result after the last samples.

        `imu`: corrected samples, None if they were written; `lost`: reason -> unreadable messages.
        """
        stream = self.stream
        used = self.correction.used
        calibration = self.correction.calibration

        # Lines on the calibration, then on the readings.
        lines = [*used.lines, *caveats(calibration)]
        refused = dict(used.refused)
        for sensor in calibration.absent:
            if stream.measured[sensor]:  # readings without a calibration pass unchanged
                refused[sensor] = ABSENT
                lines.append(f'the {sensor} is not corrected: {ABSENT}')
        frozen = self._frozen.parts()
        lines += frozen_lines(frozen, 'the corrected topic has no measurements there')
        n_wrapped = self.checks.n_wrapped
        if n_wrapped:
            lines.append(
                f'{n_wrapped} samples are in motions whose readings wrap around at the end of'
                ' the range of the converter: their corrected readings are wrong; move less fast or'
                ' choose a wider range'
            )
        # Where the IMU is frozen, both sensors have the same part: it counts once.
        samples_of_part = {(part.start, part.stop): part.samples for part in frozen}
        return Compensated(
            imu=imu,
            count=stream.count,
            warnings=lines + stream.warnings(),
            lost=lost,
            refused=refused,
            cautions=(*used.cautions, *self.checks.cautions),
            frozen=sum(samples_of_part.values()),
            wrapped=n_wrapped,
        )


def _bag_in_memory(recording: str | PathLike, correction: _Correction) -> Compensated:
    """Correct the samples of a bag in memory; sensors on two topics as one stream."""
    topics = correction.topics
    if topics.gyroscope is not None:
        joined = read_split(recording, topics).joined.imu
        block = SampleBlock(joined, None, temperatures(recording, topics))
        return _in_memory(block, correction)
    checks = RawChecks(correction.readings, correction.calibration)
    with open_bag(recording, topics, want_joints=False) as bag:
        run = _run_over(bag, recording, correction, checks)
        parts = []
        for block in bag.blocks():
            if block.imu is not None:
                imu = block.imu.select(correction.mask.kept(block.imu.stamp_ns))
                parts.append(correction.samples(imu, run.correct(imu)))
        run.require_valid()
        return run.outcome(ImuSamples.concatenate(parts) if parts else None, bag.lost)


def _into_bag(
    recording: str | PathLike,
    output: str | PathLike,
    correction: _Correction,
    *,
    corrected_topic: str,
    target_frame: str,
    excludes: bool,
) -> Compensated:
    """
    Correct a bag into another one that has all its topics too.

    Of sensors on two topics the messages of the slower one are corrected, in the frame of the
    accelerometer. `excludes`: whether there are excluded times.
    """
    from msg_adapters.copying import copy_with_corrected

    checks = RawChecks(correction.readings, correction.calibration)
    topics = correction.topics
    output_frame = target_frame
    other: OtherSensor | None = None
    if topics.gyroscope is not None:
        split = read_split(recording, topics)
        joined = split.joined.imu
        checks.require_scale(joined.select(slice(UNIT_READINGS)))
        refuse_corrected(topics.gyroscope)
        other = split.other
        output_frame = target_frame or joined.frame_id
        if split.topic == topics.gyroscope:
            topics = topics._replace(imu=topics.gyroscope, frame=None)

    def keep(stamp_ns: np.ndarray) -> np.ndarray:
        """Return which messages have no excluded time, and a reading of the other sensor."""
        kept = correction.mask.kept(stamp_ns)
        return kept if other is None else kept & other.known(stamp_ns)

    with open_bag(recording, topics, want_joints=False) as bag:
        run = _run_over(bag, recording, replace(correction, topics=topics), checks)
        lost = copy_with_corrected(
            recording,
            output,
            bag.imu_topic,
            corrected_topic=corrected_topic,
            correct=run.correct,
            propagate=run.propagate,
            frame_id=output_frame or None,
            mat_ts=None if correction.transfer is None else correction.transfer.mat_ts,
            late_ns=correction.shift_ns,
            source_frame_id=topics.frame,
            log=topics.log,
            check=run.require_valid,
            keep=keep if excludes or other is not None else None,
            other=other,
        )
        return run.outcome(None, lost)


def _run_over(
    bag: Recording, recording: str | PathLike, correction: _Correction, checks: 'RawChecks'
) -> _CorrectionRun:
    """Return the correction of an open bag, which must hold raw readings in their units."""
    topics = correction.topics
    advance = counter('compensating', bag.message_counts.get(bag.imu_topic, 0))
    refuse_corrected(bag.imu_topic)
    if topics.gyroscope is None:  # otherwise the joined sensors are checked
        checks.require_scale(_first_readings(recording, topics))
    return _CorrectionRun(correction, checks, temperatures(recording, topics), advance)


def _into_text_log(
    recording: str | PathLike, output: str | PathLike, correction: _Correction
) -> Compensated:
    """Correct a text log into another one with the same columns."""
    from msg_adapters.csv_copy import write_corrected_log

    if not is_text_log(recording) and not is_log_folder(recording):
        raise InputError(
            f'a text log is made from a text log, got the recording {recording} and the output'
            f' {output}; name a folder for a bag',
            code='output_kind',
        )
    if correction.shift_ns:
        raise InputError(
            'stamps are copied as text into a text log and cannot be moved; name a folder for a'
            ' bag, or leave the stamps as they are',
            code='output_kind',
        )
    _refuse_corrected_log(recording)
    log = read_directly(existing(recording), correction.topics.log)
    result = _in_memory(SampleBlock(log.imu, None, log.temperature), correction)
    assert result.imu is not None  # a correction in memory returns its samples
    with files.output_folder(str(Path(output).parent)):
        write_corrected_log(output, log, result.imu)
    return replace(result, imu=None)


def _refuse_corrected_log(recording: str | PathLike) -> None:
    """Refuse text logs whose header states that their readings are corrected."""
    log = corrected_log(recording)
    if log is not None:
        raise InputError(
            f'the log must hold raw measurements, the header of {log} states corrected ones; give'
            ' the raw log',
            code='corrected_already',
        )


def _first_readings(recording: str | PathLike, topics: Topics) -> ImuSamples | None:
    """
    Return about `UNIT_READINGS` samples at the start of a bag; None without any.

    The bag is read a second time, so that nothing is written before they are checked.
    """
    parts = []
    count = 0
    with open_bag(recording, topics, want_joints=False) as bag:
        for block in bag.blocks():
            if block.imu is None:
                continue
            parts.append(block.imu)
            count += len(block.imu)
            if count >= UNIT_READINGS:
                break
    return ImuSamples.concatenate(parts) if parts else None


class RawChecks:
    """
    Checks of raw readings.

    `require_scale` checks unit and scale of the force before the correction; `push` and `require`
    check the stamps, the number of sensors and the unit of the rates of all readings.

    Parameters
    ----------
    readings : RawReadings
        Stated units of the readings.
    calibration : Calibration
        The calibration that corrects them.

    """

    def __init__(self, readings: RawReadings, calibration: Calibration):
        self._calibration = calibration
        self.cautions: tuple[str, ...] = ()
        """A line for each sensor whose corrected readings may have another scale than the truth."""
        self._readings = readings
        # Counts repeated stamps and wrapped readings, and recognises two sensors in one stream.
        self._check = StreamCheck(one_sensor=True)
        # Compares the rates with the turns of gravity.
        self._gatherer = EvidenceGatherer(STANDARD_GRAVITY)
        self._n_samples = 0

    def require_scale(self, imu: ImuSamples | None) -> None:
        """Raise where the first raw samples are in another unit than those of the calibration."""
        if imu is None:
            return
        refuse_units(imu, self._readings)
        force = self._readings.accelerometer.convert(imu.force_s)
        measured = np.isfinite(force).all(axis=1) & np.any(imu.force_s != 0.0, axis=1)
        if not measured.any() or 'accelerometer' in self._calibration.absent:
            return
        scale = GravityScale(self._calibration)
        lengths = scale.lengths(force[measured])
        error = scale.error(lengths)
        if error is not None:
            raise error
        question = scale.question(lengths)
        if question:
            self.cautions += (question,)

    def push(self, imu: ImuSamples) -> None:
        """Process raw samples; the unit of the rates needs readings of both sensors."""
        applied = self._readings.apply(imu)
        self._n_samples += len(imu)
        self._check.push(applied)
        finite = np.isfinite(imu.force_s).all(axis=1) & np.isfinite(imu.rate_s).all(axis=1)
        if finite.any():
            self._gatherer.push_imu(applied.select(finite))

    def require(self) -> None:
        """
        Raise for equal stamps, two sensors, or rates in another unit or at another scale.

        It is called after the last samples.
        """
        self._check.finish()
        n_repeated = self._check.counts['repeated stamp']
        if is_one_stamp(n_repeated, self._n_samples):
            text = one_stamp_text('Imu', n_repeated, self._n_samples)
            raise InputError(text, code='stamps_equal')
        self._check.sources.require_one()
        evidence = self._gatherer.evidence({}, self._readings)
        refuse(tuple(rate_unit(evidence)))
        matrix = self._calibration.of('gyroscope', Role.LINEAR)
        if evidence.turning is None or matrix is None or 'gyroscope' in self._calibration.absent:
            return
        # With the raw rate w the corrected one is w / gain, and the true one by the turns of
        # gravity is factor w: their ratio.
        gain = float(np.mean(np.diag(matrix)))
        ratio = 1.0 / (evidence.turning.factor * gain)
        text = corrected_rates_text(ratio)
        if scale_range(ratio) is IMPOSSIBLE:
            raise InputError(text, key='gyroscope_unit', code='corrected_scale')
        if scale_range(ratio) is DOUBTFUL:
            self.cautions += (text,)

    @property
    def n_wrapped(self) -> int:
        """Samples in motions whose readings wrap around, after `require`."""
        return self._check.counts['wrapped']


def _in_memory(recording: ImuSamples | SampleBlock, correction: _Correction) -> Compensated:
    """Correct samples in memory; in excluded times corrected readings are NaN."""
    block = recording if isinstance(recording, SampleBlock) else SampleBlock(recording)
    # A recording in memory has samples of an IMU.
    assert block.imu is not None
    kept = correction.mask.kept(block.imu.stamp_ns)
    correction.mask.require_used()
    imu = block.imu.select(kept)
    checks = RawChecks(correction.readings, correction.calibration)
    checks.require_scale(imu)
    run = _CorrectionRun(correction, checks, block.temperature)
    # All readings are checked before one is corrected.
    run.check(imu)
    checks.require()
    corrected = correction.samples(imu, run.stream.correct(correction.readings.apply(imu)))
    if not kept.all():
        # One row for each sample, as the caller gave them.
        force, rate = np.full((2, len(kept), 3), np.nan)
        force[kept] = corrected.force_s
        rate[kept] = corrected.rate_s
        stamp_ns = block.imu.stamp_ns - correction.shift_ns
        corrected = ImuSamples(stamp_ns, force, rate, corrected.frame_id)
    return run.outcome(corrected, {})

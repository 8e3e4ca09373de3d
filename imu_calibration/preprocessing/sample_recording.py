"""The samples of a recording: cleaned, with the findings of the checks of the recording."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples, JoinedParts, SampleBlock, TemperatureSamples
from imu_calibration.preprocessing.absent_sensor import without_sensor
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.recording_evidence import WARNING, CheckFinding
from imu_calibration.preprocessing.sensor_join import GyroscopeDelay, delay_of
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner, ContinuedStamps, outside


@dataclass(frozen=True, eq=False)
class SampleRecording:
    """The samples of a recording, cleaned; its joints are not read."""

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


def read_recording(
    blocks: Iterable[SampleBlock],
    nominal: RawReadings | None = None,
    preflight: Preflight | None = None,
) -> SampleRecording:
    """
    Return the `SampleRecording` of a complete stream of SampleBlock.

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
    # The epochs of the clock follow one another with a pause: no turn is used across a reset.
    stamps = ContinuedStamps()
    shift_of_epoch = {}
    joined = JoinedParts()
    temperatures = []
    for cleaned in cleaner.all_of(blocks):
        for epoch, imu in cleaned.imu:
            joined.add(stamps.moved(epoch, imu))
            shift_of_epoch[epoch] = stamps.shift_ns
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
    temperature_c = None
    if temperatures:
        moved = []
        for epoch, part in temperatures:
            shift_ns = shift_of_epoch.get(epoch, stamps.shift_ns)
            moved.append(replace(part, stamp_ns=part.stamp_ns + shift_ns))
        readings = TemperatureSamples.concatenate(moved)
        start = imu.stamp_ns[0]  # epochs in nanoseconds do not fit a float
        temperature_c = np.interp(
            (imu.stamp_ns - start).astype(float),
            (readings.stamp_ns - start).astype(float),
            readings.temperature_c,
        )
    counts = dict(cleaner.lost)
    for reason, count in cleaner.counts.items():
        if reason.startswith('imu '):
            counts[reason] = count
    counts = {reason: count for reason, count in counts.items() if count}
    return SampleRecording(imu, temperature_c, counts, findings, delay, unusable_sensors)


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

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
from imu_calibration.preprocessing.stream_cleaning import (
    BlockCleaner,
    ContinuedStamps,
    samples_outside,
)


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
    # 1. The cleaned samples. The epochs of the clock follow one another with a pause: no turn is
    #    used across a reset.
    watchers = [] if preflight is None else [preflight]
    cleaner = BlockCleaner(nominal=nominal, watchers=watchers, one_sensor=True)
    stamps = ContinuedStamps()
    shift_of_epoch = {}
    joined = JoinedParts()
    temperatures = []
    for cleaned in cleaner.all_of(blocks):
        for epoch, part in cleaned.imu:
            joined.add(stamps.moved(epoch, part))
            shift_of_epoch[epoch] = stamps.shift_ns
        temperatures += cleaned.temperature
    if not len(joined):
        raise InputError(
            'the recording must hold Imu messages that can be used, it holds none; check the topic'
        )
    imu = joined.samples()

    # 2. Without the samples that are no readings, and the findings of the checks.
    findings: tuple[CheckFinding, ...] = ()
    unusable_sensors: dict[str, str] = {}
    if preflight is not None:
        imu = _readings_only(imu, preflight.without_readings)
        unusable_sensors = preflight.unusable
        for sensor in unusable_sensors:
            imu = without_sensor(imu, sensor)
    delay = delay_of(imu)
    if preflight is not None:
        findings = (*preflight.findings, *late_gyroscope(delay))
        preflight.findings = findings

    # 3. The temperature at the samples, with the shifts of their epochs. An epoch without samples
    #    has the last shift.
    temperature_c = None
    if temperatures:
        moved = []
        for epoch, readings in temperatures:
            shift_ns = shift_of_epoch.get(epoch, stamps.shift_ns)
            moved.append(replace(readings, stamp_ns=readings.stamp_ns + shift_ns))
        temperature_c = _temperature_at(imu.stamp_ns, TemperatureSamples.concatenate(moved))

    counts = {reason: count for reason, count in cleaner.lost.items() if count}
    for reason, count in cleaner.counts.items():
        if count and reason.startswith('imu '):
            counts[reason] = count
    return SampleRecording(imu, temperature_c, counts, findings, delay, unusable_sensors)


def _temperature_at(stamp_ns: np.ndarray, readings: TemperatureSamples) -> np.ndarray:
    """Return the temperature at stamps, interpolated linearly, degrees Celsius, shape (n,)."""
    start_ns = stamp_ns[0]  # epochs in nanoseconds do not fit a float
    return np.interp(
        (stamp_ns - start_ns).astype(float),
        (readings.stamp_ns - start_ns).astype(float),
        readings.temperature_c,
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
    readings = samples_outside(ranges, imu)
    if not len(readings):
        raise InputError(
            f'the recording must hold readings, in all of its {len(imu)} samples an output is'
            ' frozen; check the sensor and its driver',
            code='frozen',
        )
    return readings

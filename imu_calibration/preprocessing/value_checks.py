"""
Checks of the readings: units, axes, clipping outputs, biases, gravity, resolution, temperature.
"""

from collections.abc import Iterator
from itertools import chain

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import (
    SI_ACCELEROMETER,
    SI_UNITS,
    UNIT_SIZES,
    RawReadings,
    SensorUnit,
)
from imu_calibration.core.samples import ImuSamples
from imu_calibration.core.scales import IMPOSSIBLE, USUAL, scale_range
from imu_calibration.core.units import (
    DEG,
    GRAVITY_PLACE_SHARE,
    STANDARD_GRAVITY,
    significant,
    unit_of_rest,
)
from imu_calibration.preprocessing.full_scale import FACTORS, Extremes, Turning, nearest_power
from imu_calibration.preprocessing.on_table import MIN_MATCH, match_axes
from imu_calibration.preprocessing.recording_evidence import (
    GOOD,
    NOTE,
    REFUSE,
    WARNING,
    CheckFinding,
    RecordingEvidence,
)
from imu_calibration.preprocessing.scan import SENSOR_COLUMNS

GRAVITY_SHARE = 0.02
"""Share by which gravity at rest may differ from the local one."""
LINEAR = 0.8
"""
m/s^2; a shorter specific force at rest is noise and bias of an acceleration without gravity.
Readings in g have at least 0.8.
"""
INCREMENT_AGREEMENT = 0.15
"""
Readings are increments over one sample where their length times the samples per second differs from
gravity by less than this share.
"""
SAME_PER_SECOND = 0.02
"""Relative difference up to which the samples per second are those that were stated."""
MAX_GYRO_RATE = 100.0
"""rad/s, 5700 deg/s: above the range of nearly all gyroscopes."""
FASTEST_DEG = 5000.0
"""Numbers above it are no deg/s either."""
LEAST_END_PER_GRAVITY = 1.15
"""
Least end of the range of an accelerometer without visible noise, over gravity: its outputs pile up
at gravity without being clipped.
"""
VISIBLE_NOISE_STEPS = 8.0
"""Noise that spans this many steps of the converter is visible."""
LEAST_END_PER_NOISE = 10.0
"""Least end of the range of a sensor over the range of its noise."""
LEAST_RANGE = 0.4
"""rad/s, 23 deg/s: a largest rate below it is not the end of the range of a gyroscope."""
MOST_BIAS = {'accelerometer': 0.25 * STANDARD_GRAVITY, 'gyroscope': 60 * DEG}
"""m/s^2, rad/s: several times the specification of the cheapest grades (0.1 g, 20 deg/s)."""
REPEATED_SHARE = 0.05
"""Share of repeated samples above which they are reported."""
MIN_CONVERTER_STEP = 1e-6
"""m/s^2, rad/s; no converter is that fine."""


def force_unit(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Specific force is in m/s^2."""
    length = evidence.force_length
    if length is None or 'accelerometer' in evidence.absent or not evidence.n_changed[:3].any():
        return  # outputs that never change are no unit: see the check of frozen outputs
    where = 'at rest' if evidence.rest is not None else 'in the middle'
    imu = evidence.streams.get('imu')
    per_second = imu.rate if imu is not None else 0.0
    error = force_error(length, where, evidence.readings.accelerometer, per_second=per_second)
    if error is not None:
        yield _refusal(error)
    else:
        yield CheckFinding(
            'force_unit', GOOD, f'specific force in m/s^2: its length is {length:.3f}'
        )


def _refusal(error: InputError) -> CheckFinding:
    """Return an error of the readings as a finding."""
    return CheckFinding(error.code, REFUSE, str(error), key=error.key, value=error.value)


def force_error(
    length: float,
    where: str = 'at rest',
    stated: SensorUnit = SI_ACCELEROMETER,
    *,
    per_second: float = 0.0,
) -> InputError | None:
    """
    Return the error for a median length of the specific force that is not gravity in m/s^2.

    None for one that can be.

    Parameters
    ----------
    length : float
        After the conversion from the stated unit, m/s^2.
    where : str
        Part of the recording with this length.
    stated : SensorUnit
        Unit of the readings as it was stated.
    per_second : float
        Samples per second, for the search of increments; 0: not known.

    """
    # 1. A unit in which the readings have the length of gravity; '' for none, and for m/s^2.
    raw_length = length if stated.is_si else length * float(np.mean(stated.scale))
    unit = unit_of_rest(raw_length)
    requirement = f'specific force must be in m/s^2, its length {where} is {length:.4g}: '
    remedy = 'convert it in the driver'
    if not stated.is_si:
        if _is_force(raw_length):
            unit = unit or 'm/s^2'
        requirement = (
            f'specific force must be in the stated unit {stated.unit}, the length of the readings'
            f' {where} is {raw_length:.4g}: '
        )
        remedy = 'give the recording that the unit belongs to'
    is_wrong = not _is_force(length)
    # Only readings in SI must not look like another unit: a stated one explains their length.
    if unit and (is_wrong or stated.is_si):
        return InputError(
            f'{requirement}it is probably {unit}; {remedy}',
            key='accelerometer_unit',
            code='force_unit',
            value=unit,
        )
    # 2. Increments over one sample, which have the length of gravity per second.
    gravity_ratio = length * per_second / STANDARD_GRAVITY
    if is_wrong and stated.is_si and abs(gravity_ratio - 1.0) < INCREMENT_AGREEMENT:
        return InputError(
            f'{requirement}increments per sample? Times {per_second:.4g} Hz it is'
            f' {length * per_second:.4g}; {remedy}',
            key='increments',
            code='increments',
            value=f'{per_second:.4g}',
        )
    # 3. Hardly any force at rest, then any other length that is not gravity.
    if length < LINEAR:
        return InputError(
            f'{requirement}it is probably acceleration without gravity, as phones compute it;'
            ' record the raw accelerometer',
            key='imu_topic',
            code='without_gravity',
        )
    if is_wrong:
        return InputError(
            f'{requirement}counts or volts?; {remedy}',
            key='accelerometer_unit',
            code='force_unit',
            value='counts:NUMBER/g',
        )
    return None


def increments(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Increments over one sample have the stated samples per second."""
    imu = evidence.streams.get('imu')
    if imu is None or not imu.rate:
        return
    error = increments_error(imu.rate, evidence.readings)
    if error is not None:
        yield _refusal(error)


def increments_error(per_second: float, readings: RawReadings) -> InputError | None:
    """Return the error for increments over samples that are not those of the stream, or None."""
    for unit in (readings.accelerometer, readings.gyroscope):
        stated = unit.per_second
        if stated and abs(per_second / stated - 1.0) > SAME_PER_SECOND:
            return InputError(
                f'increments must be over the samples of the recording, {unit.unit} is stated and'
                f' it has {per_second:.4g} samples per second; give the recording that the unit'
                ' belongs to, or state its rate',
                key='increments',
                code='increments_rate',
                value=f'{per_second:.4g}',
            )
    return None


def samples_per_second(stamp_ns: np.ndarray) -> float:
    """Return one over the median step between stamps, (n,), Hz; 0 where none advances."""
    step_ns = median_step(stamp_ns)
    return 1e9 / step_ns if step_ns else 0.0


def median_step(values: np.ndarray) -> float:
    """Return the median of the positive steps from value to value, shape (n,); 0.0 without any."""
    steps = np.diff(values)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 0.0


def refuse_units(imu: ImuSamples, readings: RawReadings = RawReadings()) -> None:
    """
    Raise the error of `force_error` for raw readings that are in another unit.

    The median length decides, so that a motion in part of them does not. Readings that are zero or
    not finite are no measurement of gravity. Increments must be over the samples of this stream.
    """
    stated = readings.accelerometer
    force = imu.force_s
    per_second = samples_per_second(imu.stamp_ns)
    error = increments_error(per_second, readings) if per_second else None
    if error is not None:
        raise error
    measured = np.isfinite(force).all(axis=1) & np.any(force != 0.0, axis=1)
    length = np.linalg.norm(stated.convert(force[measured]), axis=1)
    if len(length) == 0:
        return
    median = float(np.median(length))
    error = force_error(median, 'in the recording', stated, per_second=per_second)
    if error is not None:
        raise error


def wrong_rate_unit(text: str, unit: str = 'counts:NUMBER/(deg/s)') -> CheckFinding:
    """Return the refusal of rates in another unit than rad/s, probably `unit`."""
    return CheckFinding('rate_unit', REFUSE, text, key='gyroscope_unit', value=unit)


def rate_unit(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Angular rate is in rad/s: gravity turns by the integral of the rates."""
    # Turns are compared with the rotation of gravity; without turns the largest rate decides.
    if evidence.turning is not None:
        yield from _unit_by_turns(evidence, evidence.turning)
        return
    stated = evidence.readings.gyroscope
    ends_of_rates = chain.from_iterable(evidence.ends[3:])
    largest = max((end.level for end in ends_of_rates), default=0.0)
    if largest > MAX_GYRO_RATE:
        unit = 'counts or volts'
        proposed = 'counts:NUMBER/(deg/s)'
        if largest < FASTEST_DEG and stated.is_si:
            unit = proposed = 'deg/s'
        yield wrong_rate_unit(
            f'angular rates must be in {stated.unit}, the largest is {largest:.4g} rad/s, faster'
            f' than gyroscopes measure: {unit}?; convert them in the driver',
            proposed,
        )


def _unit_by_turns(evidence: RecordingEvidence, turning: Turning) -> Iterator[CheckFinding]:
    """Yield the finding of the unit of the rates by the turns of gravity."""
    stated = evidence.readings.gyroscope
    ratio = 1.0 / turning.factor
    wanted = 'in rad/s'
    convert = 'convert them in the driver'
    if not stated.is_si:
        wanted = f'in the stated unit {stated.unit}'
        convert = 'give the recording that the unit belongs to'
    observed = (
        f'angular rates must be {wanted}, they are {significant(ratio)} times the rotation of'
        ' the measured gravity: '
    )
    unit = _unit_of_ratio(ratio * float(np.mean(stated.scale)))
    if unit and scale_range(ratio) is IMPOSSIBLE:
        yield wrong_rate_unit(f'{observed}probably {unit}; {convert}', unit)
    elif 0.6 < ratio / DEG < 1.6:
        yield wrong_rate_unit(
            f'{observed}probably converted from deg/s twice; convert them once',
            f'counts:{DEG:.7g}/(rad/s)',
        )
    elif _full_scale_factor(evidence) is not None:
        return  # `full_scale` reports it
    elif scale_range(ratio) is IMPOSSIBLE:
        yield wrong_rate_unit(f'{observed}counts or volts?; {convert}')
    else:
        axes = _axes(turning.axes)
        about = f' about {axes}' if axes else ''
        yield CheckFinding(
            'rate_unit',
            GOOD,
            f'angular rate in rad/s: gravity rotates according to the rates{about}',
        )


def _unit_of_ratio(ratio: float) -> str:
    """Return the unit of rates that are `ratio` times the true ones in rad/s; '' for none."""
    for unit, size in UNIT_SIZES['gyroscope'].items():
        # The turns of gravity give the ratio to a few tenths; units differ by more.
        if 0.6 < ratio * size < 1.6:
            return unit
    return ''


def full_scale(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """
    The driver converts for the set full-scale range.

    Gravity turns from rest to rest by the integral of the rates.
    """
    factor = _full_scale_factor(evidence)
    if factor is None:
        return
    observed = (
        f'angular rates are {factor:.3g} times the rotation of gravity from one rest to the next'
    )
    if scale_range(factor) is not USUAL:
        observed += ': is their unit right? If it is'
    cause = 'the scale of the driver is wrong; correct it, or check that the IMU was at rest'
    if abs(np.log2(factor)) % 1 == 0:
        cause = (
            f'the driver converts for {factor:.3g} times the full-scale range that is'
            ' set; correct its setting (a calibration would include the factor in the matrix, and'
            ' be wrong after the correction)'
        )
    yield CheckFinding('full_scale', WARNING, f'{observed}, {cause}')


def _full_scale_factor(evidence: RecordingEvidence) -> float | None:
    """
    Return measured over true rates if a wrong full-scale range may explain the ratio, else None.
    """
    factor = evidence.rate_factor
    if factor is None and evidence.turning is not None:
        # Without turns between rests the ratio is less accurate. Ranges differ by powers of two, so
        # that only these are accepted.
        factor = nearest_power(1.0 / evidence.turning.factor)
        if np.log2(factor) % 1 != 0:
            return None
    if factor is None or factor == 1.0:
        return None
    # A factor at or beyond the ends of the tested ones is that of another unit.
    return factor if FACTORS[0] < factor < FACTORS[-1] else None


def handedness(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Accelerometer and gyroscope have the same axes: gravity turns the way the rates turn."""
    turning = evidence.turning
    if turning is None:
        return
    match = match_axes(turning.matrix, turning.seen)
    if not match.wrong:
        if turning.everywhere:
            yield CheckFinding(
                'handedness', GOOD, 'accelerometer and gyroscope share right-handed axes'
            )
        return
    phrases = []
    for i, j, sign in match.exchanges(turning.seen):
        minus = 'minus ' if sign < 0 else ''
        phrases.append(f"the gyroscope's {'xyz'[j]} is {minus}the accelerometer's {'xyz'[i]}")
    exchanges = ', '.join(phrases)
    if not exchanges or match.agreement < MIN_MATCH:
        exchanges = 'no exchange of axes makes them fit'
    kind = 'turned or left-handed, not separable in this recording'
    if not match.mirrored:
        kind = 'one is turned against the other'
    elif not match.turned:
        kind = 'one of them is left-handed'
    yield CheckFinding(
        'handedness',
        REFUSE,
        'accelerometer and gyroscope must share right-handed axes, gravity does not rotate'
        f' according to the rates: {exchanges} ({kind}); correct signs and order of the axes in the'
        ' driver',
    )


def clipping(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """
    No output piles up at the end of its range.

    The finding of a sensor has the number of clipped readings of each axis, at both ends together.
    """
    for sensor, unit in SI_UNITS.items():
        n_of_axes, range_end = _clipped_readings(evidence, sensor)
        if n_of_axes.any():
            listed = ', '.join(f'{axis} {n}' for axis, n in zip('xyz', n_of_axes, strict=True) if n)
            customary = f' ({range_end / STANDARD_GRAVITY:.1f} g)'
            if unit == 'rad/s':
                customary = f' ({range_end / DEG:.0f} deg/s)'
            yield CheckFinding(
                'clipping',
                WARNING,
                f'the {sensor} clips at {range_end:.4g} {unit}{customary}: {listed}'
                ' readings at the end of the range; larger values are lost, move less or choose a'
                ' wider range',
                samples=int(n_of_axes.sum()),
            )


def _clipped_readings(evidence: RecordingEvidence, sensor: str) -> tuple[np.ndarray, float]:
    """
    Return the number of clipped readings of each axis, shape (3,), and the end of their range.

    The end is 0 without any.
    """
    part = SENSOR_COLUMNS[sensor]
    has_noise = evidence.quiet_range[part] > VISIBLE_NOISE_STEPS * evidence.resolution[part]
    least_end = _least_end(evidence, sensor, has_noise)
    # The reading that the sensor repeats in each frozen chunk, shape (n_frozen_chunks, 3).
    frozen_readings = evidence.chunks.mean[evidence.frozen[sensor], part]
    n_of_axes = np.zeros(3, int)
    range_end = 0.0
    for axis, ends in enumerate(evidence.ends[part]):
        # The largest readings upwards, and those downwards with the other sign.
        for sign, end in zip((1, -1), ends):
            # Without visible noise the largest reading must have been reached by large steps.
            if end.level <= least_end[axis] or not (has_noise[axis] or end.jumped):
                continue
            n_clipped = _n_clipped(end, sign * frozen_readings[:, axis], evidence.chunks.size)
            if n_clipped:
                n_of_axes[axis] += n_clipped
                range_end = max(range_end, end.level)
    return n_of_axes, range_end


def _least_end(evidence: RecordingEvidence, sensor: str, has_noise: np.ndarray) -> np.ndarray:
    """
    Return the reading of each axis above which its range may end, m/s^2 or rad/s, shape (3,).

    `has_noise` are the axes with visible noise, bool, shape (3,).
    """
    least_end = LEAST_END_PER_NOISE * evidence.quiet_range[SENSOR_COLUMNS[sensor]]
    if sensor == 'gyroscope':
        return np.maximum(least_end, LEAST_RANGE)
    rest_force = evidence.force_length or 0.0
    return np.where(has_noise, least_end, LEAST_END_PER_GRAVITY * rest_force)


def _n_clipped(end: Extremes, frozen_readings: np.ndarray, chunk_size: int) -> int:
    """
    Return how many readings of an axis are clipped at an end of its range.

    A sensor that is frozen at its largest reading repeats it without being clipped: a pile of this
    reading that the frozen chunks explain counts as 0.

    Parameters
    ----------
    end : Extremes
        Largest readings of the axis in one direction.
    frozen_readings : array, shape (n_frozen_chunks,)
        Readings of the frozen chunks, with the sign of that direction.
    chunk_size : int
        Samples of a chunk.

    """
    frozen_at_end = np.isclose(frozen_readings, end.level, rtol=1e-9)
    n_frozen = chunk_size * int(frozen_at_end.sum())
    # A frozen stretch may begin within one chunk and end within another.
    return end.n_clipped if not n_frozen or end.n_clipped > n_frozen + 2 * chunk_size else 0


def _is_force(length: float) -> bool:
    """Return whether a length can be that of gravity in m/s^2."""
    return scale_range(length / STANDARD_GRAVITY) is not IMPOSSIBLE


def bias(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """The biases are such as sensors have."""
    rest = evidence.rest
    if rest is None or rest.bias is None or not _is_force(evidence.force_length):
        # With few attitudes, a steady spin about the vertical is not distinguishable from rest
        return
    biases = {'accelerometer': rest.bias, 'gyroscope': rest.rate}
    for sensor, unit in SI_UNITS.items():
        size = float(np.linalg.norm(biases[sensor]))
        if size > MOST_BIAS[sensor]:
            customary = f'{size / DEG:.0f} deg/s'
            if sensor == 'accelerometer':
                customary = f'{size / STANDARD_GRAVITY:.2f} g'
            values = ', '.join(f'{value:+.2f}' for value in biases[sensor])
            yield CheckFinding(
                'bias',
                WARNING,
                f'the bias of the {sensor} is {customary} ([{values}] {unit}), more than any grade'
                ' of sensor has; check offsets in the driver, the supply and the soldering of the'
                ' sensor',
            )


def gravity(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """The accelerometer reads local gravity within 2 per cent."""
    rest = evidence.rest
    if rest is None or 'accelerometer' in evidence.absent or not _is_force(evidence.force_length):
        return
    error = rest.length / evidence.gravity - 1
    source = 'one stretch'
    if rest.sphere is not None:
        bias = np.linalg.norm(rest.sphere.centre)
        source = f'{len(rest.force)} poses, bias of {bias:.2f} m/s^2 subtracted'
    elif len(rest.force) > 1:
        source = f'median of {len(rest.force)} stretches'
    cause = 'scale or bias is wrong'
    if scale_range(1.0 + error) is not USUAL:
        cause = 'is the unit right? If it is, ' + cause
    if abs(error) > GRAVITY_SHARE:
        yield CheckFinding(
            'gravity',
            WARNING,
            f'gravity must read {evidence.gravity:.3f} m/s^2 within 2 %, the accelerometer reads'
            f' {rest.length:.3f} ({source}), {100 * error:+.1f} %: {cause} (gravity'
            f' differs by {100 * GRAVITY_PLACE_SHARE} % between sites)',
        )
    else:
        yield CheckFinding(
            'gravity',
            GOOD,
            f'gravity reads {rest.length:.3f} m/s^2, {100 * error:+.1f} % ({source})',
        )


def dead_band(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Small rates are measured."""
    bands = evidence.dead_band
    if bands.any():
        yield CheckFinding(
            'dead_band',
            WARNING,
            f'the gyroscope has a dead band on {_axes(bands > 0)}, rates below'
            f' {significant(float(bands.max()) / DEG)} deg/s are given as 0: its bias and noise at'
            ' rest are not measured; switch it off in the driver or in the sensor',
        )


def repeated_readings(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Every message carries a new measurement."""
    # Samples while both sensors are frozen repeat readings too, and are reported by `frozen`.
    n_frozen = evidence.chunks.size * int(np.logical_and(*evidence.frozen.values()).sum())
    share = (evidence.n_repeated - n_frozen) / max(evidence.n_samples, 1)
    # Without noise a sensor repeats its readings at rest.
    has_noise = True
    for sensor, part in SENSOR_COLUMNS.items():
        if sensor not in evidence.absent:
            has_noise &= bool(evidence.quiet_range[part].all())
    if share > REPEATED_SHARE and has_noise:
        yield CheckFinding(
            'repeated_readings',
            WARNING,
            f'{100 * share:.0f} % of the samples repeat all six readings of the one before: the'
            ' driver publishes faster than the sensor measures, and noise is underestimated;'
            ' publish each measurement once',
        )


def resolution(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """The step of the converter is finer than the noise."""
    if evidence.rest is None:
        return
    for sensor, part in SENSOR_COLUMNS.items():
        step = evidence.resolution[part]
        extent = evidence.rest.range[part]
        # Rounding shows as few different readings; noise of one sd spans about four in a chunk.
        coarse = (step > MIN_CONVERTER_STEP) & (4 * step > extent)
        constant = coarse & (extent == 0)
        if coarse.any():
            size = step[coarse].max()
            customary = f'{size:.2g} m/s^2, {1e3 * size / STANDARD_GRAVITY:.2g} mg'
            if sensor == 'gyroscope':
                customary = f'{size / DEG:.2g} deg/s'
            yield CheckFinding(
                'resolution',
                NOTE,
                f'the {sensor} is read in steps of {customary}, coarser than its noise on'
                f' {_axes(coarse)}'
                + (f' and constant at rest on {_axes(constant)}' if constant.any() else '')
                + ': means over short windows are rounded too; the noise is at least step/sqrt(12)',
            )


def temperature(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Temperatures are in degrees Celsius."""
    if evidence.temperature_c is None:
        return
    low, high = evidence.temperature_c
    if low < -80 or high > 180:
        kelvin = ': kelvin?' if 200 < low and high < 450 else ''
        yield CheckFinding(
            'temperature',
            WARNING,
            f'temperature must be in degrees Celsius, it lies between {low:.1f} and '
            f'{high:.1f}{kelvin}; convert it in the driver',
        )
    else:
        yield CheckFinding(
            'temperature', GOOD, f'temperature {low:.1f} to {high:.1f} degrees Celsius'
        )


def _axes(flags: np.ndarray) -> str:
    """Return the letters of the axes with a true flag, shape (3,)."""
    return ', '.join(np.array(list('xyz'))[np.asarray(flags, bool)])

"""The noise figures as sentences and rows, for the terminal and the report; and the position error of dead reckoning that they cause."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.allan.document import TERMS, UNITS
from imu_calibration.allan.figures import HORIZON, SLOW, AxisFigures, NoiseFigures
from imu_calibration.allan.processes import RANDOM_WALK, WHITE, NoiseProcess, mean_covariance
from imu_calibration.allan.terms import DETERMINED, HELD, TIME, WEAK, Term
from imu_calibration.core.constants import STANDARD_GRAVITY
from imu_calibration.core.units import NOISE, for_people, significant
from imu_calibration.effects.base import AXES, SENSORS, UNIT

FINEST, MOST_BLOCKS = 150, 1000
"""Blocks of the run at most, and of alignment and run together."""
RUNS = (1.0, 10.0, 60.0, 600.0)
"""Lengths of dead reckoning, s."""


def position_budget(figures: NoiseFigures) -> list[tuple[float, dict[str, float]]]:
    """Return the standard deviation of the position along one horizontal axis after each of `RUNS`, m, by sensor, of the worst axes."""
    return [(seconds, {sensor: max(_of_axis(axis, sensor, seconds) for axis in figures.sensor(sensor)) for sensor in SENSORS})
            for seconds in RUNS]


def _of_axis(axis: AxisFigures, sensor: str, seconds: float) -> float:
    processes = axis.processes()
    shares = position_sd([process for process, _ in processes], [coefficient for _, coefficient in processes], sensor, seconds=seconds)
    return float(np.sqrt((shares**2).sum()))


def position_sd(processes: Sequence[NoiseProcess], coefficients: Sequence[float], sensor: str, *, seconds: float,
                alignment: float = 60.0, gravity: float = STANDARD_GRAVITY) -> np.ndarray:
    """
    Return the standard deviation of the position by each process of one axis, m, shape (n_processes,).

    Parameters
    ----------
    processes : sequence of NoiseProcess
    coefficients : sequence of float
        Squares of the figures.
    sensor : str
        'accelerometer' or 'gyroscope'.
    seconds : float
        Length of the run.
    alignment : float
        Time at rest before it, over which the bias is averaged, s.
    gravity : float
        m/s^2.

    """
    after = int(np.ceil(min(FINEST, MOST_BLOCKS * seconds / (seconds + alignment))))
    step = seconds / after
    before = max(round(alignment / step), 1)
    until_end = (after - np.arange(after) - 0.5) * step
    weights = until_end * step if sensor == 'accelerometer' else 0.5 * gravity * until_end**2 * step
    weights = np.concatenate([np.full(before, -weights.sum() / before), weights])
    lag = (np.arange(before + after)[:, None] - np.arange(before + after)[None, :]) * step
    variances = [weights @ mean_covariance(process, lag, step) @ weights for process in processes]
    return np.sqrt(np.maximum(np.array(variances), 0.0) * np.asarray(coefficients, float))


TITLES = {'quantisation': 'quantisation Q', 'white_noise': 'white noise N', 'bias_instability': 'bias instability B',
          'gauss_markov': 'Gauss–Markov σ', TIME: 'correlation time τ', 'random_walk': 'random walk K',
          'temperature': 'follows the temperature', 'turn_on': 'settles after turn-on', 'ramp': 'drifts steadily'}
BASIS = {'walk': 'as found', 'equivalent': 'equivalent of the slow noise', 'bound': 'none detected: upper limit'}
NO_BOUND = 'no bound'
WORTH_SAYING = 0.04
"""Scatter of the variances between rests above which it is reported: two per cent of the noise."""


@dataclass(frozen=True)
class FigureRow:
    """One figure of one axis as text."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    axis: str
    """'x', 'y' or 'z'."""
    name: str
    """Name in noise.yaml."""
    title: str
    """Usual name, with its letter."""
    value: str
    """The figure; '<' and the upper end where it is held."""
    interval: str
    """95 %."""
    unit: str
    """The unit that data sheets use."""
    status: str
    """'determined', 'weak' or 'held'."""
    note: str
    """Why it is not determined, and for how long one must record."""


def rows(figures: NoiseFigures) -> list[FigureRow]:
    """Return the figures of all axes, sensor by sensor, figure by figure."""
    found = []
    for sensor in SENSORS:
        for name in TERMS:
            for letter, axis in zip(AXES, figures.sensor(sensor)):
                if name in axis.terms:
                    found.append(_row(sensor, letter, axis, axis.terms[name]))
    return found


def _row(sensor, letter, axis, term):
    factor, unit = for_people(UNITS[sensor][term.name], NOISE)
    lower, upper = (end * factor for end in term.interval)
    if term.value is None:
        value, interval = f'< {significant(upper)}' if np.isfinite(upper) else NO_BOUND, ''
    else:
        value = _digits(term.value * factor, upper - lower)
        interval = f'{_digits(lower, upper - lower)} … {_digits(upper, upper - lower)}'
    return FigureRow(sensor, letter, term.name, TITLES[term.name], value, interval, unit, term.status, _note(axis, term))


def _digits(value, width):
    """Return a value with the digits that an interval of this width supports."""
    if not np.isfinite(width) or width <= 0 or not 0 < value < np.inf:
        return '0' if value == 0 else _bounded(value)
    return significant(value, int(np.clip(np.ceil(np.log10(value / width)) + 2, 2, 6)))


def _bounded(value):
    return significant(value) if np.isfinite(value) else NO_BOUND


def _note(axis, term):
    parts = [term.reason] if term.reason else []
    if term.name in axis.record_for:
        seconds = axis.record_for[term.name]
        parts.append('needs more than two days' if seconds is None else f'needs {duration(seconds)}')
    return '; '.join(parts)


def duration(seconds: float) -> str:
    """Return a length of time in the largest units that suit."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return f'{seconds:.0f} s'
    if minutes < 120:
        return f'{minutes} min'
    return f'{minutes / 60:.3g} h'


def requested(axis: AxisFigures) -> list[Term]:
    """Return the figures of an axis that count: white noise and the slow part, or the random walk where no slow part is seen."""
    names = [WHITE.name, *(axis.form or (RANDOM_WALK.name,))]
    return [axis.terms[name] for name in [*names, *([TIME] if 'gauss_markov' in names else [])]]


def counts(figures: NoiseFigures) -> dict[str, int]:
    """Return how many of the figures that count are determined, weak and held."""
    statuses = [term.status for sensor in SENSORS for axis in figures.sensor(sensor) for term in requested(axis)]
    return {status: statuses.count(status) for status in (DETERMINED, WEAK, HELD)}


def exit_code(figures: NoiseFigures) -> int:
    """Return 0 when every required figure is determined and no sample was lost, else 3."""
    found = counts(figures)
    return 3 if found[WEAK] or found[HELD] or figures.recording.get('dropped') else 0


def lines(figures: NoiseFigures) -> list[str]:
    """Return the notes on the figures: excluded parts, subtracted trends, other forms that fit, required recording time."""
    found = [_rest_line(figures.recording)]
    for sensor in SENSORS:
        for letter, axis in zip(AXES, figures.sensor(sensor)):
            found += _axis_lines(f'{sensor} {letter}', sensor, axis)
    if any(name in SLOW for sensor in SENSORS for axis in figures.sensor(sensor) for name in axis.form):
        found.append('slow noise (bias instability, Gauss–Markov, random walk): the intervals are valid for this recording; '
                     'values of a second recording can lie outside')
    longest = _longest(figures)
    return [*found, *([longest] if longest else []), _metres(figures)]


def _metres(figures):
    """Return the error of dead reckoning due to the noise."""
    runs = [f'{significant(float(np.hypot(*shares.values())), 2)} m after {duration(seconds)}'
            for seconds, shares in position_budget(figures)]
    return f'error of dead reckoning from rest by noise only: {", ".join(runs)}'


def _rest_line(recording):
    left = {name.replace('_', ' '): seconds for name, seconds in recording['left_out'].items() if seconds >= 0.05}
    said = ', '.join(f'{seconds:.1f} s of {name}' for name, seconds in left.items())
    parts = '' if recording['parts'] == 1 else f' in {recording["parts"]} parts, the longest {duration(recording["longest_part"])}'
    return f'at rest: {duration(recording["seconds_at_rest"])}{parts}' + (f'; left out: {said}' if said else '')


def _axis_lines(name, sensor, axis):
    found = []
    for trend in axis.trends:
        factor, unit = for_people(UNITS[sensor][trend.name], NOISE)
        constant = f' within {duration(trend.time)}' if trend.name == 'turn_on' else ''
        size = f'{significant(trend.value * factor)} ± {significant(trend.sd * factor, 2)} {unit}'
        found.append(f'{name} {TITLES[trend.name]}: {size}{constant}; removed')
    if axis.others:
        others = ' or '.join(said(form) for form in axis.others)
        found.append(f'{name}: {others} explains the curve as well as {said(axis.form)}')
    if axis.excess > 1:
        found.append(f'{name}: the curve deviates from every model by {np.sqrt(axis.excess):.2g} times the chance limit'
                     f'{_hump(sensor, axis)}; intervals are wider by that')
    if axis.scatter > WORTH_SAYING:
        found.append(f'{name}: from rest to rest the noise differs by {axis.scatter / 2:.0%} beyond chance; intervals are wider by that')
    return found


def _hump(sensor, axis):
    """Return the line of the periodogram at the hump of a curve, or ''."""
    if axis.oscillation is None:
        return ''
    (frequency, amplitude), (factor, unit) = axis.oscillation, for_people(UNIT[sensor], NOISE)
    return f', with an oscillation of {significant(amplitude * factor, 2)} {unit} at {significant(frequency, 3)} Hz'


def said(form: tuple[str, ...]) -> str:
    """Return a form as text."""
    return ' and '.join(name.replace('_', ' ').replace('gauss markov', 'a Gauss–Markov process') for name in form) or 'white noise alone'


def _longest(figures):
    """Return the recording time that determines all required figures, or ''."""
    needed = [axis.record_for[term.name] for sensor in SENSORS for axis in figures.sensor(sensor) for term in requested(axis)
              if term.name in axis.record_for]
    if not needed:
        return ''
    most = None if any(seconds is None for seconds in needed) else max(needed)
    return 'to determine all of them: record ' + ('more than two days' if most is None else duration(most)) + ' at rest'


def filter_lines(figures: NoiseFigures, rates: list[float], horizon: float = HORIZON) -> list[str]:
    """Return the parameters of filters, continuous and at each rate."""
    found = []
    for sensor in SENSORS:
        densities = figures.densities(sensor, horizon)
        units = UNITS[sensor]
        found.append(f'for filters, {sensor}: white noise {significant(densities.white)} {units[WHITE.name]},')
        found.append(f'    random walk {_bounded(densities.walk)} {units[RANDOM_WALK.name]} ({BASIS[densities.basis]})')
        found += [f'    at {rate:.6g} Hz: sample sd {significant(densities.sample_sd(rate))} {UNIT[sensor]}, '
                  f'bias step sd {_bounded(densities.step_sd(rate))} {UNIT[sensor]}' for rate in rates]
    return found

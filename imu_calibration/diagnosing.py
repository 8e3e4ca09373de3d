"""The use case behind `diagnose`: from a recording to findings, the extended calibration and what is said of them."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.calibration import Calibration, tolerances_of
from imu_calibration.diagnosis import diagnose, to_mapping
from imu_calibration.gathering import Collector, Gathered
from imu_calibration.sensor_model import SensorModel, parse_effects
from imu_calibration.windows import MotionGatherer
from imu_calibration.workflow import CalibrationOptions, document


@dataclass(frozen=True, eq=False)
class DiagnosisResult:
    """A diagnosis with the calibration that comes of it."""

    diagnosis: object
    """The Diagnosis."""
    document: dict
    """Content of diagnosis.json."""
    calibration: Calibration
    """The extended calibration, in the form that compensation and simulation take."""
    lines: tuple
    """What is printed."""
    tolerances: np.ndarray
    """Tolerance of each parameter of the extended model."""
    table: object
    """The Table."""
    gathered: Gathered
    """Counts and conditions of the recording."""


def diagnose_recording(blocks, table, options=CalibrationOptions(), provenance=None, progress=None):
    """
    Diagnose one recording.

    Parameters
    ----------
    blocks : iterable of SampleBlock
        The recording in file order.
    table : Table
    options : CalibrationOptions
        The models to start from; default bias and matrix of both sensors.
    progress : callable, optional
        Called with the share that is done, in [0, 1].

    """
    windows, gathered = read_windows(blocks, table, options)
    names = tuple(table.joint_names)
    reference = tuple(name for name in (options.reference_model or '').split('+') if name not in ('', 'none'))
    model = SensorModel(parse_effects('accelerometer', options.accelerometer_model or 'bias+matrix', names),
                        parse_effects('gyroscope', options.gyroscope_model or 'bias+matrix', names), reference, names, _temperature(windows))
    diagnosis = diagnose(windows, table, model, progress=progress)
    tolerances = tolerances_of(diagnosis.solution.model, options.tolerances)
    calibration = document(diagnosis.solution, tolerances, table, gathered, provenance)
    return DiagnosisResult(diagnosis, to_mapping(diagnosis), calibration, tuple(describe(diagnosis)), tolerances, table, gathered)


class _Keeper(Collector):
    """Keeps whole windows, those that calibration leaves out included, instead of reducing them."""

    def __init__(self, table, options):
        super().__init__(table, None, options.windows, options.nominal)
        self.gatherer = MotionGatherer(table, options.windows, keep_unused=True)
        self.windows = []

    def _take(self, windows):
        self.windows += windows
        return windows


def read_windows(blocks, table, options):
    """Return all windows of a recording, those that are not used included, and its Gathered."""
    keeper = _Keeper(table, options)
    for block in blocks:
        keeper.push(block)
    gathered = keeper.finish()
    for window in keeper.windows:
        if window.kind == 'unused':
            continue
        for table_of, count in ((gathered.accumulator.windows, 1), (gathered.accumulator.samples, len(window.time))):
            table_of[window.kind] = table_of.get(window.kind, 0) + count
        if window.kind != 'static':
            gathered.largest_rate = max(gathered.largest_rate, float(np.sqrt((window.rate_s**2).sum(axis=1).max())))
        gathered.largest_force = max(gathered.largest_force, float(np.max(np.abs(window.force_s))))
    return keeper.windows, gathered


def _temperature(windows):
    """Return the temperature at which thermal effects vanish: the first one of the recording, in whole degrees."""
    for window in windows:
        if window.temperature_c is not None and len(window.temperature_c):
            return float(round(window.temperature_c[0]))
    return 25.0


def describe(diagnosis):
    """Return the findings in words: what, how large, what it gains, what cannot be told apart, what stays open."""
    lines = []
    for number, finding in enumerate(diagnosis.findings, start=1):
        lines.append(f'{number}. {finding.effect} ({finding.sensor}): {finding.explanation}')
        lines.append(f'   held-out rms falls by {100 * finding.gain.reduction:.1f} % (95 %: {100 * finding.gain.ci95[0]:.1f} to '
                     f'{100 * finding.gain.ci95[1]:.1f} %), chance {finding.p_value:.1g}')
        if finding.indistinguishable_from:
            lines.append(f'   this recording cannot tell it from {" or ".join(finding.indistinguishable_from)}; to separate them: {finding.separating_motion}')
    if not lines:
        lines.append('no finding: the model is adequate for this recording')
    for sensor, rest in diagnosis.unexplained.items():
        if rest.significant:
            where = f', mostly {rest.where}' if rest.where else ''
            goes = f', goes with {rest.correlates_with}' if rest.correlates_with else ''
            lines.append(f'unexplained: the {sensor} keeps {rest.rms:.3g} {"m/s^2" if sensor == "accelerometer" else "rad/s"} rms of structure{goes}{where}')
    if diagnosis.not_testable:
        lines.append('not testable: ' + '; '.join(f'{item["effect"]} ({item["why"]})' for item in diagnosis.not_testable))
    return lines

"""Errors of raw and of corrected readings on a table."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from imu_calibration.calibration.check import ReadingErrors, require_sensor
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.compensation.compensate import invertible
from imu_calibration.compensation.stream import CompensationStream
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import BlockSource, SampleBlock, TemperatureSamples
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import SENSORS
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.window import Window
from imu_calibration.preprocessing.window_cutter import dropped
from imu_calibration.references.turntable.collector import GatherStep
from imu_calibration.references.turntable.held_out_windows import (
    prove_readings,
    reference_model,
    reference_values,
)
from imu_calibration.references.turntable.session_data import HeldOut, join, naming
from imu_calibration.references.turntable.window_statistics import reduce_window


def errors_on_table(
    sources: Sequence[BlockSource],
    table: Table,
    calibration: Calibration,
    *,
    options: CalibrationOptions = CalibrationOptions(),
    names: Sequence[str] = (),
) -> ReadingErrors:
    """
    Return the errors of a calibration on recordings of its IMU on a table.

    They are the errors of the readings that compensation writes.

    Parameters
    ----------
    sources : sequence of BlockSource
        The recordings.
    table : Table
        The reference; it need not be the one on which the calibration was made.
    calibration : Calibration
    options : CalibrationOptions
        How windows are found, and the conversion of volts or counts.
    names : sequence of str
        Names of the recordings for messages.

    Raises
    ------
    InputError
        When a recording cannot be used, or is of another IMU than the one on the table.

    """
    names = tuple(names or (f'recording {number}' for number in range(1, len(sources) + 1)))
    model = reference_model(calibration, table)
    step = BothReadings(
        table, model, options.windows, options.nominal, names, calibration=calibration
    )

    # The windows of each recording, reduced twice: with raw and with corrected readings.
    before = HeldOut()
    after = HeldOut()
    parts = []
    for session, source in enumerate(sources):
        windows: list[Window] = []
        preflight = Preflight(table.gravity_value, one_sensor=True)
        with naming(names, session):
            parts.append(step.read(source, session, preflight, windows=windows))
        for window in windows:
            if window.kind == 'unused':
                continue
            raw, corrected = _both(window)
            if len(raw) > 1:
                before.add(reduce_window(raw, model, table, session=session))
                after.add(reduce_window(corrected, model, table, session=session))

    gathered = join(parts, names, model=model, table=table)
    not_checked = require_sensor(calibration, gathered.absent)
    proof = prove_readings(before, after, model, reference=reference_values(model, calibration))
    lost = dropped(gathered.counts)
    used = [count for reason, count in gathered.counts.items() if reason not in lost]
    return ReadingErrors(
        proof={sensor: entry for sensor, entry in proof.items() if sensor not in not_checked},
        stored=calibration.proof,
        findings=gathered.findings,
        lost=lost,
        n_used=sum(used),
    )


@dataclass(frozen=True)
class BothReadings(GatherStep):
    """Gathers windows with corrected readings in addition to the raw ones."""

    calibration: Calibration = field(kw_only=True)
    """Corrects the readings, as compensation writes them into a bag."""

    def blocks(self, source: BlockSource) -> Iterator[SampleBlock]:
        """Yield the blocks of a recording with corrected readings."""
        temperature = None
        if invertible(self.calibration.model).needs_temperature:
            readings = [block.temperature for block in source if block.temperature is not None]
            temperature = TemperatureSamples.concatenate(readings) if readings else None
        stream = CompensationStream(self.calibration, temperature=temperature)
        for block in source:
            if block.imu is not None and len(block.imu):
                # The cleaner converts the raw readings of the block afterwards.
                conversion = self.nominal or RawReadings()
                samples = stream.correct(conversion.apply(block.imu))
                corrected = np.hstack([samples.force, samples.rate])
                block = replace(block, imu=replace(block.imu, corrected=corrected))
            yield block


def _both(window: Window) -> tuple[Window, Window]:
    """
    Return a window with raw readings and the same with corrected ones.

    Both are without samples that cannot be corrected.
    """
    corrected = window.corrected
    assert corrected is not None, 'the window is of corrected readings'
    # An absent sensor has no corrected readings, and its rows are not read.
    present = np.repeat([sensor not in window.absent for sensor in SENSORS], 3)
    is_corrected = np.isfinite(corrected[:, present]).all(axis=1)
    if not is_corrected.all():
        window = window.select(is_corrected)
        corrected = corrected[is_corrected]
    return window, replace(window, force_s=corrected[:, :3], rate_s=corrected[:, 3:])

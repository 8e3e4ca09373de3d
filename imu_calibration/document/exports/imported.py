"""Import of the file of another program as a calibration document, without claims beyond the file."""

from typing import Any

import numpy as np

import imu_calibration
from imu_calibration.document.calibration import UNKNOWN, Calibration
from imu_calibration.document.calibration_checks import check_numbers
from imu_calibration.document.calibration_text import from_mapping
from imu_calibration.document.decision import UNPROVEN
from imu_calibration.document.exports.affine import MATRICES, OFFSETS, AffineImu, Holding, find_pose, holding_of, moved
from imu_calibration.document.exports.target import Read, Target
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.status import HELD, WEAK


@np.errstate(all='ignore')   # `check_numbers` refuses non-finite values
def import_file(target: Target, content: bytes, path: Any, *, frame_id: str = '') -> Calibration:
    """
    Return the calibration in a file of another program.

    Values are those of the file; where it states its rotation to the sensor frame, as exported files do, they are rotated back.
    Standard deviations are those of the priors, since the file has none: a value in the file is
    weak, a value that the format lacks is fixed at its prior. Without a proof each sensor is unproven.

    Parameters
    ----------
    target : Target
    content : bytes
        The file.
    path : path-like
        Where it is: some programs write two files side by side.
    frame_id : str
        Frame of the Imu messages.

    Raises
    ------
    InputError
        When it is no such file, or its numbers can belong to no IMU.

    """
    assert target.read is not None   # `registry.find_reader` gives no other
    found = target.read(content, path)
    if target.whole:
        return from_mapping(found.numbers)
    assert target.imu is not None
    read, own = target.imu(found.numbers), find_pose(content)
    if own is None:
        return _document(target, found, moved(read, target.back(read)), target.axes, path, frame_id)
    placement, parent = own
    return _document(target, found, moved(read, placement.inverse()), 'mount', path, frame_id or parent)


def _document(target: Target, found: Read, imu: AffineImu, axes: str, path: Any, frame_id: str) -> Calibration:
    holds = tuple(holding for holding in target.holds if holding not in found.lacks)
    names: dict[str, tuple[str, ...]] = {sensor: tuple(_names(sensor, holds, imu)) for sensor in SENSORS}
    model = SensorModel(names['accelerometer'], names['gyroscope'], temperature_ref_c=imu.temperature_ref_c)
    values, sd = model.prior()
    status = np.full(len(values), HELD, dtype=object)
    for effect in model.effects:
        holding, part = holding_of(effect, holds), model.slices[effect.key]
        if holding is not None:
            values[part] = imu.value(holding).ravel()
            known = np.eye(3).ravel() > 0 if holding.own_axis else np.full(effect.size, True)
            status[part] = np.where(known, WEAK, HELD)
    name = getattr(path, 'name', str(path))
    reason = f'imported from {target.title} ({name}) without uncertainties, its error was not measured on a recording'
    statistics = {sensor: {'noise_sd': [value] * 3} for sensor, value in found.sample_sd.items()}
    conditions = {'temperature_range_c': list(imu.temperature_range_c)} if imu.temperature_range_c else {}
    gauge = {'origin': 'mean_of_sensitive_points' if np.any(imu.arms) else UNKNOWN, 'axes': axes}
    provenance = {'software': imu_calibration.__version__, 'imported': {'from': target.name, 'file': name}, 'uncertainty': UNKNOWN}
    return check_numbers(Calibration(
        model, values, np.diag(sd**2), tuple(status), frame_id, gauge, statistics=statistics, conditions=conditions, provenance=provenance,
        decision=dict.fromkeys(SENSORS, str(UNPROVEN)), decision_reasons=dict.fromkeys(SENSORS, reason),
        notes=("next: measure its error on a recording: 'imu_calibration check'",)))


def _names(sensor: str, holds: tuple[Holding, ...], imu: AffineImu):
    """Yield the effects of a sensor in a document: bias and matrix always, further ones where the file gives them a value."""
    for always in (*OFFSETS, *MATRICES):
        if always.sensor == sensor:
            yield always.effect.name
    for holding in holds:
        further = holding.effect.name not in (OFFSETS[0].effect.name, MATRICES[0].effect.name)
        if holding.sensor == sensor and further and np.any(imu.value(holding)):
            yield holding.effect.name


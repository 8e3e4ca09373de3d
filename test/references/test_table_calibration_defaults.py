"""Effects that the options add unrequested."""

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.references.turntable.table_calibration import _by_default


def test_options_know_what_is_there_unasked():
    """A size effect that was asked for does not shrink."""
    model = SensorModel(
        accelerometer=('bias', 'matrix', 'accel_size_effect'),
        reference=('table_tilt', 'time_offset'),
    )
    asked = CalibrationOptions(
        accelerometer_model='size_effect', reference_model='table_tilt+time_offset'
    )
    assert _by_default(model, asked) == []
    size_effect = model.slices['accelerometer', 'accel_size_effect']
    tilt = model.slices['reference', 'table_tilt']
    assert tilt in _by_default(model, CalibrationOptions())
    # Beside an error of table or clock that was added, levelling is estimated as in a request.
    added = CalibrationOptions(added=(('reference', 'time_offset'),))
    assert _by_default(model, added) == [size_effect]

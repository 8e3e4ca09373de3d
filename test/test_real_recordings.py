"""Real recordings on a motor shaft: one axis, ripple, stamps of whole milliseconds, an encoder of 0.088 deg, no rest at all."""

import pytest

from imu_calibration import workflow
from imu_calibration.documents import from_text
from imu_calibration.turntable import Table
from msg_adapters.bag import open_recording

pytestmark = [pytest.mark.real_data, pytest.mark.slow]

OPTIONS = workflow.CalibrationOptions('bias+matrix', 'bias+matrix+gyro_bandwidth', 'time_offset')


@pytest.mark.parametrize('name, diagonal, scale', [('shaft_pitch_slow', 'yy', 0.985), ('shaft_yaw_medium', 'zz', 1.005)])
def test_gyroscope_scale_and_lag_along_the_shaft(recordings, name, diagonal, scale):
    """
    The scale along the shaft within 1.5 % and the lag behind the encoder between 8 and 18 ms (known: 1e-3 repeatable, 12-14 ms).

    The lag is the sum of the low-pass's time constant and the offset of the clocks, which slow sweeps do not tell apart. The ripple of the
    motor at 47 Hz is beyond what joint states at 100 Hz can show, so that the scale is not known better than this.
    """
    folder = recordings / name
    table = Table.from_mapping(from_text((folder / 'table.yaml').read_text()))
    with open_recording(folder, imu_topic='/imu/data_raw') as recording:
        blocks = list(recording.blocks(table.joint_names))
    calibration = workflow.calibrate([lambda: iter(blocks)], table, OPTIONS).calibration
    values = dict(zip(calibration.param_names, calibration.values))
    found = values[f'gyroscope.matrix.{diagonal}']
    lag = values['gyroscope.gyro_bandwidth.time_constant'] + values['reference.time_offset.offset']
    print(f'{name}: gyroscope scale along the shaft {found:.4f} (known {scale}), lag {lag * 1e3:.1f} ms (known 12-14)')
    assert abs(found - scale) < 0.015
    assert 0.008 < lag < 0.018


def test_what_one_axis_cannot_show_is_held(recordings):
    """A single vertical axis says nothing of the rates across it; they keep the prior and say so."""
    folder = recordings / 'shaft_yaw_medium'
    table = Table.from_mapping(from_text((folder / 'table.yaml').read_text()))
    with open_recording(folder, imu_topic='/imu/data_raw') as recording:
        result = workflow.calibrate([lambda: recording.blocks(table.joint_names)], table)
    status = dict(zip(result.calibration.param_names, result.calibration.status))
    assert all(status[f'gyroscope.matrix.{name}'] == 'held' for name in ('xx', 'xy', 'yx', 'yy', 'zx', 'zy'))
    assert workflow.exit_code(result) == 3

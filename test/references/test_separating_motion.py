"""The motion that separates two effects, on a table that can do few of them."""

from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.references.turntable.separating_motion import motions_of_one_joint
from imu_calibration.references.turntable.standard_motions import OTHER_MOUNT
from imu_calibration.selection.questions import Question


def test_a_single_joint_is_told_what_it_can_do_and_to_be_mounted_anew():
    def question(sensor, name):
        return Question(CATALOGUE.find(sensor, name), (0,), 1, name)

    lags = motions_of_one_joint(
        question('gyroscope', 'gyro_bandwidth'), question('gyroscope', 'gyro_delay')
    )
    assert 'oscillate at 1, 2 and 4 Hz' in lags and 'two axes' not in lags
    assert OTHER_MOUNT in motions_of_one_joint(
        question('accelerometer', 'accel_quadratic'),
        question('accelerometer', 'accel_scale_asymmetry'),
    )

"""Where columns are linearised again."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.effects.sensor_model import BASE, SensorModel
from imu_calibration.references.turntable.repeated_linearisation import linearise_again


@pytest.mark.parametrize(('constant', 'expected'), [(-0.09, 30.0), (0.0, 30.0), (250.0, 250.0)])
def test_a_step_to_a_negative_time_constant_is_cut(constant, expected):
    # A warm-up of 30 s: the first step ended at -0.09 s, and its columns were not finite.
    model = SensorModel(BASE, (*BASE, 'gyro_bias_drift'))
    effect = next(each for each in model.effects if each.time_constant)
    model = replace(model, point={effect.name: effect.at_time_constant(100.0)})
    values = model.start()
    values[model.slices[effect.key].stop - 1] = constant
    count = len(values)
    solution = SimpleNamespace(
        model=model, values=values, sd=np.full(count, 15.0), covariance=np.eye(count)
    )
    again = linearise_again(model, solution)
    assert again.point_of(effect)[-1] == pytest.approx(expected)

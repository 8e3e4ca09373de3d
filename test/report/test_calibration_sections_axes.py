"""Readings at rest and in rotation, as in Tables 2 and 4 of Zhang 2017."""

import numpy as np
import pytest

from imu_calibration.core.units import STANDARD_GRAVITY as G
from imu_calibration.report.calibration_sections import axis_readings


def test_axis_readings_reproduce_the_layout_of_tables_2_and_4():
    force = G * np.vstack([np.eye(3), -np.eye(3)])
    spinning = np.tile([G, 0, 0], (2, 1))
    oblique = G * np.array([[0.7, 0.7, 0.14]])
    reference = np.vstack([force, spinning, oblique])
    rate = np.concatenate([np.zeros(6), np.deg2rad([99.9, 100.1]), [0.0]])
    bias = 1e-3 * G * np.array([1.0, -2.0, 3.0])
    lines = axis_readings(reference + bias, reference + 0.1 * bias, reference, rate=rate, gravity=G)
    assert [line.position for line in lines[::3]] == ['+x', '+y', '+z', '-x', '-y', '-z', '+x']
    assert [line.rate_deg_s for line in lines[::3]] == [0] * 6 + [100] and lines[-1].n_windows == 2
    for line in lines:
        i = 'xyz'.index(line.sensor)
        assert line.before_g - line.theoretical_g == pytest.approx(bias[i] / G, abs=1e-12)
        assert line.improvement == pytest.approx(10)
        assert line.theoretical_g == pytest.approx(
            {'+': 1, '-': -1}[line.position[0]] if line.position[1] == line.sensor else 0, abs=1e-12
        )


def test_axis_readings_of_a_recording_without_such_positions_are_empty():
    oblique = G * np.array([[0.7, 0.7, 0.14]])
    assert axis_readings(oblique, oblique, oblique, rate=[0.0], gravity=G) == []
    nothing = np.zeros((0, 3))
    assert axis_readings(nothing, nothing, nothing, rate=np.zeros(0), gravity=G) == []

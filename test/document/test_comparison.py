"""
Whether two calibrations agree.

Honest ones do, a moved parameter is found, and what cannot be compared is said.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from refusal import refused
from scipy.spatial.transform import Rotation

from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.comparison import (
    COMPARISON_P_VALUE,
    compare,
    in_accelerometer_axes,
)
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.forward_equations import sensor_output
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import DETERMINED, FIXED, HELD
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.kinematics.rotations import Reference

MODEL = SensorModel(accelerometer=('bias', 'matrix', 'accel_size_effect'))
COUNT = len(MODEL.param_names)
RNG = np.random.default_rng(17)
ROOT = 1e-4 * (np.eye(COUNT) + 0.5 * RNG.normal(size=(COUNT, COUNT)))
"""Correlated errors: a common direction must not count as many."""


def draw(rng):
    """Return a calibration with errors drawn from its own covariance."""
    values = MODEL.start() + ROOT @ rng.normal(size=COUNT)
    return Calibration(
        MODEL,
        values,
        ROOT @ ROOT.T,
        (DETERMINED,) * COUNT,
        'imu',
        {'origin': 'mount', 'axes': 'mount'},
    )


def moved(calibration, name, by):
    """Return the calibration with one parameter moved."""
    values = calibration.values.copy()
    values[calibration.param_names.index(name)] += by
    return replace(calibration, values=values)


def test_honest_calibrations_disagree_no_more_often_than_stated():
    rng = np.random.default_rng(3)
    disagreements = sum(not compare(draw(rng), draw(rng)).agree for _ in range(400))
    assert disagreements <= 400 * COMPARISON_P_VALUE + 3 * np.sqrt(400 * COMPARISON_P_VALUE) + 1


def test_a_calibration_agrees_with_itself():
    one = draw(np.random.default_rng(1))
    result = compare(one, one)
    assert result.agree and all(row.ratio == 0 for row in result.rows)
    assert result.lines[-1] == 'the calibrations agree'


@pytest.mark.parametrize(
    'name', ('accelerometer.bias.y', 'gyroscope.matrix.zx', 'accelerometer.accel_size_effect.xx')
)
def test_a_parameter_that_moved_is_found_and_its_group_named(name):
    one = draw(np.random.default_rng(2))
    sd = one.sd[one.param_names.index(name)]
    result = compare(one, moved(one, name, 20 * sd))
    assert not result.agree
    assert any(line.startswith(name.rpartition('.')[0] + ': differs') for line in result.lines)
    row = next(row for row in result.rows if row.name == name)
    assert row.ratio == pytest.approx(20 / np.sqrt(2))
    assert all(row.ratio == 0 for row in result.rows if row.name != name)


@pytest.mark.parametrize('status', [HELD, FIXED])
def test_held_and_fixed_parameters_are_not_compared(status):
    """The sd of a parameter that the axes fix is zero, which makes any difference infinite."""
    one = draw(np.random.default_rng(4))
    name = 'gyroscope.matrix.xx'
    held = replace(
        one, status=tuple(status if n == name else s for n, s in zip(one.param_names, one.status))
    )
    result = compare(moved(held, name, 1.0), one)
    assert result.agree
    assert next(row for row in result.rows if row.name == name).ratio is None
    assert any(re.search(r'\b1\b', line) for line in result.lines)


def test_nothing_determined_in_both_is_undecided():
    first = draw(np.random.default_rng(5))
    found = compare(first, replace(moved(first, 'gyroscope.bias.x', 1.0), status=(HELD,) * COUNT))
    assert found.agree is None and found.exit_code == 0 and len(found.lines) == 2


def test_only_common_parameters_are_compared_and_conventions_are_noted():
    one = draw(np.random.default_rng(5))
    small = SensorModel()
    keep = [one.param_names.index(name) for name in small.param_names]
    other = Calibration(
        small,
        one.values[keep],
        one.covariance[np.ix_(keep, keep)],
        (DETERMINED,) * len(keep),
        'other',
        {'origin': 'not_needed'},
    )
    result = compare(one, other)
    assert [row.name for row in result.rows] == list(small.param_names)
    assert sum(line.startswith('note:') for line in result.lines) == 2


def test_nothing_in_common_is_refused():
    one = draw(np.random.default_rng(6))

    class Foreign:
        param_names = ('camera.focal_length',)

    with refused(InputError, 'nothing_in_common'):
        compare(one, Foreign())


def test_the_command_line_prints_each_parameter_and_the_verdict(tmp_path, capsys):
    one = draw(np.random.default_rng(7))
    (tmp_path / 'a.yaml').write_text(calibration_to_text(one))
    (tmp_path / 'b.yaml').write_text(calibration_to_text(moved(one, 'accelerometer.bias.x', 1.0)))
    files = [str(tmp_path / 'a.yaml'), str(tmp_path / 'b.yaml')]
    page = tmp_path / 'page' / 'compare.html'
    assert main(['compare', *files, '--output', str(page.parent)]) == 3
    assert 'accelerometer.bias.x' in page.read_text()
    before = page.read_bytes()
    assert main(['compare', files[0], files[0], '--output', str(page.parent)]) == 1
    assert page.read_bytes() == before
    assert main(['compare', files[0], files[0], '--output', str(page.parent), '--force']) == 0
    assert page.read_bytes() != before
    printed = capsys.readouterr().out
    assert all(name in printed for name in one.param_names)


def rotated(calibration, rotation, axes):
    """Return the same IMU with true quantities in other axes."""
    values = calibration.values.copy()
    turn = np.eye(len(values))
    for name in ('accelerometer.matrix', 'gyroscope.matrix', 'accelerometer.accel_size_effect'):
        start = calibration.param_names.index(f'{name}.xx')
        turn[start : start + 9, start : start + 9] = np.kron(np.eye(3), rotation)
    return replace(
        calibration,
        values=turn @ values,
        covariance=turn @ calibration.covariance @ turn.T,
        gauge={'origin': 'mount', 'axes': axes},
    )


@pytest.mark.parametrize(
    ('axes', 'mat_ts'),
    [
        ('frd', np.diag([1.0, -1.0, -1.0])),
        ('y,-x,z', [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0, 0, 1]]),
    ],
)
def test_readings_in_other_axes_are_compared_in_those_of_the_first(axes, mat_ts):
    """`mat_ts`: from forward-left-up to the axes of the source; biases of 0.3, errors of 1e-4."""
    rng, mat_ts = np.random.default_rng(10465), np.asarray(mat_ts)
    first, second = draw(rng), draw(rng)
    shift = np.zeros(COUNT)
    for sensor in SENSORS:
        shift[MODEL.part(sensor, Role.OFFSET)] = [0.3, -0.2, 0.1]
        shift[MODEL.part(sensor, Role.LINEAR)] = 0.01 * rng.normal(size=9)
    first = replace(first, values=first.values + shift, readings=RawReadings(axes='flu'))
    values = second.values + shift
    other = values.copy()
    for sensor in SENSORS:
        bias, matrix = MODEL.part(sensor, Role.OFFSET), MODEL.part(sensor, Role.LINEAR)
        other[bias] = mat_ts @ values[bias]
        other[matrix] = (mat_ts @ values[matrix].reshape(3, 3) @ mat_ts.T).ravel()
    arms = MODEL.part('accelerometer', Role.ARMS)
    rows = np.argmax(np.abs(mat_ts), axis=1)  # the axis that each output of the source has
    other[arms] = (values[arms].reshape(3, 3)[rows] @ mat_ts.T).ravel()
    same = compare(first, replace(second, values=values))
    turned = replace(second, values=other, readings=RawReadings(axes=axes))
    assert not compare(first, replace(turned, readings=RawReadings(axes='flu'))).agree
    assert compare(first, turned).agree and same.agree
    np.testing.assert_allclose(
        [row.second for row in compare(first, turned).rows], [row.second for row in same.rows]
    )


@pytest.mark.parametrize('axes', ('mount', 'accelerometer_lower_triangular'))
def test_a_rotation_of_the_axes_is_no_disagreement(axes):
    """Two degrees are 350 sds of an entry; a change of the IMU is found in any axes."""
    rng = np.random.default_rng(8)
    agreeing = 0
    for seed in range(40):
        first, second = draw(rng), draw(rng)
        turn = Rotation.from_rotvec(np.radians(2.0) * rng.normal(size=3)).as_matrix()
        other = rotated(second, turn, 'mount')
        if axes != 'mount':
            other = in_accelerometer_axes(other)
        agreeing += bool(compare(first, other).agree)
        sd = other.sd[other.param_names.index('gyroscope.matrix.zx')]
        assert compare(first, moved(other, 'gyroscope.matrix.zx', 40 * sd)).agree is False
    assert agreeing >= 38


def test_the_clock_of_another_session_is_no_disagreement_of_the_imu():
    model = SensorModel(reference=('time_offset',))
    count = len(model.param_names)
    one = Calibration(
        model, model.start(), 1e-8 * np.eye(count), (DETERMINED,) * count, 'imu', {'axes': 'mount'}
    )
    name = next(name for name in model.param_names if name.startswith('reference.'))
    other = moved(one, name, 0.4)
    found = compare(one, other)
    assert (found.agree, found.reference_agree, found.exit_code) == (True, False, 0)
    found = compare(one, moved(one, 'gyroscope.bias.x', 0.4))
    assert (found.agree, found.reference_agree, found.exit_code) == (False, True, 3)


def test_the_encoder_zero_of_another_session_is_no_disagreement_of_the_imu():
    model = SensorModel(
        reference=('encoder_zero',), joint_names=JointNames.of(('outer', 'middle', 'inner'))
    )
    count = len(model.param_names)
    sd = 1e-5
    one = Calibration(
        model, model.start(), sd**2 * np.eye(count), (DETERMINED,) * count, 'imu', {'axes': 'mount'}
    )
    [name] = [name for name in model.param_names if name.startswith('reference.')]
    found = compare(one, moved(one, name, 3897 * np.sqrt(2) * sd))
    assert (found.agree, found.reference_agree, found.exit_code) == (True, False, 0)
    assert next(row for row in found.rows if row.name == name).ratio == pytest.approx(3897)
    assert found.reasons == []
    # Where the IMU differs as well, table and clock are no reason for the exit code.
    both = compare(one, moved(moved(one, name, 1.0), 'accelerometer.bias.x', 1.0))
    assert both.exit_code == 3
    assert [line.split(':')[0] for line in both.reasons[:-1]] == ['accelerometer.bias']


QUADRATIC = SensorModel(
    accelerometer=('bias', 'matrix', 'accel_quadratic', 'accel_cubic', 'accel_thermal_bias'),
    gyroscope=('bias', 'matrix', 'gyro_g_sensitivity', 'gyro_force_squared'),
)


def of_tensors(rng, sd):
    """Return a calibration with squares, cubes, and responses to force of the first two orders."""
    values = QUADRATIC.start()
    values += rng.normal(0.0, 1e-3, len(values))
    return Calibration(
        QUADRATIC,
        values + sd * rng.normal(size=len(values)),
        sd**2 * np.eye(len(values)),
        (DETERMINED,) * len(values),
        'imu',
        {'origin': 'mount', 'axes': 'mount'},
    )


def seen_along(calibration, turn):
    """Return the same IMU with the true quantities ``turn v``, written out effect by effect."""
    values = calibration.values.copy()
    names = list(calibration.param_names)
    for name in ('accelerometer.matrix', 'gyroscope.matrix', 'gyroscope.gyro_g_sensitivity'):
        start = names.index(f'{name}.xx')
        values[start : start + 9] = (values[start : start + 9].reshape(3, 3) @ turn.T).ravel()
    for axis in 'xyz':
        start = names.index(f'gyroscope.gyro_force_squared.{axis}_xx')
        xx, yy, zz, xy, yz, xz = values[start : start + 6]
        form = np.array([[xx, xy / 2, xz / 2], [xy / 2, yy, yz / 2], [xz / 2, yz / 2, zz]])
        form = turn @ form @ turn.T
        values[start : start + 3] = np.diag(form)
        values[start + 3 : start + 6] = 2 * form[0, 1], 2 * form[1, 2], 2 * form[0, 2]
    return replace(calibration, values=values)


def test_tensors_of_any_order_are_compared_in_one_convention():
    """Three degrees are 500 sds; a change of one coefficient of each effect is found."""
    rng, sd = np.random.default_rng(12), 1e-7
    one = of_tensors(rng, sd)
    turn = Rotation.from_rotvec(np.radians(3.0) * np.array([0.6, -0.48, 0.64])).as_matrix()
    other = seen_along(one, turn)
    by_hand = in_accelerometer_axes(other)
    for second in (other, by_hand):
        found = compare(one, second)
        assert found.agree
        ratios = {row.name: row.ratio for row in found.rows}
        for name in ('accel_quadratic.y', 'accel_cubic.z'):
            assert ratios[f'accelerometer.{name}'] == pytest.approx(0.0, abs=1e-6)
        assert ratios['gyroscope.gyro_force_squared.y_yz'] < 0.1
    for name in (
        'accelerometer.accel_quadratic.y',
        'gyroscope.gyro_g_sensitivity.zx',
        'gyroscope.gyro_force_squared.x_yz',
    ):
        found = compare(one, moved(by_hand, name, 40 * sd))
        assert found.agree is False
        assert any(line.startswith(name.rpartition('.')[0]) for line in found.lines)


@pytest.mark.parametrize('order', (0, 1, 2))
def test_the_output_is_the_same_for_turned_values_and_a_turned_motion(order):
    """Identity for every effect of the catalogue whose values follow a rotation."""
    rng = np.random.default_rng(order)
    turn = Rotation.from_rotvec(0.02 * rng.normal(size=3)).as_matrix()
    count = 200
    # No component changes its sign by the rotation: its columns of asymmetry are for small ones.
    size = rng.uniform(2.0, 10.0, (2, count, 3)) * rng.choice([-1.0, 1.0], (2, count, 3))
    force, rate = size
    shared = {
        'time': np.arange(count) * 0.01,
        'mat_sn': np.tile(np.eye(3), (count, 1, 1)),
        'gravity': 9.81,
        'temperature_c': rng.uniform(10.0, 40.0, count),
        'shaking': size[0] ** 2,
    }
    tested = [
        effect
        for sensor in SENSORS
        for effect in CATALOGUE.effects(()).values()
        if effect.sensor == sensor
        and effect.input_order == order
        and effect.name != 'matrix'
        and not effect.input_places
    ]
    assert tested
    for effect in tested:
        model = SensorModel(**{effect.sensor: ('bias', 'matrix', effect.name)})
        values = model.start() + rng.normal(0.0, 0.01, len(model.param_names))
        turned = values.copy()
        for each in model.effects:
            part = model.slices[each.key]
            turned[part] = each.in_other_axes(values[part], turn)
        outputs = []
        for matrix, used in ((np.eye(3), values), (turn, turned)):
            motion = Reference(
                force_s=force @ matrix.T,
                rate_s=rate @ matrix.T,
                alpha_s=np.zeros((count, 3)),
                **shared,
            )
            outputs.append(sensor_output(model, effect.sensor, used, ref=motion))
        np.testing.assert_allclose(outputs[1], outputs[0], rtol=1e-9, err_msg=effect.name)


INCOMPLETE = SensorModel(
    accelerometer=('bias', 'matrix', 'accel_cross_product', 'accel_thermal_bias'),
    gyroscope=('bias', 'matrix', 'gyro_rate_product', 'gyro_cross_axis_lag'),
)


def products_along(values, turn):
    """Return the products xy, yz, xz of one output in other axes."""
    xy, yz, xz = values / 2
    form = turn @ np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]]) @ turn.T
    return 2 * np.array([form[0, 1], form[1, 2], form[0, 2]])


def others_along(values, turn):
    """Return the responses to the rates of change of the two other axes, in other axes."""
    is_other = ~np.eye(3, dtype=bool)
    full = np.zeros((3, 3))
    full[is_other] = values
    return (full @ turn.T)[is_other]


@pytest.mark.parametrize(('degrees', 'compared'), ((0.01, True), (3.0, True), (40.0, False)))
def test_parts_of_a_tensor_are_compared_where_a_rotation_keeps_them(degrees, compared):
    """By 3 degrees they change by 5 sds, of which half a combined sd remains."""
    rng, sd = np.random.default_rng(5), 1e-5
    names = list(INCOMPLETE.param_names)
    values = INCOMPLETE.start() + 1e-3 * rng.uniform(-1.0, 1.0, len(names))
    by_hand = Calibration(
        INCOMPLETE,
        values,
        sd**2 * np.eye(len(names)),
        (DETERMINED,) * len(names),
        'imu',
        {'origin': 'mount', 'axes': 'accelerometer_lower_triangular'},
    )
    # The accelerometer matrix by hand is lower triangular.
    start = names.index('accelerometer.matrix.xx')
    values[start : start + 9] = np.tril(values[start : start + 9].reshape(3, 3)).ravel()
    by_hand = replace(by_hand, values=values)

    turn = Rotation.from_euler('z', degrees, degrees=True).as_matrix()
    seen = values.copy()
    for name in ('accelerometer.matrix', 'gyroscope.matrix'):
        start = names.index(f'{name}.xx')
        seen[start : start + 9] = (values[start : start + 9].reshape(3, 3) @ turn.T).ravel()
    for name in ('accelerometer.accel_cross_product', 'gyroscope.gyro_rate_product'):
        for axis in 'xyz':
            start = names.index(f'{name}.{axis}_xy')
            seen[start : start + 3] = products_along(values[start : start + 3], turn)
    start = names.index('gyroscope.gyro_cross_axis_lag.x_y')
    seen[start : start + 6] = others_along(values[start : start + 6], turn)
    on_table = replace(by_hand, values=seen, gauge={'origin': 'mount', 'axes': 'mount'})

    parts = [name for name in names if 'product' in name or 'lag' in name]
    for pair in ((by_hand, on_table), (on_table, by_hand)):
        found = compare(*pair)
        assert found.agree
        ratios = {row.name: row.ratio for row in found.rows}
        assert ratios['accelerometer.accel_thermal_bias.x'] == 0
        if compared:
            assert max(ratios[name] for name in parts) < 0.7
        else:
            assert ratios[parts[0]] is None
            assert any('cross_product' in line and f'{degrees:g}' in line for line in found.lines)
            n_left_out = sum(ratio is None for name, ratio in ratios.items() if name in parts)
            assert f' {n_left_out} ' in found.lines[-1]
    # Twenty sds of one coefficient of each effect.
    for name in (parts[0], 'gyroscope.gyro_cross_axis_lag.z_x'):
        changed = compare(moved(by_hand, name, 40 * sd), on_table)
        assert changed.agree is not compared

"""
Avrutov 2017: the samples return, and weak designs are refused or flagged.

Errors follow their formulas (targets A1-A10).
"""

import numpy as np
import pytest
from papers import avrutov2017 as avrutov
from papers.linear_least_squares import (
    condition_numbers,
    null_directions,
    numerical_rank,
    predicted_sd,
    tolerance_scaled,
)
from refusal import refused

from imu_calibration.core.errors import InputError, NotObservableError

from worlds.figures import show

ANGLES = avrutov.equal_angles()
CASES = [(order, axis) for order in avrutov.GIMBAL_ORDERS for axis in 'xyz']
TILT = np.deg2rad(2 / 60)
EARTH_RATE_VERTICAL = 15.041 / 3600 * np.sin(np.deg2rad(50.45))


def readings(order, axis, angles=ANGLES):
    return avrutov.gravity_readings(avrutov.turn(order, [angles] * 3), axis)


def recover_all_cases(model, truth):
    errors, conds = [], {}
    for order, axis in CASES:
        inputs = readings(order, axis)
        solution = avrutov.calibrate(inputs, avrutov.design_matrix(inputs, model) @ truth, model)
        errors.append(np.max(np.abs(solution.values - truth)))
        conds[order, axis] = solution.cond
    return max(errors), conds


def noise_ratio(inputs, model, truth, sigma, rng, n_draws=4000):
    """Return empirical over predicted sd for every coefficient of the first sensor."""
    design = avrutov.design_matrix(inputs, model)
    noisy = (design @ truth[:, 0])[:, None] + rng.normal(scale=sigma, size=(len(design), n_draws))
    solution = avrutov.calibrate(inputs, noisy, model)
    return np.std(solution.values, axis=1) / (sigma * solution.unit_sd)


def test_turn_matrices_are_rotations_that_compose_in_the_stated_order():
    rng = np.random.default_rng(1)
    angles = rng.uniform(-3, 3, (3, 20))
    for order in avrutov.GIMBAL_ORDERS:
        mat_bn = avrutov.turn(order, angles)
        np.testing.assert_allclose(
            mat_bn @ np.swapaxes(mat_bn, 1, 2), np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-15
        )
        first_axis = np.eye(3)['XYZ'.index(order[0])]
        np.testing.assert_allclose(
            avrutov.turn(order, [angles[0], 0 * angles[0], 0 * angles[0]]) @ first_axis,
            np.broadcast_to(first_axis, (20, 3)),
            atol=1e-15,
        )
    quarter = avrutov.turn('ZYX', np.array([[np.pi / 2], [0], [0]]))[0]
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, -1, 0], atol=1e-15)
    about_z = avrutov.turn('ZYX', [angles[0], 0 * angles[0], 0 * angles[0]])
    np.testing.assert_allclose(avrutov.simultaneous_turn(angles[0], (0, 0, 1)), about_z, atol=1e-15)
    assert len(avrutov.GIMBAL_ORDERS) == 12


def test_a1_sample_1_in_every_gimbal_order_and_gravity_direction():
    worst, conds = recover_all_cases('linear', avrutov.nominal_accelerometers('linear'))
    show('A1', 'largest error of 12 coefficients, 36 cases, V or V/g', worst, '< 1e-12')
    show(
        'A1',
        'cond ZYX g//z, XYX g//x, worst',
        [conds['ZYX', 'z'], conds['XYX', 'x'], max(conds.values())],
        '3.767 3.596 9.275',
    )
    assert len(conds) == 36 and worst < 1e-12
    assert conds['ZYX', 'z'] == pytest.approx(3.767, abs=1e-3)
    assert conds['XYX', 'x'] == pytest.approx(3.596, abs=1e-3)
    assert max(conds.values()) == pytest.approx(9.275, abs=1e-3)


def test_a2_sample_2_in_every_gimbal_order_and_gravity_direction():
    worst, conds = recover_all_cases('products', avrutov.nominal_accelerometers('products'))
    show('A2', 'largest error of 21 coefficients, 36 cases', worst, '< 1e-11')
    show(
        'A2',
        'cond: smallest, ZYX g//z, largest',
        [min(conds.values()), conds['ZYX', 'z'], max(conds.values())],
        '14.52 15.133 166.87',
    )
    assert worst < 1e-11
    assert min(conds.values()) == pytest.approx(14.52, abs=5e-3)
    assert conds['ZYX', 'z'] == pytest.approx(15.133, abs=1e-3)
    assert max(conds.values()) == pytest.approx(166.87, abs=1e-2)


@pytest.mark.parametrize(
    'target, rates, model, bound, cond, eqcond',
    [
        ('A3', avrutov.series_3(), 'linear', 1e-12, 1131.43, 189.49),
        ('A4', avrutov.series_4(), 'products', 1e-11, 2.3256e5, 2167.9),
    ],
)
def test_a3_a4_gyro_samples(target, rates, model, bound, cond, eqcond):
    truth = avrutov.nominal_gyroscopes(model)
    outputs = avrutov.design_matrix(rates, model) @ truth
    solution = avrutov.calibrate(rates, outputs, model)
    worst = np.max(np.abs(solution.values - truth))
    printed = np.max(np.abs(avrutov.calibrate_as_printed(rates, outputs, model) - truth))
    show(
        target,
        'largest error, orthogonal factors | normal equations',
        [worst, printed],
        f'< {bound}',
    )
    show(target, 'cond, eqcond', [solution.cond, solution.eqcond], f'{cond} {eqcond}')
    assert worst < bound and printed > 10 * worst
    assert (solution.cond, solution.eqcond) == (
        pytest.approx(cond, rel=5e-5),
        pytest.approx(eqcond, rel=5e-5),
    )


def test_a4_printed_result_has_two_rows_exchanged():
    printed = 1e-3 * np.array([[-1, 1, 1], [1, 1, -1], [1, -1, 1]])
    rates = avrutov.series_4()
    truth = avrutov.nominal_gyroscopes()
    fitted = avrutov.calibrate(
        rates, avrutov.design_matrix(rates, 'products') @ truth, 'products'
    ).values[4:]
    assert np.max(np.abs(fitted - printed)) > 1.9e-3
    np.testing.assert_allclose(fitted[[0, 2, 1]], printed, rtol=0, atol=1e-11)


def test_a5_designs_that_do_not_determine_the_model_are_refused():
    def step(degrees):
        return readings('ZYX', 'z', avrutov.equal_angles(degrees))

    faces = np.vstack([np.eye(3), -np.eye(3)])
    about_diagonal = avrutov.gravity_readings(avrutov.simultaneous_turn(ANGLES), 'z')
    rates = np.repeat(np.arange(0, 101.0, 10)[:, None], 3, axis=1)
    cases = [
        ('(1,1,1) turn n4', about_diagonal, 'linear', 3),
        ('(1,1,1) turn n7', about_diagonal, 'products', 5),
        ('step 90 n4', step(90), 'linear', 3),
        ('step 72 n7', step(72), 'products', 5),
        ('step 60 n7', step(60), 'products', 5),
        ('step 45 n7', step(45), 'products', 6),
        ('equal rates n4', rates, 'linear', 2),
        ('six faces n7', faces, 'products', 4),
    ]
    for name, inputs, model, rank in cases:
        design = avrutov.design_matrix(inputs, model)
        show('A5', f'rank of {name}', numerical_rank(design), rank)
        assert numerical_rank(design) == rank
        assert len(null_directions(design, avrutov.MODEL_COLUMNS[model])) == design.shape[1] - rank
        with refused(NotObservableError, 'rank', rank, design.shape[1]):
            avrutov.calibrate(inputs, np.ones((len(inputs), 3)), model)


def test_a5_equal_rates_name_the_axes_and_not_the_bias():
    rates = np.repeat(np.arange(0, 101.0, 10)[:, None], 3, axis=1)
    named = set().union(
        *null_directions(avrutov.design_matrix(rates), avrutov.MODEL_COLUMNS['linear'])
    )
    assert named == {'x', 'y', 'z'}


def test_a5_full_quadratic_cannot_be_seen_at_one_g():
    rng = np.random.default_rng(2)
    anywhere = rng.normal(size=(60, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    ranks = [
        numerical_rank(avrutov.design_matrix(inputs, 'quadratic'))
        for inputs in (anywhere, readings('ZYX', 'z'))
    ]
    show('A5', 'rank of the full quadratic: anywhere at 1 g, ZYX g//z', ranks, '9 8')
    assert ranks == [9, 8]
    named = null_directions(
        avrutov.design_matrix(anywhere, 'quadratic'), avrutov.MODEL_COLUMNS['quadratic']
    )
    assert set(named[0]) == {'bias', 'xx', 'yy', 'zz'}


@pytest.mark.parametrize(
    'rates, model, expected',
    [
        (avrutov.series_3(), 'linear', [0.99971, 0.11746, 3.26178, 4.69567]),
        (
            avrutov.series_4(),
            'products',
            [103.332, 36.623, 103.359, 4.4017, 57.368, 32.758, 0.17766],
        ),
    ],
)
def test_a6_full_rank_but_useless_gyro_series_are_flagged(rates, model, expected):
    """
    Tolerance: 1 % of each sensor's own scale factor and of the product terms.

    The product terms are nominal, and the tolerance holds at 1 mV output noise.
    """
    unit_sd = avrutov.calibrate(rates, np.zeros((len(rates), 3)), model).unit_sd
    show('A6', f'sd over sigma, {model}', unit_sd, expected)
    np.testing.assert_allclose(unit_sd, expected, rtol=1e-4)
    tolerances = np.array([0.02, 1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5])[: len(expected)]
    design = avrutov.design_matrix(rates, model)
    assert numerical_rank(design) == len(expected)
    scaled = tolerance_scaled(design, tolerances, sigma=1e-3)
    weak = [
        name
        for name, ratio in zip(avrutov.MODEL_COLUMNS[model], scaled.sd_over_tolerance)
        if ratio > 1
    ]
    show('A6', 'flagged at 1 mV', weak, 'not empty')
    assert 'z' in weak and 'y' in weak
    good = tolerance_scaled(
        avrutov.design_matrix(avrutov.factorial_rates(100.0), model), tolerances, sigma=1e-3
    )
    assert np.all(good.sd_over_tolerance < 1)


@pytest.mark.parametrize(
    'model, expected',
    [
        ('linear', [0.2857, 0.2316, 0.4482, 0.4430]),
        ('products', [0.2857, 0.3313, 1.0384, 0.4451, 0.6503, 1.8085, 0.8978]),
    ],
)
def test_a7_accelerometer_noise(model, expected):
    """4000 draws: the sd ratio has sd 1.1 %, so 5 % is 4.5 of them."""
    inputs = readings('ZYX', 'z')
    unit_sd = avrutov.calibrate(inputs, np.zeros((len(inputs), 3)), model).unit_sd
    ratio = noise_ratio(
        inputs, model, avrutov.nominal_accelerometers(model), 1e-3, np.random.default_rng(7)
    )
    show('A7', f'sd over sigma, {model}', unit_sd, expected)
    show('A7', f'empirical over predicted sd, {model}', ratio, '1 within 5 %')
    np.testing.assert_allclose(unit_sd, expected, atol=6e-5)
    np.testing.assert_allclose(ratio, 1, atol=0.05)


def test_a8_factorial_gyro_design():
    rates, truth = avrutov.factorial_rates(), avrutov.nominal_gyroscopes()
    design = avrutov.design_matrix(rates, 'products')
    predicted = predicted_sd(design, sigma=1e-3)
    ratio = noise_ratio(rates, 'products', truth, 1e-3, np.random.default_rng(8))
    show('A8', 'sd of matrix and products at 1 mV', predicted[[1, 4]], '3.54e-5 3.54e-6')
    show('A8', 'empirical over predicted sd', ratio, '1 within 5 %')
    np.testing.assert_allclose(predicted[1:4], 3.54e-5, rtol=2e-3)
    np.testing.assert_allclose(predicted[4:], 3.54e-6, rtol=2e-3)
    np.testing.assert_allclose(ratio, 1, atol=0.05)
    assert condition_numbers(design)[1] == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize(
    'rates, model', [(avrutov.series_3(), 'linear'), (avrutov.series_4(), 'products')]
)
def test_a8_units_of_the_rates_do_not_matter(rates, model):
    """
    Physical parameters from the same noisy data agree to 1e-10 of each parameter's own sd or size.
    """
    rng = np.random.default_rng(9)
    outputs = avrutov.design_matrix(rates, model) @ avrutov.nominal_gyroscopes(model) + rng.normal(
        scale=1e-3, size=(len(rates), 3)
    )
    in_deg = avrutov.calibrate(rates, outputs, model)
    in_rad = avrutov.calibrate(np.deg2rad(rates), outputs, model)
    to_deg = np.array([1] + 3 * [np.pi / 180] + 3 * [(np.pi / 180) ** 2])[
        : len(in_deg.values), None
    ]
    difference = np.max(np.abs(in_rad.values * to_deg / in_deg.values - 1))
    show('A8', f'rad/s against deg/s, {model}', difference, '< 1e-10')
    assert difference < 1e-10
    assert in_rad.eqcond == pytest.approx(in_deg.eqcond, rel=1e-9)


def test_a9_earth_rate_on_sample_3():
    rates, truth = avrutov.series_3(), avrutov.nominal_gyroscopes('linear')
    sensed = avrutov.add_earth_rate(rates, EARTH_RATE_VERTICAL)
    outputs = avrutov.design_matrix(sensed) @ truth
    ignored = np.max(np.abs(avrutov.calibrate(rates, outputs).values - truth)[1:])
    modelled = np.max(np.abs(avrutov.calibrate(sensed, outputs).values - truth))
    show(
        'A9', 'error ignored | modelled, V/(deg/s)', [ignored, modelled], '2.476e-4 +-1 % | < 1e-12'
    )
    assert ignored == pytest.approx(2.476e-4, rel=0.01)
    assert modelled < 1e-12
    predicted = avrutov.reference_error(rates, sensed - rates, truth)
    np.testing.assert_allclose(
        predicted, avrutov.calibrate(rates, outputs).values - truth, atol=1e-15
    )


@pytest.mark.parametrize('order, expected', [('ZYX', 0.588), ('XYZ', 1.143)])
def test_a10_table_tilt(order, expected):
    mat_bn = avrutov.turn(order, [ANGLES] * 3)
    truth = avrutov.nominal_accelerometers('linear')
    level = avrutov.gravity_readings(mat_bn, 'z')
    ignored, estimated = [], []
    for azimuth in np.linspace(0, 2 * np.pi, 72, endpoint=False):
        tilt = TILT * np.array([np.cos(azimuth), np.sin(azimuth)])
        outputs = avrutov.design_matrix(avrutov.gravity_readings(mat_bn, 'z', tilt)) @ truth
        ignored.append(np.max(np.abs(avrutov.calibrate(level, outputs).values - truth)))
        if len(ignored) % 18 == 1:
            solution = avrutov.calibrate_with_tilt(mat_bn, outputs, 'z')
            estimated.append(
                max(
                    np.max(np.abs(solution.coefficients - truth)),
                    np.max(np.abs(solution.tilt_rad - tilt)),
                )
            )
    show('A10', f'{order} g//z: worst error ignored, mV or mV/g', 1e3 * max(ignored), expected)
    show('A10', f'{order} g//z: error with two tilt parameters', max(estimated), '< 1e-12')
    assert 1e3 * max(ignored) == pytest.approx(expected, abs=1e-3)
    assert max(estimated) < 1e-12
    assert len(solution.linear.param_names) == 14


def test_tilt_can_hide_in_matrix_and_products():
    """
    Gravity along the first axis, n x 7.

    2 arcmin leave less than 0.2 uV of residual and 0.5 mV/g of error.
    """
    mat_bn = avrutov.turn('ZYX', [ANGLES] * 3)
    truth = avrutov.nominal_accelerometers()
    outputs = (
        avrutov.design_matrix(avrutov.gravity_readings(mat_bn, 'z', (TILT, 0)), 'products') @ truth
    )
    solution = avrutov.calibrate(avrutov.gravity_readings(mat_bn, 'z'), outputs, 'products')
    assert np.sqrt(np.mean(solution.residuals**2)) < 0.2e-6
    assert np.max(np.abs(solution.values - truth)) > 0.5e-3


def test_error_budget_is_the_scatter_of_simulated_causes():
    """One cause at a time, 3000 draws, sd ratio within 7 % (5 sd)."""
    rng = np.random.default_rng(10)
    order, axis, truth = 'ZYX', 'z', avrutov.nominal_accelerometers('linear')
    mat_bn, level = avrutov.turn(order, [ANGLES] * 3), readings(order, axis)
    common = {'tilt': avrutov.tilt_changes(mat_bn, axis, TILT), 'gravity': 3e-5 * level}
    scattered = {
        'encoder': avrutov.encoder_changes(
            order, np.tile(ANGLES, (3, 1)), axis, encoder_sd_rad=1e-4
        )
    }
    budget = avrutov.error_budget(
        level, truth, 'linear', noise_sd=1e-4, common=common, scattered=scattered
    )

    def scatter(make_outputs):
        outputs = np.concatenate([make_outputs() for _ in range(3000)], axis=1)
        values = avrutov.calibrate(level, outputs).values.reshape(4, 3000, 3)
        return np.std(values, axis=1)

    def with_tilt():
        return (
            avrutov.design_matrix(
                avrutov.gravity_readings(mat_bn, axis, rng.normal(scale=TILT, size=2))
            )
            @ truth
        )

    def with_encoder():
        angles = ANGLES + rng.normal(scale=1e-4, size=(3, len(ANGLES)))
        return (
            avrutov.design_matrix(avrutov.gravity_readings(avrutov.turn(order, angles), axis))
            @ truth
        )

    np.testing.assert_allclose(scatter(with_tilt), budget['tilt'], rtol=0.07)
    np.testing.assert_allclose(scatter(with_encoder), budget['encoder'], rtol=0.07)
    np.testing.assert_allclose(budget['gravity'][1:], 3e-5 * np.abs(truth[1:]), rtol=1e-9)
    np.testing.assert_allclose(
        budget['total'] ** 2,
        sum(budget[key] ** 2 for key in ('output noise', 'tilt', 'gravity', 'encoder')),
    )


def test_unknown_model_is_refused():
    with refused(InputError, 'model_unknown', 'cubic', 'linear, products'):
        avrutov.design_matrix(np.eye(3), 'cubic')


def test_section_5_as_printed():
    """
    Eq. 13 is the fit, and the m tests scatter as sigma sqrt(diag BB').

    Dividing by m - 1 with the truth known is too large.
    """
    inputs, truth = (
        avrutov.gravity_readings(avrutov.turn('ZYX', [ANGLES] * 3), 'z'),
        avrutov.nominal_accelerometers('linear'),
    )
    operator, design = avrutov.estimation_operator(inputs), avrutov.design_matrix(inputs)
    np.testing.assert_allclose(operator @ (design @ truth), truth, atol=1e-12)
    assert operator.shape == (4, len(inputs))
    errors = operator @ (1e-3 * np.random.default_rng(5).normal(size=(3000, len(inputs), 3)))
    wanted = 1e-3 * np.linalg.norm(operator, axis=1)[:, None]
    assert np.max(np.abs(avrutov.m_test_sd(errors, as_printed=False) / wanted - 1)) < 0.05
    np.testing.assert_allclose(
        avrutov.m_test_sd(errors[:5]) ** 2,
        1.25 * avrutov.m_test_sd(errors[:5], as_printed=False) ** 2,
    )

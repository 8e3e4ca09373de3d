#!/usr/bin/env python3
"""
Rerun the four samples of Avrutov et al. and compare with the published claims.

The paper is Avrutov et al., "3D-Calibration of the IMU" (ELNANO 2017). The results of the rerun are
compared with its claims.
"""

import itertools

import numpy as np
from papers import avrutov2017 as avrutov
from papers.linear_least_squares import condition_numbers, null_directions, numerical_rank

from imu_calibration.core.errors import NotObservableError

ANGLES = avrutov.equal_angles()
TILT = np.deg2rad(2 / 60)
ENCODER = np.deg2rad(1.5 / 3600)
EARTH_RATE = 15.041 / 3600 * np.sin(np.deg2rad(50.45))
K, MATRIX = 1e-3, 0.01
PRINTED: dict[int, list[list[float]]] = {
    1: [[2.5, 2.5, 2.5], [1.0, -0.01, 0.009999], [0.01, 1.0, -0.009999], [-0.009999, 0.01, 1.0]],
    2: [
        [2.5, 2.5, 2.5],
        [1, -0.01, 0.01],
        [0.01, 1, -0.01],
        [-0.01, 0.01, 1],
        [-K, K, K],
        [K, -K, K],
        [K, K, -K],
    ],
    3: [[2, 2, 2], [1.0, -0.01, 0.03], [0.01, 1.0, -0.01]],
    4: [
        [2, 2, 2],
        [0.01, -0.01, 0.03],
        [0.01, 0.1, -0.01],
        [-0.02, 0.01, 0.1],
        [-K, K, K],
        [K, K, -K],
        [K, -K, K],
    ],
}


def readings(order='ZYX', axis='z', angles=ANGLES):
    return avrutov.gravity_readings(avrutov.turn(order, [angles] * 3), axis)


def samples() -> list[tuple[int, str, str, np.ndarray, np.ndarray]]:
    """
    Return number, title, model, inputs and nominal coefficients of the four samples.

    N11 = 0.01 as printed for the gyroscopes.
    """
    return [
        (
            1,
            'accelerometers, n x 4',
            'linear',
            readings(),
            avrutov.nominal_accelerometers('linear'),
        ),
        (
            2,
            'pendulous accelerometers, n x 7',
            'products',
            readings(),
            avrutov.nominal_accelerometers(),
        ),
        (
            3,
            'gyroscopes, n x 4',
            'linear',
            avrutov.series_3(),
            avrutov.nominal_gyroscopes('linear', MATRIX),
        ),
        (
            4,
            'gyroscopes, n x 7',
            'products',
            avrutov.series_4(),
            avrutov.nominal_gyroscopes('products', MATRIX),
        ),
    ]


def heading(text):
    print(f'\n{text}\n{"-" * len(text)}')


def print_samples():
    heading('The samples: printed estimate, ours, nominal')
    for number, title, model, inputs, truth in samples():
        outputs = avrutov.design_matrix(inputs, model) @ truth
        solution = avrutov.calibrate(inputs, outputs, model)
        normal = np.max(np.abs(avrutov.calibrate_as_printed(inputs, outputs, model) - truth))
        print(
            f'\nSample {number}: {title}, {len(inputs)} runs, cond {solution.cond:.6g}, eqcond'
            f' {solution.eqcond:.5g}'
        )
        print(
            f'  largest error: ours {np.max(np.abs(solution.values - truth)):.1e}, printed normal'
            f' equations {normal:.1e}'
        )
        print(f'  {"":5s}{"printed":>27s}{"ours":>32s}{"nominal":>29s}')
        for k, name in enumerate(avrutov.MODEL_COLUMNS[model]):
            printed = (
                ''.join(f'{v:10.6f}' for v in PRINTED[number][k])
                if k < len(PRINTED[number])
                else f'{"(not in the text)":>30s}'
            )
            print(
                f'  {name:5s}{printed}  {"".join(f"{v:10.6f}" for v in solution.values[k])}'
                f' {"".join(f"{v:9.4f}" for v in truth[k])}'
            )


def print_gimbal_orders():
    heading(
        'Every gimbal order (first letter turns first) and gravity direction, equal angles 0:10:400'
    )
    print(
        'order  gravity   n x 4: rank   cond    n x 7: rank   cond  eqcond   sd at 1 mV: k mV/g   l'
        ' mV/g^2'
    )
    for order, axis in itertools.product(avrutov.GIMBAL_ORDERS, 'xyz'):
        designs = [
            avrutov.design_matrix(readings(order, axis), model) for model in ('linear', 'products')
        ]
        (cond4, _), (cond7, eqcond7) = map(condition_numbers, designs)
        sd = avrutov.calibrate(
            readings(order, axis), np.zeros((len(ANGLES), 3)), 'products'
        ).unit_sd
        print(
            f'{order}    {axis}     {numerical_rank(designs[0]):10d} {cond4:9.3f}'
            f' {numerical_rank(designs[1]):13d} {cond7:8.2f} {eqcond7:7.1f} {max(sd[1:4]):18.2f}'
            f' {max(sd[4:]):10.2f}'
        )


def refused_designs():
    rates = np.repeat(np.arange(0, 101.0, 10)[:, None], 3, axis=1)
    literal = avrutov.gravity_readings(avrutov.simultaneous_turn(ANGLES), 'z')
    yield 'one turn about (1,1,1), n x 4', literal, 'linear'
    yield 'one turn about (1,1,1), n x 7', literal, 'products'
    for step, model in ((90, 'linear'), (72, 'products'), (60, 'products'), (45, 'products')):
        yield (
            f'equal angles, step {step} deg, {model}',
            readings(angles=avrutov.equal_angles(step)),
            model,
        )
    yield 'equal rates w, w, w, n x 4', rates, 'linear'
    yield 'six faces, n x 7', np.vstack([np.eye(3), -np.eye(3)]), 'products'
    yield 'squares added, equal angles at 1 g', readings(), 'quadratic'


def print_refusals():
    heading('Designs that are refused')
    for name, inputs, model in refused_designs():
        design = avrutov.design_matrix(inputs, model)
        try:
            avrutov.calibrate(inputs, np.zeros((len(inputs), 3)), model)
            raise SystemExit(f'{name} should have been refused')
        except NotObservableError:
            lost = sorted(set().union(*null_directions(design, avrutov.MODEL_COLUMNS[model])))
            print(
                f'{name:40s} rank {numerical_rank(design)} of {design.shape[1]}; not determined:'
                f' {", ".join(lost)}'
            )


def print_gyro_series():
    heading('Gyroscope series at 1 mV output noise: sd of the x gyroscope in % of its coefficient')
    orthogonal = [
        (
            '2^3 factorial +-10 deg/s, 3 at rest',
            avrutov.factorial_rates(),
            'products',
            avrutov.nominal_gyroscopes(),
        )
    ]
    for title, inputs, model, truth in [
        (f'sample {s[0]}', *(s[3], s[2]), s[4]) for s in samples()[2:]
    ] + orthogonal:
        unit_sd = avrutov.calibrate(inputs, np.zeros((len(inputs), 3)), model).unit_sd
        percent = 100 * 1e-3 * unit_sd / np.abs(truth[:, 0])
        eqcond = condition_numbers(avrutov.design_matrix(inputs, model))[1]
        print(
            f'{title:36s} eqcond {eqcond:7.1f}  '
            + '  '.join(f'{n} {p:.3g}' for n, p in zip(avrutov.MODEL_COLUMNS[model], percent))
        )


def print_budget():
    heading(
        'Error budget of sample 1 (section V): 0.1 mV, level 2 arcmin, encoder 1.5 arcsec; worst'
        ' sensor, mV and mV/g'
    )
    truth, mat_bn = avrutov.nominal_accelerometers('linear'), avrutov.turn('ZYX', [ANGLES] * 3)
    budget = avrutov.error_budget(
        readings(),
        truth,
        'linear',
        noise_sd=1e-4,
        common={'levelling': avrutov.tilt_changes(mat_bn, 'z', TILT)},
        scattered={
            'encoder': avrutov.encoder_changes(
                'ZYX', np.tile(ANGLES, (3, 1)), 'z', encoder_sd_rad=ENCODER
            )
        },
    )
    for cause, sd in budget.items():
        print(
            f'{cause:14s}'
            + ''.join(
                f'   {name} {1e3 * np.max(row):.4f}'
                for name, row in zip(avrutov.MODEL_COLUMNS['linear'], sd)
            )
        )
    tilted = avrutov.design_matrix(avrutov.gravity_readings(mat_bn, 'z', (TILT, 0))) @ truth
    solution = avrutov.calibrate_with_tilt(mat_bn, tilted, 'z')
    print(
        'levelling estimated with the three sensors jointly: rank'
        f' {len(solution.linear.param_names)} of 14, largest error'
        f' {np.max(np.abs(solution.coefficients - truth)):.1e} V/g, tilt'
        f' {60 * np.rad2deg(solution.tilt_rad[0]):.6f} arcmin'
    )


def print_section_5():
    tests, noise_sd, truth = 2000, 1e-3, avrutov.nominal_accelerometers('linear')
    heading(
        f'Section V as printed: X = B U (eq. 13), {tests} tests of sample 1 with 1 mV of output'
        ' noise; sd in mV and mV/g'
    )
    operator, design = avrutov.estimation_operator(readings()), avrutov.design_matrix(readings())
    outputs = design @ truth + noise_sd * np.random.default_rng(3).normal(
        size=(tests, len(design), 3)
    )
    errors = operator @ outputs - truth
    rows = {
        '1/(m-1), printed': avrutov.m_test_sd(errors),
        '1/m': avrutov.m_test_sd(errors, as_printed=False),
        "sigma sqrt(diag BB')": np.repeat(
            noise_sd * np.linalg.norm(operator, axis=1)[:, None], 3, axis=1
        ),
    }
    for title, sd in rows.items():
        print(
            f'{title:22s}'
            + ''.join(
                f'   {name}{"".join(f"{1e3 * one:8.4f}" for one in row)}'
                for name, row in zip(avrutov.MODEL_COLUMNS['linear'], sd)
            )
        )
    few = avrutov.m_test_sd(errors[:5]) / avrutov.m_test_sd(errors[:5], as_printed=False)
    print(
        f'B is {operator.shape[0]} x {operator.shape[1]}, not n x 4; with five tests 1/(m-1) is'
        f' {100 * (few.mean() - 1):.0f} % too large, for the truth is known and no mean was'
        ' estimated'
    )


def print_findings():
    heading('Claims that are not reproduced')
    for k, finding in enumerate(findings(), start=1):
        print(f'{k}. {finding}')


def findings():
    """Yield sentences whose numbers are computed here."""
    literal = avrutov.gravity_readings(avrutov.simultaneous_turn(ANGLES), 'z')
    total = np.sum(literal, axis=1)
    yield (
        '"Without any limitations for accelerometers" fails: one turn about (1,1,1), "three axes'
        f' simultaneously" taken literally, keeps ax+ay+az at {total.mean():.3f} g (scatter'
        f' {np.ptp(total):.0e}); rank {numerical_rank(avrutov.design_matrix(literal))} of 4 and'
        f' {numerical_rank(avrutov.design_matrix(literal, "products"))} of 7. With gimbals the rank'
        ' is full in every order.'
    )
    conds = [
        condition_numbers(avrutov.design_matrix(readings(o, a), 'products'))[0]
        for o in avrutov.GIMBAL_ORDERS
        for a in 'xyz'
    ]
    yield (
        'Neither order nor gravity direction is given, yet cond of the n x 7 design runs from'
        f' {min(conds):.1f} to {max(conds):.1f}; noise-free recovery does not separate them.'
    )
    products_sd = [
        max(avrutov.calibrate(readings(o, a), np.zeros((41, 3)), 'products').unit_sd[4:])
        for o in avrutov.GIMBAL_ORDERS
        for a in 'xyz'
    ]
    yield (
        'At 1 mV the product terms of sample 2 (nominal 1 mV/g^2) have sd up to'
        f' {min(products_sd):.2f} mV/g^2 in the best order and {max(products_sd):.1f} in the worst.'
    )
    series, truth = avrutov.series_4(), avrutov.nominal_gyroscopes()
    unit_sd = avrutov.calibrate(series, np.zeros((11, 3)), 'products').unit_sd
    good_sd = avrutov.calibrate(avrutov.factorial_rates(), np.zeros((11, 3)), 'products').unit_sd
    yield (
        'Full rank is not enough: sample 4 has rank'
        f' {numerical_rank(avrutov.design_matrix(series, "products"))}, and 1 mV makes'
        f' {100e-3 * unit_sd[4] / K:.0f} % of p11; 1 % needs {1e6 * 0.01 * K / unit_sd[4]:.2f} uV.'
        f' Eleven runs of a factorial design are {unit_sd[4] / good_sd[4]:.0f} times better on the'
        ' same term.'
    )
    as_rad = np.column_stack([np.deg2rad(avrutov.series_3()[:, 0]) ** p for p in (1, 1 / 2, 1 / 3)])
    in_rad = avrutov.calibrate(np.rad2deg(as_rad), np.zeros((11, 3))).unit_sd
    in_deg = avrutov.calibrate(avrutov.series_3(), np.zeros((11, 3))).unit_sd
    yield (
        f'w, w^(1/2), w^(1/3) depends on the unit: formed in deg/s the sd of n.2 is {in_deg[2]:.2f}'
        f' per unit of noise, formed in rad/s {in_rad[2]:.2f}: different experiments.'
    )
    quiet = int(np.sum(series[:, 1] < EARTH_RATE))
    yield (
        f'Sample 4 turns the y axis at {series[:, 1].max():.0f} deg/s at most, and below Earth rate'
        f' in {quiet} of {len(series)} runs.'
    )
    linear = avrutov.nominal_gyroscopes('linear')
    sensed = avrutov.add_earth_rate(avrutov.series_3(), EARTH_RATE)
    ignored = avrutov.reference_error(avrutov.series_3(), sensed - avrutov.series_3(), linear)
    yield (
        f'Earth rate is not in the model: in Kyiv it puts {np.max(np.abs(ignored[1:])):.2e}'
        ' V/(deg/s) into sample 3.'
    )
    mat_bn = avrutov.turn('ZYX', [ANGLES] * 3)
    nominal = avrutov.nominal_accelerometers()
    tilted = avrutov.gravity_readings(mat_bn, 'z', (TILT, 0))
    solution = avrutov.calibrate(
        readings(), avrutov.design_matrix(tilted, 'products') @ nominal, 'products'
    )
    yield (
        "Levelling to 2 arcmin (the paper's own figure) costs"
        f' {1e3 * np.max(np.abs(solution.values - nominal)):.2f} mV/g and leaves'
        f' {1e6 * np.sqrt(np.mean(solution.residuals**2)):.2f} uV of residual: it cannot be seen'
        ' there. Section V sums errors as if they were independent from row to row.'
    )
    fitted = avrutov.calibrate(
        series, avrutov.design_matrix(series, 'products') @ truth, 'products'
    ).values[4:]
    straight, exchanged = (
        np.max(np.abs(fitted[order] - np.array(PRINTED[4][4:]))) for order in ([0, 1, 2], [0, 2, 1])
    )
    yield (
        'Rows 6 and 7 of the printed result of sample 4 are exchanged: it differs from the nominal'
        f' values by {straight:.0e}, by {exchanged:.0e} once they are swapped.'
    )
    yield (
        f'Sample 3 prints n11 = {PRINTED[3][1][0]:g} and n22 = {PRINTED[3][2][1]:g} where the'
        f' nominal values are {avrutov.nominal_gyroscopes("linear", MATRIX)[1, 0]:g} and'
        f' {linear[2, 1]:g}; 0.1 is meant for n11, it seems.'
    )
    yield (
        f'0 to 400 deg by 10 is {len(ANGLES)} positions, not 40, and repeats'
        f' {int(np.sum(np.rad2deg(ANGLES) >= 359.9))} of them; both gyroscope series have'
        f' {len(series)} runs, not 10. Biases are volts, not V/g.'
    )
    yield (
        'A 1 g test cannot see squares: rank'
        f' {numerical_rank(avrutov.design_matrix(readings(), "quadratic"))} of 10 here, 9 at best.'
        ' Kronecker-Capelli is about existence; uniqueness needs full column rank, for'
        ' accelerometers too.'
    )


def main():
    print_samples()
    print_gimbal_orders()
    print_refusals()
    print_gyro_series()
    print_budget()
    print_section_5()
    print_findings()


if __name__ == '__main__':
    np.set_printoptions(suppress=True)
    main()

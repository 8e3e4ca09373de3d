#!/usr/bin/env python3
"""
Rerun the calibration of Zhang et al. and compare with the published claims.

The paper is Zhang et al., "Comprehensive Calibration of Strap-Down Tri-Axis Accelerometer Unit"
(Sensors 2017). The results of the rerun are compared with its claims.
"""

import numpy as np
from papers import zhang2017 as zhang
from papers.zhang2017_joint_fit import (
    DESIGNS,
    arm_errors,
    design_runs,
    face,
    fit_joint,
    fit_triad,
    jacobian,
    judge_design,
    oscillation,
    predict,
    skewed_axes,
    spin,
    stack_runs,
    weak_arms,
)

from imu_calibration.core.errors import NotObservableError
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.report.calibration_sections import axis_readings

G = STANDARD_GRAVITY
MG = 1e-3 * G
TABLE = zhang.printed_static_model()
SENSOR = zhang.static_model_from_matrix(TABLE.matrix, TABLE.bias)
ARMS = zhang.TABLE_3_ARMS
TRUTH = np.column_stack([np.zeros(3), SENSOR.cosines, ARMS])
OFF_AXIS = ~np.eye(3, dtype=bool)
RATES_DEG_S = (100, 150, 200)
NAMES = {
    'Z0': 'Zhang: spins about body axes',
    'Z60': 'spins, fixture skewed 60 deg',
    'O': 'oscillations about 3 axes',
    'M': 'spins, oscillations, two-axis',
}


def heading(text):
    print(f'\n{text}\n{"-" * len(text)}')


def row(values, form='10.4f'):
    return ''.join(f'{value:{form}}' for value in values)


def print_table_1():
    heading(
        'Table 1, static calibration: printed numbers | six positions simulated from them and'
        ' refitted with unit rows'
    )
    force = zhang.six_positions()
    fitted, _ = zhang.fit_static(force, TABLE.predict(force))
    for i, axis in enumerate('xyz'):
        print(
            f'{axis}  bias {TABLE.bias[i]:.6f} V  k {TABLE.scale[i]:.6f} V/g '
            f' angles{row(zhang.TABLE_1_ANGLES_DEG[i], "10.5f")} deg | {fitted.bias[i]:.6f} '
            f' {fitted.scale[i]:.6f} {row(fitted.angles_deg[i], "10.5f")}'
        )


def simulated_readings(rng, rate_deg_s):
    """
    Return window means (measured, compensated, reference) with x up and down.

    From Table 1 and Table 3, 0.1 mg of noise.

    They are compensated with the estimates of the paper's method from other readings: six
    positions, and arms by eq. 24.
    """
    calibration, arms = six_position_calibration(rng), mean_of_rates(rng, 0.1 * MG)
    runs = [spin((sign, 0, 0), rate_deg_s, 1.0) for sign in (1, -1)]
    force, arm_matrix, _ = stack_runs(runs)
    size = np.einsum('ij,njk,ik->ni', SENSOR.cosines, arm_matrix, ARMS)
    outputs = (
        TABLE.bias
        + SENSOR.scale * (force @ SENSOR.cosines.T + size + 0.1 * MG * rng.normal(size=(2, 3))) / G
    )
    before = (outputs - TABLE.bias) / TABLE.scale * G
    estimated = np.einsum('ij,njk,ik->ni', SENSOR.cosines, arm_matrix, arms)
    return (
        before,
        calibration.invert(outputs) * G - np.linalg.solve(SENSOR.cosines, estimated.T).T,
        force,
    )


def six_position_calibration(rng):
    force = zhang.six_positions()
    return zhang.fit_static(
        force, SENSOR.predict(force) + 1e-4 * SENSOR.scale * rng.normal(size=(6, 3))
    )[0]


def print_tables_2_and_4(rng):
    for title, printed, rate in (
        ('Table 2, at rest', zhang.TABLE_2_G, 0.0),
        ('Table 4, spinning at 100 deg/s', zhang.TABLE_4_G, 100.0),
    ):
        heading(
            f'{title}: printed, before -> after (error ratio) | ours, simulated from Tables 1 and 3'
        )
        before, after, reference = simulated_readings(rng, rate)
        for line in axis_readings(
            before, after, reference, rate=np.deg2rad([rate, rate]), gravity=G
        ):
            sensor, column = 'xyz'.index(line.sensor), 0 if line.position == '+x' else 2
            shown = printed[sensor, column : column + 2]
            ratio = abs(shown[0] - line.theoretical_g) / abs(shown[1] - line.theoretical_g)
            print(
                f'{line.position} up, {line.sensor}: {shown[0]:10.6f} -> {shown[1]:10.6f}'
                f' ({ratio:5.2f}) | {line.before_g:10.6f} -> {line.after_g:10.6f}'
                f' ({line.improvement:6.1f})'
            )


def closed_form_means(rng, rate, noise_sd, axes=None):
    axes = np.eye(3) if axes is None else axes
    runs = [face(axis, 1.0) for axis in axes], [spin(axis, np.rad2deg(rate), 1.0) for axis in axes]
    return tuple(
        np.column_stack([predict(part, one) for one in TRUTH]) + noise_sd * rng.normal(size=(3, 3))
        for part in runs
    )


def mean_of_rates(rng, noise_sd, weighted=False):
    """
    Return the arms by eq. 24 averaged over 100, 150 and 200 deg/s.

    Plainly as in the paper, or by their inverse variances.
    """
    rates = np.deg2rad(RATES_DEG_S)
    arms = [
        zhang.closed_form(*closed_form_means(rng, rate, noise_sd), rate, directions=SENSOR.cosines)
        for rate in rates
    ]
    return zhang.average_rates(np.array(arms), rates, weighted)


def print_table_3(rng):
    heading('Table 3, lever arms in mm (reference point to sensor; printed with the opposite sign)')
    rate, rows = np.deg2rad(200), {}
    rows['printed, sign turned'] = ARMS
    rows['eq. 24, no noise'] = zhang.closed_form(
        *closed_form_means(rng, rate, 0.0), rate, directions=SENSOR.cosines
    )
    rows['eq. 24 as printed'] = zhang.closed_form(
        *closed_form_means(rng, rate, 0.0), rate, directions=SENSOR.cosines, as_printed=True
    )
    rows['eq. 24, 0.75 mg'] = zhang.closed_form(
        *closed_form_means(rng, rate, 0.75 * MG), rate, directions=SENSOR.cosines
    )
    rows['   its sd'] = zhang.closed_form_sd(0.75 * MG, rate, SENSOR.cosines)
    rows['mean of 3 rates, 0.75 mg'] = mean_of_rates(rng, 0.75 * MG)
    rows['   sd of 400 such means'] = np.std(
        [mean_of_rates(rng, 0.75 * MG) for _ in range(400)], axis=0
    )
    rows['   weighted by rate^4'] = np.std(
        [mean_of_rates(rng, 0.75 * MG, weighted=True) for _ in range(400)], axis=0
    )
    axes = skewed_axes(60)
    rows['eq. 24, skew 60, 0.75 mg'] = zhang.closed_form(
        *closed_form_means(rng, rate, 0.75 * MG, axes),
        rate,
        directions=SENSOR.cosines,
        spin_axes=axes,
    )
    for design in ('Z0', 'M'):
        runs = design_runs(design)
        noise = stack_runs(runs)[2]
        readings = np.column_stack(
            [predict(runs, one) + noise * rng.normal(size=len(noise)) for one in TRUTH]
        )
        _, arms, _, fits = fit_triad(runs, readings)
        rows[f'joint fit {design}, 0.1 mg'] = arms
        rows['   its sd '.ljust(9 + len(design))] = np.array([fit.sd[0, 4:] for fit in fits])
    for title, arms in rows.items():
        print(f'{title:26s}' + ' | '.join(row(1e3 * sensor, '9.3f') for sensor in arms))


def print_designs():
    heading(
        'Parameters that a design determines: 6 faces + 9 runs, 0.1 mg per mean; arms in mm,'
        ' tolerance 0.1 mm'
    )
    for design in DESIGNS:
        judged = judge_design(design_runs(design), SENSOR.cosines, ARMS)
        sd = 0.1 * np.array([one.sd_over_tolerance[4:] for one in judged])
        weak = weak_arms(judged)
        print(
            f'{design:4s}{NAMES[design]:32s} sd on axis {np.diag(sd).max():.4f}, off axis'
            f' {sd[OFF_AXIS].max():8.4f}; cond in tolerances'
            f' {max(one.cond for one in judged):6.1f}; not determined: {", ".join(weak) or "none"}'
        )
    runs = design_runs('Z0')[:6] + [oscillation((1, 1, 1), 10, 1.0, noise_sd=MG)]
    try:
        fit_joint(runs, predict(runs, TRUTH[0]))
        raise SystemExit('the single oscillation axis should have been refused')
    except NotObservableError as error:
        print(f'one oscillation about (1,1,1): refused: {str(error).split(". ")[0]}')


def print_static_navigation(rng):
    heading(
        'Figures 6 and 7, 50 s at rest after six-position calibration (printed: 4 -> 0.02 m/s, 100'
        ' -> 0.3 m)'
    )
    for drift in (0.0, 0.02, 0.05, 0.1, 0.75):
        v0, p0, v1, p1 = zhang.static_navigation(TABLE, 1e-3 * drift, rng, n_draws=200)
        print(
            f'bias drift between runs {drift:4.2f} mg: {v0:.2f} -> {v1:.3f} m/s ({v0 / v1:5.1f}x),'
            f' {p0:.0f} -> {p1:.2f} m ({p0 / p1:5.1f}x)'
        )


def print_spins():
    heading(
        'Constant spins at 100 deg/s with Table 3 uncompensated: summed in the body frame |'
        ' navigated in the level frame'
    )
    for axis, seconds in (
        ((1, 0, 0), 100),
        ((0, 1, 0), 100),
        ((0, 0, 1), 100),
        ((1, 1, 1), 60),
        ((1, 1, 0), 60),
        ((1, -1, 1), 60),
    ):
        growth = zhang.spin_growth(SENSOR.cosines, ARMS, axis, seconds=seconds)
        (body_v, body_p), (level_v, level_p) = (
            [zhang.largest(part) for part in growth[key]] for key in ('body', 'level')
        )
        print(
            f'axis {axis!s:11s} {seconds:3d} s: {body_v:5.2f} m/s {body_p:6.1f} m | {level_v:6.3f}'
            f' m/s {level_p:6.2f} m, steady along the axis {growth["axial_mg"]:+.3f} mg'
        )


def print_tumbling(rng):
    heading(
        'Figures 9 and 10, 60 s of three-axis sinusoids: peak errors and median improvement over'
        ' 300 estimates of the arms'
    )
    motions = (
        ((60, 45, 30), (0.7, 0.9, 1.1)),
        ((30,) * 3, (1.0,) * 3),
        ((90,) * 3, (0.5,) * 3),
        ((10,) * 3, (3.0,) * 3),
    )
    errors = {
        design: np.stack(
            [
                arm_errors(design_runs(design), *pair, rng=rng, n_draws=300)
                for pair in zip(SENSOR.cosines, ARMS)
            ],
            axis=1,
        )
        for design in DESIGNS
    }
    for amplitude, frequency in motions:
        responses = zhang.arm_responses(
            zhang.tumble(amplitude, frequency, sample_rate=100.0), SENSOR.cosines
        )
        plain = zhang.peaks(responses, ARMS)
        diagonal = zhang.peaks(responses, np.where(OFF_AXIS, ARMS, 0.0))
        gains = {
            design: np.median(plain[0] / zhang.peaks(responses, wrong)[0])
            for design, wrong in errors.items()
        }
        print(
            f'{amplitude} deg, {frequency} Hz: {plain[0, 0]:.2f} m/s {plain[1, 0]:.0f} m; on-axis'
            f' arms only {plain[0, 0] / diagonal[0, 0]:.1f}x; '
            + ', '.join(f'{design} {gain:.2f}x' for design, gain in gains.items())
        )


def print_findings():
    heading('Claims that are not reproduced')
    for k, finding in enumerate(findings(), start=1):
        print(f'{k}. {finding}')


def findings():
    """Yield sentences whose numbers are computed here."""
    norms = 1e6 * (np.linalg.norm(TABLE.cosines, axis=1) - 1)
    yield (
        f'Row y of Table 1 is no unit vector (norm off by {norms[1]:.1f} ppm; x {norms[0]:.3f}, z'
        f' {norms[2]:.3f}): theta_yy would have to be {SENSOR.angles_deg[1, 1]:.5f} deg instead of'
        f' {zhang.TABLE_1_ANGLES_DEG[1, 1]:.5f}.'
    )
    force = zhang.six_positions()
    worst = np.max(np.abs(TABLE.invert_as_printed(TABLE.predict(force)) - force))
    yield (
        'C is called orthogonal (eq. 3, 4), but its nine angles are free: the transpose is wrong'
        f' by {1e3 * worst:.2f} mg per g.'
    )
    plus, minus = zhang.TABLE_2_G[1, [0, 2]]
    yield (
        f'Table 1 uses the +1 g reading of Table 2 alone: {1e3 * plus:.2f} mg is'
        f' {np.rad2deg(np.arccos(plus)):.5f} deg; the half difference, which a bias requires, is'
        f' {np.rad2deg(np.arccos((plus - minus) / 2)):.4f} deg.'
    )
    ratios = [
        (abs(t[i, c] - s) / abs(t[i, c + 1] - s))
        for t in (zhang.TABLE_2_G, zhang.TABLE_4_G)
        for c in (0, 2)
        for i in range(3)
        for s in [(1.0 - c) if i == 0 else 0.0]
    ]
    after = 1e3 * np.abs(zhang.TABLE_4_G[:, 1] - [1, 0, 0])
    yield (
        f'"Less than 1 mg" is false for Table 4: x {after[0]:.2f}, z {after[2]:.2f} mg remain;'
        f' improvements in both tables run from {min(ratios):.2f}x to {max(ratios):.1f}x, where'
        ' "one or two orders" is claimed.'
    )
    move = 1e3 * (np.mean(zhang.TABLE_4_G[0, [0, 2]]) - np.mean(zhang.TABLE_2_G[0, [0, 2]]))
    yield (
        f'The x bias moves by {move:.2f} mg between Tables 2 and 4, which no lever arm explains:'
        ' another mounting or drift.'
    )
    shift = 1e3 * np.mean(zhang.TABLE_4_G[1:, [0, 2]] - zhang.TABLE_2_G[1:, [0, 2]], axis=1)
    implied = -shift * MG / np.deg2rad(100) ** 2
    yield (
        'Table 3 has the sign of the text ("from A to the origin"), not that of eq. 11 and 21: the'
        f' spin moves y and z by {shift[0]:.2f} and {shift[1]:.2f} mg, hence arms of'
        f' {1e3 * implied[0]:+.2f} and {1e3 * implied[1]:+.2f} mm where {-1e3 * ARMS[1, 1]:.2f} and'
        f' {-1e3 * ARMS[2, 2]:.2f} are printed.'
    )
    rate = np.deg2rad(200)
    static, spinning = closed_form_means(np.random.default_rng(0), rate, 0.0)
    wrong = zhang.closed_form(static, spinning, rate, directions=SENSOR.cosines, as_printed=True)
    yield (
        'The fourth term of r_jx in eq. 24 lacks a 0: as printed r_jx comes out as'
        f' {row(wrong[:, 0], " .3f")} m instead of {row(ARMS[:, 0], " .4f")}.'
    )
    sd = 1e3 * zhang.closed_form_sd(0.75 * MG, rate, SENSOR.cosines)
    skewed = skewed_axes(60)
    skewed_sd = zhang.closed_form_sd(0.75 * MG, rate, SENSOR.cosines, spin_axes=skewed)
    yield (
        "Only r_xx, r_yy, r_zz can be seen: at 200 deg/s and the sensor's 0.75 mg the off-axis"
        f' arms have sd {sd[OFF_AXIS].min():.0f} to {sd[OFF_AXIS].max():.0f} mm, the printed values'
        f' are {1e3 * np.abs(ARMS[OFF_AXIS]).min():.2f} to {1e3 * np.abs(ARMS[OFF_AXIS]).max():.2f}'
        ' mm. Averaging over rates adds no information; a skewed fixture'
        f' ({1e3 * skewed_sd.max():.1f}'
        ' mm) or oscillations do.'
    )
    equilibrated = np.linalg.cond(
        jacobian(design_runs('Z0'), TRUTH[0])
        / np.linalg.norm(jacobian(design_runs('Z0'), TRUTH[0]), axis=0)
    )
    yield (
        f"An equilibrated condition number does not see this ({equilibrated:.1f} for Zhang's"
        ' design); tolerances do.'
    )
    acceleration = np.deg2rad(100) ** 2 * 0.01
    growth = zhang.spin_growth(SENSOR.cosines, ARMS, (1, 0, 0))
    yield (
        f'"3 m/s and 150 m in 100 s" is {100 * acceleration:.2f} m/s and {5000 * acceleration:.0f}'
        ' m by arithmetic, but the error turns with the body: with Table 3 it stays below'
        f' {zhang.largest(growth["level"][0]):.3f} m/s and'
        f' {zhang.largest(growth["level"][1]):.1f} m.'
    )
    constant = 4.0**2 / (2 * 100.0)
    yield (
        f'4 m/s and 100 m belong to a constant {1e3 * constant / G:.2f} mg over'
        f' {4.0 / constant:.0f} s; 0.02 m/s and 0.3 m to another length, {2 * 0.3 / 0.02:.0f} s. z'
        f' of Table 2 gives {zhang.TABLE_2_G[2, 0] * -G * 47.4:.2f} m/s and'
        f' {zhang.TABLE_2_G[2, 0] * -G * 47.4**2 / 2:.1f} m at 47.4 s.'
    )
    left = zhang.TABLE_2_G[1, 1] * G
    yield (
        f'y of Table 2 after compensation ({1e3 * zhang.TABLE_2_G[1, 1]:.2f} mg) alone gives'
        f' {left * 50:.2f} m/s, {left * 1250:.0f} m in 50 s: {left * 50 / 0.02:.0f} and'
        f' {left * 1250 / 0.3:.0f} times the claimed value.'
    )
    tilt = np.sin(np.deg2rad(2 / 60)) * G
    yield f'Levelling to 2 arcmin alone gives {tilt * 50:.2f} m/s and {tilt * 1250:.1f} m in 50 s.'
    yield (
        '"15 parameters" are 3 + 9 + 3, of which 12 are independent (unit rows); the nine arms are'
        ' not counted: 21. Eq. 11 lost the dot on the tangential term, eq. 20 and 21 carry wrong'
        ' indices, Table 3 has no unit.'
    )


def main():
    print_table_1()
    print_tables_2_and_4(np.random.default_rng(24))
    print_table_3(np.random.default_rng(3))
    print_designs()
    print_static_navigation(np.random.default_rng(6))
    print_spins()
    print_tumbling(np.random.default_rng(9))
    print_findings()


if __name__ == '__main__':
    main()

"""
The angular acceleration of streams with the stamps that drivers make.

The test includes its stated error where the stamps give less.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imu_calibration.compensation.angular_acceleration import CausalDerivative, TimedDerivative
from imu_calibration.compensation.rate_slope import RateSlope, RecentRows
from imu_calibration.compensation.stream import CompensationStream, derivative_for
from imu_calibration.core.samples import ImuSamples
from imu_calibration.nodes.message_compensation import LiveCompensation
from imu_calibration.preprocessing.stamping import COUNTED, IRREGULAR, REGULAR, describe_stamps
from msg_adapters.imu import FIELDS
from msg_adapters.write import encode_imu
from validation.imu_messages import parse_imu, patch_imu

from worlds.compensation_cases import random_calibration

START, PERIOD_NS, N = 10**18, 5_000_000, 2000
N_MESSAGES = 1200
"""Samples that pass the node one by one; the first 400 are not judged."""
ARM = 0.05
NOISE = 0.002
"""White noise of the rate, rad/s; the calibration that is used says the same."""


def stamps_of(kind, true_ns, rng):
    """The stamps that a driver of that kind gives to samples taken at `true_ns`."""
    index, n = np.arange(len(true_ns)), len(true_ns)
    if kind == 'usb packets':  # eight samples, 20 us apart, when the last of them was taken
        last = np.minimum(index | 7, n - 1)
        return true_ns[last] + 300_000 + 20_000 * (index % 8)
    if kind == 'arrival':
        return np.maximum.accumulate(true_ns + rng.exponential(0.5e6, n).astype(np.int64))
    if kind == 'milliseconds':
        return true_ns // 1_000_000 * 1_000_000
    if kind == 'jitter':
        return true_ns + rng.normal(0.0, 0.2 * PERIOD_NS, n).astype(np.int64)
    if kind == 'runaway':  # steps of any length that have nothing to do with the sampling
        return true_ns[0] + np.cumsum(rng.exponential(PERIOD_NS, n)).astype(np.int64)
    # 'normal 2.0 ms', 'exponential 3.0 ms': independent, so that stamps overtake each other.
    if kind.endswith(' ms'):
        law, scatter, _ = kind.split()
        return true_ns + (1e6 * float(scatter) * getattr(rng, f'standard_{law}')(n)).astype(
            np.int64
        )
    return {'regular': true_ns, 'irregular': true_ns, 'zeros': np.zeros(n, np.int64)}[kind]


DRIVERS = ('regular', 'usb packets', 'arrival', 'milliseconds', 'jitter')


def motion(time_s):
    """Rate and its derivative at some times, each (n, 3)."""
    amplitude, omega, phase = (
        np.array([[3.0, 1.0, 0.5], [0.4, 2.0, 0.3], [1.0, 0.5, 2.0]]),
        np.array([4.0, 9.0, 15.0]),
        np.array([0.3, 1.0, 2.0]),
    )
    angle = np.outer(time_s, omega) + phase
    return np.sin(angle) @ amplitude.T, (np.cos(angle) * omega) @ amplitude.T


def tracker():
    return RateSlope(lambda period: CausalDerivative(max(int(0.04 / period), 2), period))


@given(
    st.lists(
        st.tuples(
            st.sampled_from((*DRIVERS, 'runaway', 'zeros')),
            st.integers(1, 400),
            st.sampled_from((1.0, 1.0, 0.4, 2.5)),
            st.sampled_from((0, 0, 30_000_000, 3_000_000_000, -5_000_000_000)),
        ),
        min_size=1,
        max_size=5,
    ),
    st.data(),
)
def test_blocks_give_the_same_as_samples_however_the_stream_is_cut(stretches, data):
    rng, parts, end = np.random.default_rng(len(stretches)), [], START
    for kind, n, scale, pause in stretches:
        parts.append(
            stamps_of(kind, end + (PERIOD_NS * scale * np.arange(1, n + 1)).astype(np.int64), rng)
        )
        end += int(PERIOD_NS * scale * n) + pause
    stamps = np.concatenate(parts)
    keep = np.sort(rng.integers(0, len(stamps), len(stamps)))  # some lost, some twice
    stamps, values = stamps[keep], rng.normal(size=(len(stamps), 3))[keep]
    cuts = sorted({0, len(stamps), *data.draw(st.lists(st.integers(0, len(stamps)), max_size=4))})
    one, other = tracker(), tracker()
    expected = np.array(
        [one.push(int(stamp), *value) for stamp, value in zip(stamps, values.tolist())]
    )
    got = np.concatenate(
        [other.push_block(stamps[a:b], values[a:b]) for a, b in zip(cuts, cuts[1:])]
    )
    # Values of 1 over 1 ms: rounding of 1e-13 x 1000.
    np.testing.assert_allclose(got, expected, atol=1e-8)
    assert (one.line, one.derivative, one.n_without) == (
        other.line,
        other.derivative,
        other.n_without,
    )
    np.testing.assert_allclose(one.error().moment, other.error().moment, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize('kind', DRIVERS)
def test_whatever_the_stamps_the_derivative_is_that_of_the_true_times(kind):
    """
    Within 3 %: the period is told from 256 stamps, of which a packet's may be late by 8 of them.
    """
    true_ns = START + PERIOD_NS * np.arange(N)
    rate, _ = motion((true_ns - START) * 1e-9)
    found, ideal = tracker(), tracker()
    got = found.push_block(stamps_of(kind, true_ns, np.random.default_rng(1)), rate)[300:]
    expected = ideal.push_block(true_ns, rate)[300:]
    assert np.sqrt(np.mean((got - expected) ** 2) / np.mean(expected**2)) < 0.03
    assert (
        found.line.word == (COUNTED if kind in ('usb packets', 'jitter') else REGULAR)
        and not found.doubt
        and not found.n_without
    )


@pytest.mark.parametrize('kind', ('regular', 'usb packets'))
@pytest.mark.parametrize('factor', (0.5, 0.7, 0.9, 1.3, 3.0))
def test_a_rate_that_changes_in_mid_stream_is_followed(kind, factor):
    true_ns = START + np.cumsum(np.repeat([PERIOD_NS, round(PERIOD_NS * factor)], N)).astype(
        np.int64
    )
    rate, _ = motion((true_ns - START) * 1e-9)
    found = tracker()
    got = found.push_block(stamps_of(kind, true_ns, np.random.default_rng(1)), rate)[N + 600 :]
    assert found.line.period_ns == pytest.approx(PERIOD_NS * factor, rel=0.03)
    ideal = tracker()
    expected = ideal.push_block(true_ns[N:], rate[N:])[600:]
    assert np.sqrt(np.mean((got - expected) ** 2) / np.mean(expected**2)) < 0.06


def test_a_packet_that_is_lost_costs_one_window_and_no_false_derivative():
    true_ns = START + PERIOD_NS * np.arange(N)
    rate, _ = motion((true_ns - START) * 1e-9)
    stamps, keep = (
        stamps_of('usb packets', true_ns, None),
        np.delete(np.arange(N), np.arange(1000, 1016)),
    )
    found, ideal = tracker(), tracker()
    got, expected = (
        found.push_block(stamps[keep], rate[keep]),
        ideal.push_block(true_ns, rate)[keep],
    )
    assert np.all(got[1000:1003] == 0.0)
    np.testing.assert_allclose(
        got[1012:1100], expected[1012:1100], atol=0.04 * np.abs(expected).max()
    )


def test_stamps_that_stand_still_give_no_derivative_and_its_size_as_the_error():
    true_ns = START + PERIOD_NS * np.arange(N)
    found = tracker()
    got = found.push_block(stamps_of('zeros', true_ns, None), motion((true_ns - START) * 1e-9)[0])
    assert (
        found.line.word == IRREGULAR
        and found.doubt
        and found.n_without > N - 400
        and np.all(got == 0.0)
    )


@pytest.mark.parametrize('taps', (2, 4, 9, 40))
def test_irregular_stamps_give_the_least_squares_slope_over_them(taps):
    """
    Within the noise of as many equal steps.

    A straight line exactly, noise with at most the stated sd, over 4000 samples.
    """
    rng = np.random.default_rng(taps)
    stamps = START + np.cumsum(rng.exponential(PERIOD_NS, 4000)).astype(np.int64)
    derivative = CausalDerivative(taps, PERIOD_NS * 1e-9)
    line, noise = TimedDerivative(derivative), TimedDerivative(derivative)
    slopes = np.array(
        [
            line.push(int(stamp), *(1e-9 * (stamp - START) * np.array([2.0, -3.0, 0.5])))
            for stamp in stamps
        ]
    )
    np.testing.assert_allclose(
        slopes[200:], np.broadcast_to([2.0, -3.0, 0.5], (3800, 3)), rtol=1e-6
    )
    noisy = np.array(
        [
            noise.push(int(stamp), *values)
            for stamp, values in zip(stamps, rng.normal(size=(4000, 3)))
        ]
    )
    assert 0.4 < noisy[200:].std() / derivative.noise_sd(1.0) < 1.05
    assert noise.push(int(stamps[-2]), 9.0, 9.0, 9.0) == tuple(noisy[-1])  # an earlier stamp
    assert noise.push(int(stamps[-1]) + 10**9, 9.0, 9.0, 9.0) == (0.0, 0.0, 0.0)  # behind a pause


def world(kind, seed=0, lively=1.0, arm=ARM, period_ns=PERIOD_NS, n=N_MESSAGES):
    """
    Calibration with an arm, measured samples, and the true specific force.

    The true specific force is at the point that it is corrected to.
    """
    calibration = random_calibration(4, ('accel_size_effect',), (), sd=1e-9)
    values = calibration.values.copy()
    values[calibration.model.slices['accelerometer', 'accel_size_effect']] *= arm / 0.02
    calibration, rng = replace(calibration, values=values), np.random.default_rng(seed)
    steps = period_ns * (rng.exponential(1.0, n) if kind == 'irregular' else np.ones(n))
    true_ns = START + np.cumsum(steps).astype(np.int64)
    rate, alpha = motion(lively * (true_ns - START) * 1e-9)
    alpha = lively * alpha
    arms = calibration.value('accelerometer', 'accel_size_effect')
    force = np.array([0.0, 0.0, 9.8]) + np.zeros((n, 3))
    felt = force + np.stack(
        [
            (np.cross(alpha, arm) + np.cross(rate, np.cross(rate, arm)))[:, k]
            for k, arm in enumerate(arms)
        ],
        axis=1,
    )
    force_sd, rate_sd = (calibration.noise(sensor)[0] for sensor in ('accelerometer', 'gyroscope'))
    measured = (
        felt @ calibration.value('accelerometer', 'matrix').T
        + calibration.value('accelerometer', 'bias')
        + force_sd * rng.normal(size=(n, 3))
    )
    turned = (
        rate @ calibration.value('gyroscope', 'matrix').T
        + calibration.value('gyroscope', 'bias')
        + rate_sd * rng.normal(size=(n, 3))
    )
    return (
        calibration,
        ImuSamples(stamps_of(kind, true_ns, rng), measured, turned, 'imu_link'),
        force,
    )


@pytest.mark.parametrize('kind', (*DRIVERS, 'runaway', 'irregular', 'exponential 5.0 ms'))
@pytest.mark.parametrize('lively', (0.0, 1.0))
def test_the_covariance_that_is_published_is_that_of_the_error(kind, lively):
    """
    True error against stated sd, rms over the stream.

    It was 40 times too sure where the delay counts.
    """
    calibration, imu, force = world(kind, lively=lively)
    live = LiveCompensation(calibration)
    ratios = []
    for k, message in enumerate(encode_imu(imu)):
        out = parse_imu(live(message.tobytes())).doubles
        if k >= 400:
            error, cov = (
                np.array(out[FIELDS['force_s']]) - force[k],
                np.reshape(out[FIELDS['force_cov']], (3, 3)),
            )
            ratios.append(error**2 / np.diag(cov))
        if k % 100 == 0:
            live.refresh()
    found = np.sqrt(np.mean(ratios))
    print(f'{kind}, motion x {lively:g}: error / stated sd {found:.2f}')
    assert 0.5 < found < 1.4


@pytest.mark.parametrize(
    ('kind', 'period_ms'),
    (
        ('normal 2.0 ms', 5),
        ('normal 3.0 ms', 5),
        ('normal 8.0 ms', 5),
        ('normal 3.0 ms', 1),
        ('exponential 10.0 ms', 5),
        ('exponential 3.0 ms', 1),
        ('irregular', 5),
        ('irregular', 10),
    ),
)
def test_the_lever_arm_is_corrected_though_stamps_overtake_each_other(kind, period_ms):
    """
    Arm of 0.5 m, an effect of 5.9 m/s^2 rms: at most 0.9 m/s^2 rms remain, as for regular stamps.

    Jitter disabled the correction.
    """
    calibration, imu, force = world(
        kind,
        seed=3,
        lively=0.34 if period_ms > 1 else 0.53,
        arm=0.5,
        period_ns=1_000_000 * period_ms,
        n=N_MESSAGES if period_ms > 1 else N,
    )
    live = LiveCompensation(calibration)
    out = np.array(
        [
            parse_imu(live(message.tobytes())).doubles[FIELDS['force_s']]
            for message in encode_imu(imu)
        ]
    )
    calibrated = (imu.force_s - calibration.value('accelerometer', 'bias')) @ np.linalg.inv(
        calibration.value('accelerometer', 'matrix')
    ).T
    raw, remaining = (
        np.sqrt(np.mean(((values - force)[400:] ** 2).sum(axis=1))) for values in (calibrated, out)
    )
    print(f'{kind}, {period_ms} ms: {raw:.2f} -> {remaining:.2f}')
    assert 5.3 < raw < 6.6 and remaining <= 0.9


@pytest.mark.parametrize('kind', ('normal 2.0 ms', 'exponential 10.0 ms'))
def test_samples_lost_behind_jitter_give_no_false_derivative(kind):
    """
    A hole of 300 ms.

    The derivative is never farther off than without one, up to 1.5 times its largest value.
    """
    true_ns = START + PERIOD_NS * np.arange(N)
    rate, alpha = motion((true_ns - START) * 1e-9)
    keep = np.delete(np.arange(N), np.arange(1000, 1060))
    got = tracker().push_block(stamps_of(kind, true_ns, np.random.default_rng(5))[keep], rate[keep])
    assert np.abs(got[300:]).max() < 1.5 * np.abs(alpha).max()
    np.testing.assert_allclose(
        got[1020:],
        tracker().push_block(true_ns, rate)[keep][1020:],
        atol=0.05 * np.abs(alpha).max(),
    )


def test_offline_says_the_same_as_live():
    calibration, imu, _ = world('usb packets')
    live, offline = LiveCompensation(calibration), CompensationStream(calibration)
    out = [parse_imu(live(message.tobytes())).doubles for message in encode_imu(imu)]
    force = offline.correct(imu).force
    # The period from 256 or from all stamps.
    np.testing.assert_allclose([d[FIELDS['force_s']] for d in out[600:]], force[600:], atol=0.1)
    live.refresh()
    stated = parse_imu(live(encode_imu(imu)[-1].tobytes())).doubles[FIELDS['force_cov']]
    np.testing.assert_allclose(
        np.diag(np.reshape(stated, (3, 3))), np.diag(offline.propagate(None, None)[0]), rtol=0.2
    )
    assert describe_stamps(imu.stamp_ns).word == COUNTED and not any(
        'clock' in line for line in offline.warnings()
    )
    calibration, imu, _ = world('zeros')
    offline = CompensationStream(calibration)
    offline.correct(imu)
    assert any('stamps of' in line for line in offline.warnings())


def test_a_new_calibration_goes_on_with_what_is_known_of_the_stamps():
    calibration, imu, _ = world('usb packets')
    data = [message.tobytes() for message in encode_imu(imu)]
    alone, first = LiveCompensation(calibration), LiveCompensation(calibration)
    expected = [alone(message) for message in data]
    for message in data[:1000]:
        first(message)
    second = LiveCompensation(calibration)
    second.prepare(first)
    second.follow(first)
    got = [second(message) for message in data[1000:]]
    np.testing.assert_allclose(
        [parse_imu(m).doubles[FIELDS['force_s']] for m in got],
        [parse_imu(m).doubles[FIELDS['force_s']] for m in expected[1000:]],
        atol=1e-9,
    )


def test_without_stamps_the_time_of_arrival_is_taken_and_told():
    calibration, imu, _ = world('regular')
    live, plain = LiveCompensation(calibration), LiveCompensation(calibration)
    without = replace(imu, stamp_ns=np.zeros(N_MESSAGES, np.int64))
    for k, (message, stamped) in enumerate(zip(encode_imu(without), encode_imu(imu))):
        out = live(message.tobytes(), int(imu.stamp_ns[k])), plain(stamped.tobytes())
    assert parse_imu(out[0]).stamp_ns == 0 and live.counts == {'zero stamp': N_MESSAGES}
    np.testing.assert_allclose(*(parse_imu(m).doubles[FIELDS['force_s']] for m in out), atol=1e-12)


@pytest.mark.parametrize('number', (np.nan, np.inf, 1e308, -0.5))
def test_covariances_that_are_none_are_replaced_and_noted(number):
    calibration, imu, _ = world('regular')
    live, plain = LiveCompensation(calibration), LiveCompensation(calibration)
    message = encode_imu(imu)[0].tobytes()
    covariance = [0.0, 0, 0, 0, number, 0, 0, 0, 1.0]
    odd = live(patch_imu(message, rate_cov=covariance, force_cov=covariance))
    expected = plain(message)
    for name in ('rate_cov', 'force_cov'):
        np.testing.assert_array_equal(
            parse_imu(odd).doubles[FIELDS[name]], parse_imu(expected).doubles[FIELDS[name]]
        )
    assert live.counts == {'covariance not finite': 1} and not plain.counts


def test_the_window_suits_the_period_that_was_found():
    calibration, imu, _ = world('usb packets')
    stream = CompensationStream(calibration)
    stream.correct(imu)
    assert stream.slope.derivative.taps == derivative_for(calibration, PERIOD_NS * 1e-9).taps


def test_recent_rows_are_the_newest_however_often_they_are_read():
    rows = RecentRows(5)
    for k in range(23):
        if k % 7 == 3:
            rows.extend(np.full((2, 3), float(k)))
        else:
            rows.append((float(k),) * 3)
        if k in (1, 2, 9, 20):  # also after more rows than are kept
            assert len(rows) == len(rows.array()) == min(k + 1, 5)
            np.testing.assert_array_equal(rows.array(), rows.copied())
    np.testing.assert_array_equal(rows.array()[:, 0], [18.0, 19.0, 20.0, 21.0, 22.0])
    rows.extend(np.arange(21.0).reshape(7, 3))
    np.testing.assert_array_equal(rows.array(), np.arange(6.0, 21.0).reshape(5, 3))

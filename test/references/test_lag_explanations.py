"""
Which of several explanations of the lags is told.

The simplest within the search's price, with a clock that both share.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.effects.reference_effects import total_lags
from imu_calibration.references.turntable.selection import lag_explanations
from imu_calibration.references.turntable.selection.lag_explanations import (
    MAX_CLOCK_LOSS,
    Explanation,
    LagExplanations,
    _explanations_of_pair,
    _Option,
    _rivals,
    simplest,
)
from imu_calibration.selection.search import TIE


def explanation(cost, **lags):
    return Explanation(lags, cost, {})


@pytest.mark.parametrize(
    'behind, told', [(0.5 * TIE, 'time_offset'), (1.5 * TIE, 'gyro_bandwidth')]
)
def test_a_shared_clock_is_told_before_a_lag_of_one_sensor_unless_the_evidence_denies_it(
    behind, told
):
    assert list(
        simplest(
            [explanation(0.0, gyro_bandwidth=1e-3), explanation(behind, time_offset=1e-3)]
        ).lags
    ) == [told]


def test_a_delay_is_told_before_a_filter_and_fewer_effects_before_more():
    explanations = [
        explanation(0.0, gyro_delay=1e-3, gyro_bandwidth=1e-3),
        explanation(1.0, gyro_filter=2e-3),
        explanation(2.0, gyro_delay=2e-3),
    ]
    assert list(simplest(explanations).lags) == ['gyro_delay']


@pytest.mark.parametrize(
    'silent, told', [(None, 'accel_delay'), (1e4, 'time_offset'), (1e3, 'accel_delay')]
)
def test_where_nothing_rests_a_shared_clock_may_be_behind_by_a_share_of_what_lags_explain(
    silent, told
):
    explanations = [
        explanation(0.0, accel_delay=9e-3, gyro_filter=11e-3),
        explanation(0.5 * MAX_CLOCK_LOSS * 1e4, time_offset=9e-3, gyro_bandwidth=3e-3),
    ]
    assert next(iter(simplest(explanations, silent).lags)) == told


def test_a_story_that_did_not_help_gives_way_to_a_shorter_one():
    both, one = (
        explanation(0.0, time_offset=9e-3, gyro_delay=3e-3),
        explanation(50.0, time_offset=10e-3),
    )
    explanations = LagExplanations(None, [both, one], [], None)
    assert simplest(explanations.explanations) is both
    assert explanations.others(1, [both]) == [one]


def test_what_did_not_help_is_not_tried_again_under_another_name():
    both, same, other = (
        explanation(0.0, gyro_delay=3e-3),
        explanation(0.0, gyro_filter=3e-3),
        explanation(1.0, time_offset=3e-3),
    )
    assert LagExplanations(None, [both, same, other], [], None).others(1, [both]) == [other]


def test_what_costs_more_than_no_lag_explains_nothing(monkeypatch):
    monkeypatch.setattr(
        lag_explanations,
        '_without_lag',
        lambda told, judges, sensor: option(sensor, (), [], cost=10.0),
    )
    monkeypatch.setattr(
        lag_explanations,
        '_option',
        lambda told, judges, sensor: option(
            sensor, ('delay',), [1e-3], cost=5.0 if sensor == 'gyroscope' else 10.5
        ),
    )
    told = lag_explanations._explanations([None], [], [])
    assert (
        told
        and all('gyro' in name or name == 'time_offset' for name in told[0].lags)
        and {'accel_delay'} not in [set(each.lags) for each in told]
    )


def option(sensor, kind, lags, sd=1e-5, cost=0.0):
    return _Option(sensor, kind, cost, np.array(lags), np.diag(np.full(len(lags), sd**2)), {})


def test_two_delays_share_a_clock_at_the_price_of_their_difference():
    one, two = (
        option('accelerometer', ('delay',), [9.0e-3]),
        option('gyroscope', ('delay',), [9.02e-3]),
    )
    told = {tuple(each.lags): each for each in _explanations_of_pair(one, two, [])}
    assert set(told) == {
        ('accel_delay', 'gyro_delay'),
        ('time_offset',),
        ('time_offset', 'gyro_delay'),
    }
    assert told['time_offset',].lags['time_offset'] == pytest.approx(9.01e-3)
    assert told['time_offset',].cost - told['accel_delay', 'gyro_delay'].cost == pytest.approx(
        0.5 * 2.0 - 1.0
    )
    assert told['time_offset', 'gyro_delay'].lags == pytest.approx(
        {'time_offset': 9.0e-3, 'gyro_delay': 2e-5}
    )


def test_a_filter_is_never_negative_but_a_clock_may_be_early():
    one, two = (
        option('accelerometer', ('delay',), [-3e-3]),
        option('gyroscope', ('delay', 'bandwidth'), [-3e-3, 4e-3]),
    )
    told = [each.lags for each in _explanations_of_pair(one, two, [])]
    assert told == [pytest.approx({'time_offset': -3e-3, 'gyro_bandwidth': 4e-3})]
    assert not list(_explanations_of_pair(one, option('gyroscope', ('bandwidth',), [-1e-3]), []))


def test_rivals_are_the_members_of_other_explanations_and_only_the_nearest_moves_parameters():
    asked = [
        SimpleNamespace(name=name, sensor=sensor)
        for name, sensor in [
            ('time_offset', 'reference'),
            ('gyro_delay', 'gyroscope'),
            ('gyro_filter', 'gyroscope'),
            ('accel_delay', 'accelerometer'),
        ]
    ]
    told, values = Explanation({'time_offset': 1e-3}, 1.0, {'bias': 0.0}), {'bias': 0.5}
    near = [
        Explanation({'gyro_delay': 1e-3}, 2.0, values),
        Explanation({'gyro_filter': 1e-3}, 4.0, values),
        Explanation({'accel_delay': 1e-3, 'gyro_delay': 1e-3}, 0.5, values),
        told,
    ]
    found = _rivals(SimpleNamespace(questions=asked), told, near)
    assert [(rival.question.name, rival.other.name, rival.behind) for rival in found] == [
        ('time_offset', 'gyro_delay', 1.0),
        ('time_offset', 'gyro_filter', 3.0),
    ]
    assert [rival.moves for rival in found] == [{'bias': 0.5}, {}]


def test_what_a_sensor_lags_by_in_all_keeps_its_standard_deviation_where_the_shares_are_uncertain():
    names = (
        'gyroscope.bias.x',
        'gyroscope.gyro_bandwidth.time_constant',
        'reference.time_offset.offset',
    )
    covariance = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -0.995], [0.0, -0.995, 1.0]])
    found = total_lags(names, np.array([5.0, 3.0, 9.0]), covariance)
    assert found == {'accelerometer': (9.0, 1.0), 'gyroscope': (12.0, pytest.approx(0.1))}

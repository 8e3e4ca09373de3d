"""
Every parameter of every node, set from outside.

A live one changes, any other one is rejected with the reason; the first line of each node.
"""

import pytest
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python

from imu_calibration.core.settings import describe
from imu_calibration.nodes import NODE_NAMES
from imu_calibration.nodes.lifecycle import settings_of
from imu_calibration.planning.campaign import CampaignSettings
from imu_calibration.planning.driver import DriverSettings

from ros.live_station import ROOT, TABLE, Station
from ros.planner_bench import PlannerBench

pytestmark = pytest.mark.live
SAMPLE = ROOT / 'bags' / 'sample_session'
START = {
    'simulator_node': {'profile': 'none', 'table_file': TABLE},
    'bag_player_node': {'bag': SAMPLE, 'wait_for_subscribers': 100},
    'planner_node': {'table_file': TABLE},
    'calibration_node': {'table_file': TABLE},
    'compensator_node': {},
}
TOPICS = {
    'calibration_node': (
        '/imu/data_raw, /joint_states, /imu/temperature',
        '/imu/calibration, /imu/residual, /imu/coverage',
    ),
    'compensator_node': ('/raw, /imu/calibration, /imu/temperature', '/imu/data_corrected'),
    'planner_node': (
        '/joint_states, /imu/calibration, /diagnostics',
        '/joint_trajectory, /imu/coverage',
    ),
    'simulator_node': ('/joint_trajectory', '/imu/data_raw, /joint_states'),
    'bag_player_node': ('/imu/data_raw, /joint_states',),
}
"""What the first line of a node names."""
SERVICES = {
    GetParameters: 'get_parameters',
    SetParameters: 'set_parameters',
    SetParametersAtomically: 'set_parameters_atomically',
}
OF_THE_TABLE = {'calibration_node': ('gravity', 'latitude')}
"""Live parameters by hand, which a session on a table refuses with the reason."""
NAMED = {
    'adopt': 'topic',
    'calibration_file': str(SAMPLE / 'truth.yaml'),
    'target_frame': 'base_link',
    'noise_file': '',
}
"""Values of live parameters that not every value fits."""


def other_value(item):
    """Return a value within the bounds that is not the default, of its type."""
    if item.name in NAMED and item.live:
        return NAMED[item.name]
    default, (low, high) = item.default, item.bounds
    if isinstance(default, bool):
        return not default
    if isinstance(default, (int, float)):
        tried = (
            [default + 1, default - 1]
            if isinstance(default, int)
            else [default * 1.25, default * 0.75, 0.5 * (high or 0.5)]
        )
        return next(
            value
            for value in tried
            if value != default
            and (low is None or value >= low)
            and (high is None or value <= high)
        )
    return [value + 0.25 for value in default] if isinstance(default, tuple) else 'other'


def plain(value):
    """Return an array as a list, anything else unchanged."""
    return list(value) if hasattr(value, '__len__') and not isinstance(value, str) else value


def asked(station, kind, node, **fields):
    """Call a parameter service of a node; a repeated call changes nothing."""
    return station.call(f'/{node}/{SERVICES[kind]}', kind, again=5.0, **fields)


@pytest.mark.parametrize('node', NODE_NAMES)
def test_a_live_parameter_changes_and_any_other_is_rejected_with_the_reason(node, tmp_path):
    items = [item for group in settings_of(node) for item in describe(group)]
    with Station(tmp_path / 'out.txt') as station:
        station.start(
            node,
            START[node],
            remappings={'imu/data_raw': '/raw'} if node == 'compensator_node' else {},
        )
        values = {item.name: other_value(item) for item in items} | (
            {'save_file': str(tmp_path / 'other.yaml')} if node == 'calibration_node' else {}
        )
        before = asked(station, GetParameters, node, names=list(values)).values
        messages = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        fixed = OF_THE_TABLE.get(node, ())
        live = []
        for message, item in zip(messages, items, strict=True):
            if item.live and item.name not in fixed:
                live.append(message)
        together = asked(
            station, SetParametersAtomically, node, parameters=live
        ).result  # a pose needs its frame, and the reverse
        results = asked(station, SetParameters, node, parameters=messages).results
        after = asked(station, GetParameters, node, names=list(values)).values
        (process,) = station.processes.running
        assert process.poll() is None
    first = (tmp_path / 'out.txt').read_text().splitlines()[0]
    assert all(topics in first for topics in TOPICS[node]), first
    for item, old, new, result in zip(items, before, after, results, strict=True):
        old, new = (parameter_value_to_python(value) for value in (old, new))
        if item.name in fixed:
            assert not result.successful and plain(new) == plain(old), item.name
            assert 'gravity' in result.reason, result.reason
        elif item.live:
            assert together.successful and result.successful and plain(new) == values[item.name], (
                item.name,
                together.reason,
                result.reason,
            )
        else:
            assert not result.successful and plain(new) == plain(old), item.name
            assert item.fixed in result.reason or 'read-only' in result.reason, (
                item.name,
                result.reason,
            )


def test_speeds_tolerances_patience_and_time_limit_of_the_planner_are_in_force_once_set(
    monkeypatch, tmp_path
):
    with PlannerBench(monkeypatch, tmp_path) as bench:
        settings = {
            item.name: other_value(item)
            for group in (DriverSettings, CampaignSettings)
            for item in describe(group)
        }
        assert all(result.successful for result in bench.set(**settings))
        planner = bench.planner
        assert vars(planner.driver.settings) | vars(planner._campaign_settings) == settings
        assert planner.driver.tolerance.tolist() == [settings['following_tolerance']] * 2
        bench.set(settling_time=0.1, first_speed=0.05)
        bench.moving()
        slow = max(
            abs(rate)
            for message in bench.trajectories
            for point in message.points
            for rate in point.velocities
        )
        assert slow <= 0.05 * 100.0 * 3.14159 / 180
        bench.set(time_limit=12.5)
        assert planner.worker.campaign.settings.time_limit == 12.5

"""The line about a silent topic never proposes the output of a compensator."""

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

from imu_calibration.nodes.inputs import MatchedInput

IMU = 'sensor_msgs/msg/Imu'


def node_with(publishers, compensators=()):
    """Return a node '/compensator' in a graph: topic -> name of the node that publishes it."""
    return SimpleNamespace(
        get_fully_qualified_name=lambda: '/compensator',
        get_topic_names_and_types=lambda: [(topic, [IMU]) for topic in publishers],
        count_publishers=lambda topic: 1,
        get_publishers_info_by_topic=lambda topic: [
            SimpleNamespace(node_name=publishers[topic], node_namespace='/')
        ],
        get_service_names_and_types_by_node=lambda name, space: [
            (f'/{name}/{"reload" if name in compensators else "get_parameters"}', [])
        ],
    )


def silence_of(node):
    """Return the line of an input without a publisher."""
    silent = object.__new__(MatchedInput)
    silent.node, silent.topic = node, 'imu/data_raw'
    silent.subscription, silent.type_name = SimpleNamespace(topic_name='/imu/data_raw'), IMU
    silent.publishers, silent.others = [], []
    return silent.silence()


def test_only_the_topic_of_a_driver_is_proposed():
    own = node_with({'/imu/data': 'compensator'})
    second = node_with({'/imu/data': 'second'}, compensators=['second'])
    driver = node_with({'/imu/data': 'compensator', '/imu/raw': 'driver'})
    assert ['-r imu/data_raw' in silence_of(node) for node in (own, second)] == [False, False]
    assert ['driver runs' in silence_of(node) for node in (own, second)] == [True, True]
    assert '-r imu/data_raw:=/imu/raw' in silence_of(driver)
    assert '/imu/data;' not in silence_of(driver)

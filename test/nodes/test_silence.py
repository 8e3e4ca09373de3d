"""The line about a silent topic never proposes the output of a compensator."""

from types import SimpleNamespace

import pytest

from imu_calibration.nodes.inputs import MatchedInput

from ros.live_station import Station

IMU = 'sensor_msgs/msg/Imu'


def node_with(publishers, compensators=()):
    """
    Return a node '/compensator' in a graph: topic -> name of the node that publishes it.

    A search by topic would apply the remappings of the node.
    """
    return SimpleNamespace(
        get_fully_qualified_name=lambda: '/compensator',
        get_node_names_and_namespaces=lambda: [(name, '/') for name in set(publishers.values())],
        get_publisher_names_and_types_by_node=lambda node, space: [
            (topic, [IMU]) for topic, name in publishers.items() if name == node
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


@pytest.mark.live
def test_a_driver_on_the_topic_before_its_remapping_is_proposed():
    """A search by topic found no publisher of imu/data_raw in a node that remaps this name."""
    import rclpy
    from sensor_msgs.msg import Imu

    with Station() as station:
        driver = rclpy.create_node('driver', context=station.context)
        remapped = rclpy.create_node(
            'remapped',
            context=station.context,
            cli_args=['--ros-args', '-r', 'imu/data_raw:=imu/data_rwa'],
        )
        try:
            driver.create_publisher(Imu, '/imu/data_raw', 1)
            silent = MatchedInput(remapped, Imu, 'imu/data_raw', callback=lambda message: None)
            expected = '-r imu/data_raw:=/imu/data_raw'
            station.until(lambda: expected in silent.silence(), 'the topic of the driver')
        finally:
            driver.destroy_node()
            remapped.destroy_node()

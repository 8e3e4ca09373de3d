"""
compensator_node on a robot whose gyroscope warms up.

The stops say so on /diagnostics, and an update takes it off where it is allowed.
"""

from dataclasses import replace

import numpy as np
import pytest
from rclpy.parameter import Parameter
from sensor_msgs.msg import Temperature

from imu_calibration.core.units import DEG
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.nodes.compensator_node import CompensatorNode
from msg_adapters.imu_stream import ImuStream
from msg_adapters.layout import Packed
from msg_adapters.write import encode_imu

from worlds.drives import drive, plain_calibration

pytestmark = [pytest.mark.live, pytest.mark.usefixtures('executor_only')]
OK, WARN, ERROR = range(3)
STATUS = 'compensator_node: health'
WORLD = drive(6, 6, warm_up=(0.0, 0.0, 0.3 * DEG))
MESSAGES = [bytes(row) for row in Packed.of_rows(encode_imu(WORLD.imu)).views()]


def start(bench, tmp_path, conditions=None, **parameters):
    """A node with a calibration that knows its bias."""
    calibration = plain_calibration()
    calibration.conditions.update(conditions or {})
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(calibration))
    return bench.start(
        CompensatorNode, {'calibration_file': str(tmp_path / 'calibration.yaml'), **parameters}
    )


def converted(node, messages=MESSAGES):
    """(rates, last covariance of the rate) of what the node makes of messages."""
    stream, out = (
        ImuStream(),
        [node.convert(message, {'source_timestamp': 1}) for message in messages],
    )
    stream.open(out[-1])
    return np.array([stream.read(message)[1][:3] for message in out]), stream.covariances(out[-1])[
        1
    ]


def test_a_drift_is_told_at_the_stops(bench, tmp_path):
    node = start(bench, tmp_path)
    bench.until(lambda: STATUS in bench.status, 'a first status')
    assert bench.lines()[STATUS][0] == OK and bench.figure(STATUS, 'outcome') == 'waiting'
    converted(node)
    bench.until(lambda: bench.lines()[STATUS][0] == WARN, 'a warning')
    assert (
        bench.shows(STATUS, 'gyroscope', '+0.2')
        and bench.heard('gyroscope', '+0.2', level='warning') == 1
    )
    assert bench.figure(STATUS, 'outcome') == 'moved' and bench.figure(STATUS, 'stops') == '9'


def test_gravity_follows_from_the_latitude_of_the_robot(bench, tmp_path):
    node = start(bench, tmp_path, latitude=0.0)
    converted(node)
    bench.until(lambda: bench.figure(STATUS, 'gravity expected [m/s^2]') == '9.7803', 'gravity')
    answer = node.set_parameters_atomically([Parameter('latitude', value=90.0)])
    options = node.compensation.watch.health.options
    assert answer.successful and options.gravity == pytest.approx(
        9.8321849378
    )  # WGS 84 at the pole


def test_a_driver_that_publishes_g_is_told_the_unit_and_nothing_is_published(bench, tmp_path):
    node = start(bench, tmp_path)
    in_g = replace(WORLD.imu, force_s=WORLD.imu.force_s / 9.80665)
    rows = [bytes(row) for row in Packed.of_rows(encode_imu(in_g)).views()]
    assert {node.convert(row, {'source_timestamp': 1}) for row in rows} == {None}
    bench.until(
        lambda: any(
            level == ERROR and 'm/s^2' in text and 'probably g' in text
            for level, text in bench.lines().values()
        ),
        'an error',
    )


def test_an_update_is_taken_off_where_it_is_allowed_and_its_uncertainty_is_published(
    bench, tmp_path
):
    node = start(bench, tmp_path, update_gyro_bias=True)
    rates, _ = converted(node)
    left = rates[-3000:] - WORLD.imu.rate_s[-3000:] + WORLD.bias[-3000:]
    assert np.abs(left).max() < 0.25 * np.abs(WORLD.bias[-3000:]).max()
    bench.until(lambda: bench.figure(STATUS, 'outcome') == 'followed', 'word of it')
    assert bench.lines()[STATUS][0] == OK and bench.figure(STATUS, 'bias update [deg/s]').split(
        ', '
    )[2].startswith('+0.2')
    node.compensation.refresh()
    _, with_update = converted(node, MESSAGES[-1:])
    assert node.compensation.watch.rate_cov[2, 2] > 0
    watch = node.compensation.watch
    assert node.set_parameters_atomically(
        [Parameter('parameter_covariance', value=False)]
    ).successful
    assert node.compensation.watch is watch  # what the stops have shown is not forgotten
    assert node.set_parameters_atomically([Parameter('update_gyro_bias', value=False)]).successful
    _, without = converted(node, MESSAGES[-1:])
    assert with_update[2, 2] > without[2, 2] + 0.9 * watch.rate_cov[2, 2]


def test_a_temperature_outside_the_calibration_is_told(bench, tmp_path):
    start(bench, tmp_path, {'temperature_range_c': [20.0, 30.0]})
    publisher = bench.node.create_publisher(Temperature, 'imu/temperature', 10)
    bench.until(lambda: publisher.get_subscription_count(), 'the node to listen')
    publisher.publish(Temperature(temperature=50.0))
    bench.until(lambda: bench.shows(STATUS, '50.0', '20.0', '30.0 C', level=WARN), 'a warning')

"""
Processes of the relay benchmark.

A source and a sink of serialized messages, and the rclpy relay for comparison.
"""

import json
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

if __name__ == '__main__':
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402
import rclpy  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402

from imu_calibration.core.samples import ImuSamples  # noqa: E402
from imu_calibration.nodes import relay_loop  # noqa: E402
from imu_calibration.nodes.inputs import input_qos, output_qos  # noqa: E402
from msg_adapters.imu import find_imu_layout  # noqa: E402
from msg_adapters.write import encode_imu  # noqa: E402

ORIENTATION, STAMP_AT = 'orientation', 4
END = 2.0**40
"""Number of the message that ends a run."""


def template():
    """
    Return one serialized message of an IMU in motion, and the offset of its number.

    The number identifies each message.
    """
    imu = ImuSamples(
        np.zeros(1, np.int64),
        np.array([[0.3, -0.2, 9.8]]),
        np.array([[0.4, -0.7, 0.2]]),
        'imu_link',
    )
    data = bytearray(encode_imu(imu)[0].tobytes())
    return data, find_imu_layout(bytes(data)).offsets[ORIENTATION][0]


def source(topic, rate, seconds):
    """
    Publish with the send time as stamp and a running number as orientation.x.

    Late messages are sent immediately.
    """
    node = rclpy.create_node('bench_source')
    publisher = node.create_publisher(Imu, topic, output_qos())
    data, number_at = template()
    deadline = time.monotonic() + 20.0
    while publisher.get_subscription_count() < 1 and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)
    count, publish = round(rate * seconds), publisher.publish
    print('start', flush=True)
    start = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    for k in range(count):
        due = start + int(k * 1e9 / rate)
        wait = due - time.clock_gettime_ns(time.CLOCK_MONOTONIC)
        if wait > 0:
            time.sleep(wait * 1e-9)
        struct.pack_into('<d', data, number_at, float(k))
        struct.pack_into(
            '<iI', data, STAMP_AT, *divmod(time.clock_gettime_ns(time.CLOCK_MONOTONIC), 10**9)
        )
        publish(bytes(data))
    lasted = (time.clock_gettime_ns(time.CLOCK_MONOTONIC) - start) * 1e-9
    time.sleep(0.5)
    print(json.dumps({'sent': count, 'rate': count / lasted}), flush=True)
    struct.pack_into('<d', data, number_at, END)
    publish(bytes(data))
    time.sleep(0.5)
    node.destroy_node()


class _Ended(Exception):
    """The last message was received."""


def sink(topic):
    """Print the number and the latencies of the received messages, after the last one."""
    node = rclpy.create_node('bench_sink')
    number_at = template()[1]
    late, numbers = [], []

    def record(data, information):
        now = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
        number = struct.unpack_from('<d', data, number_at)[0]
        if number == END:
            raise _Ended
        seconds, nanoseconds = struct.unpack_from('<iI', data, STAMP_AT)
        numbers.append(number)
        late.append(now - seconds * 10**9 - nanoseconds)

    group = relay_loop.OutsideExecutor()
    callback: Callable[..., None] = record
    subscription = node.create_subscription(
        Imu, topic, callback, input_qos(reliable=True), raw=True, callback_group=group
    )
    nowhere = node.create_publisher(Imu, topic + '/nowhere', output_qos())
    deadline = time.monotonic() + 20.0
    while subscription.get_publisher_count() < 1 and time.monotonic() < deadline:
        time.sleep(0.05)
    print('ready', flush=True)
    try:
        relay_loop.relay(node, SimpleNamespace(subscription=subscription), nowhere, convert=record)
    except _Ended:
        pass
    node.destroy_node()
    late = np.array(late) * 1e-3
    print(
        json.dumps(
            {
                'came': len(set(numbers)),
                'doubled': len(numbers) - len(set(numbers)),
                'late_us': (
                    np.round(np.percentile(late, np.arange(0, 101)), 1).tolist()
                    if len(late)
                    else []
                ),
            }
        ),
        flush=True,
    )


def plain_relay():
    """Republish every message by rclpy alone."""
    node = rclpy.create_node('plain_relay')
    publisher = node.create_publisher(Imu, 'imu/data_corrected', output_qos())
    node.create_subscription(Imu, 'imu/data_raw', publisher.publish, input_qos(reliable=True))
    rclpy.spin(node)


def main():
    """Run the process given on the command line."""
    part, *arguments = sys.argv[1:]
    split = arguments.index('--ros-args') if '--ros-args' in arguments else len(arguments)
    rclpy.init(args=arguments[split:])
    try:
        if part == 'relay':
            plain_relay()
        else:
            measures: dict[str, Callable[..., None]] = {'source': source, 'sink': sink}
            for line in sys.stdin:  # JSON arguments of a measurement
                measures[part](*json.loads(line))
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()

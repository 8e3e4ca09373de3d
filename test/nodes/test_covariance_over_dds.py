"""
The covariance that compensator_node states at the start and after gaps, seen by a listener.

Exact truth; the readings carry their own stamps, so that the speed of the machine has no effect.
"""

import time

import numpy as np
import pytest
from sensor_msgs.msg import Imu

from imu_calibration.document.calibration_text import calibration_to_text
from msg_adapters.write import encode_imu

from ros.live_station import Station
from worlds.exact_motion import exact_motion

pytestmark = [pytest.mark.live, pytest.mark.slow]
GAPS_S = (0.1, 0.3, 1.0)
RUN, FIRST, AFTER_GAP = 80, 50, 12
"""Messages of a run, and those of the first and of each further run that are compared."""


def published(world, folder):
    """Return the messages that a compensator_node of its own makes of the readings."""
    (folder / 'calibration.yaml').write_text(calibration_to_text(world.calibration))
    parameters = {'calibration_file': folder / 'calibration.yaml'}
    if world.transfer.arm_t.any():
        parameters |= {'target_frame': 'base', 'target_xyz': world.transfer.arm_t.tolist()}
    heard = []
    with Station(folder / 'out.txt') as station:
        station.start('compensator_node', parameters)
        publisher = station.publisher(Imu, 'imu/data_raw')
        listener = station.node.create_subscription(
            Imu, 'imu/data_corrected', heard.append, 1000, raw=True
        )
        station.until(
            lambda: (
                publisher.get_subscription_count()
                and station.node.count_publishers(listener.topic_name)
            ),
            'the compensator',
        )
        station.spin_for(1.0)  # both directions are connected
        began = time.monotonic()
        since = 1e-9 * (world.readings.stamp_ns - world.readings.stamp_ns[0])
        for message, due in zip(encode_imu(world.readings), since, strict=True):
            station.executor.spin_once(timeout_sec=max(began + due - time.monotonic(), 0.0))
            time.sleep(max(began + due - time.monotonic(), 0.0))
            publisher.publish(message.tobytes())
        station.until(lambda: len(heard) >= len(since), 'all messages')
    return heard


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize('arm', (0.0, 0.6))
def test_the_stated_covariance_contains_the_unknown_slope(arm, tmp_path):
    """Without it: 5.8 stated sds at the start and 11 after gaps, on the arm."""
    world = exact_motion(arm, GAPS_S, RUN, 9014)
    runs = world.normalised_errors(published(world, tmp_path)).reshape(-1, RUN, 3)
    first, after = runs[0, :FIRST], runs[1:, :AFTER_GAP]
    print(f'{arm} m: start {rms(first):.2f}, after gaps {rms(after):.2f}')
    assert 0.5 < rms(first) < 2.0
    assert 0.5 < rms(after) < 2.0

"""bag_player_node: replays a rosbag2 recording onto real topics, as serialized bytes."""

import importlib
import sys
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher

from imu_calibration.core.errors import InputError
from imu_calibration.core.settings import flag_setting, path_setting, setting, text_setting
from imu_calibration.document import files
from imu_calibration.nodes.inputs import latched_qos, output_qos
from imu_calibration.nodes.lifecycle import announce, declare_parameters, run_node
from imu_calibration.nodes.playback import CLOCK_RATE, PLAYBACK_DEPTH, Batch, Pace, Playback
from msg_adapters.rosbag2 import Rosbag2

PAUSE = 0.01
"""
Seconds between the last message of a round and the first of the next, when the bag is played again
and again.
"""


@dataclass(frozen=True)
class PlayerSettings:
    """Bag, topics and speed of playback."""

    bag: str = path_setting(
        'rosbag2 folder, .db3 or .mcap file; it must be given',
        'the node refuses to start with a reason',
    )
    topics: str = text_setting(
        'topics to play, separated by spaces; empty: all whose type is installed',
        'topics are missing',
        session=True,
    )
    rate: float = setting(
        1.0,
        '1',
        'seconds of the recording per second; 0: as fast as possible',
        (0.0, 10000.0),
        'too large: messages are lost',
    )
    clock: bool = flag_setting(
        "publish /clock with the recorder's times, for nodes with use_sim_time",
        'nodes with use_sim_time do not advance',
    )
    loop: bool = flag_setting(
        'start again at the end; the stamps then jump back',
        'the node ends after one round',
    )
    wait_for_subscribers: int = setting(
        0,
        '1',
        'subscribers of each topic to wait for before the start',
        (0, 100),
        'the first messages are missed',
    )
    stop_at_end: bool = flag_setting(
        'end the node after the last message',
        'the node does not end',
        default=True,
    )


class BagPlayerNode(Node):
    """Publishes the messages of a recording."""

    def __init__(self) -> None:
        super().__init__('bag_player_node')
        self.settings = declare_parameters(self, PlayerSettings)
        self._bag = self._open_bag()
        self._topics = self._choose_topics()
        announce(
            self,
            [],
            [*self._topics, '/clock'] if self.settings.clock else self._topics,
            note=f'from the bag {files.user_path(self.settings.bag)}',
        )
        self._players = [self._publisher(name) for name in self._topics]
        first_ns = self._first_ns()
        pace = Pace(
            self.settings.rate,
            CLOCK_RATE if self.settings.clock else 0.0,
            self.settings.wait_for_subscribers,
        )
        self._playback = Playback(
            self,
            self._players,
            self._batches(first_ns),
            pace=pace,
            clock_start_ns=first_ns,
            awaited=self._players,
            ended='played {} messages',
            ends_node=self.settings.stop_at_end,
        )
        self._playback.start()
        self.get_logger().info(
            f'plays {files.user_path(self.settings.bag)} at {self.settings.rate:g} times its speed:'
            f' {", ".join(self._topics)}'
        )

    def close(self) -> str:
        """Stop publishing and close the files; return the outcome."""
        outcome = self._playback.end()
        self._bag.close()
        return outcome

    @property
    def failed(self) -> bool:
        """Whether an error ended the playback."""
        return self._playback.failed

    def _open_bag(self) -> Rosbag2:
        """Return the recording; raises an InputError where it cannot be read."""
        path = self.settings.bag
        if not path:
            raise InputError(
                "parameter 'bag' must name a rosbag2 recording, none was given; start with"
                ' --ros-args -p bag:=/path/to/bag'
            )
        try:
            return Rosbag2(files.user_path(path))
        except Exception as error:  # rosbag2 files raise many kinds
            raise InputError(
                f'{path} must be a readable rosbag2 recording, got: {" ".join(str(error).split())};'
                ' check the path'
            ) from error

    def _first_ns(self) -> int:
        """Return the time of reception of the first message to be played, ns; 0 without one."""
        for raw in self._bag.stretches(self._topics):
            return int(raw.received_ns()[0])
        return 0

    def _choose_topics(self) -> list[str]:
        """Return the requested topics, or all with an installed type; at least one."""
        requested = self.settings.topics.split()
        unknown = [name for name in requested if name not in self._bag.types]
        if unknown:
            raise InputError(
                f'{self.settings.bag} must contain the requested topics, it has no'
                f' {", ".join(unknown)}; it contains {", ".join(sorted(self._bag.types))}'
            )
        chosen = []
        for name in requested or sorted(self._bag.types):
            if _message_class(self._bag.types[name]) is not None:
                chosen.append(name)
            elif requested:
                raise InputError(
                    f'the type {self._bag.types[name]} of {name} must be installed to be played, it'
                    ' is not; omit the topic'
                )
            else:
                self.get_logger().warning(
                    f'{name} is left out: its type {self._bag.types[name]} is not installed'
                )
        if not chosen:
            raise InputError(
                f'{self.settings.bag} must contain a topic whose type is installed, it has none;'
                ' check the bag'
            )
        return chosen

    def _publisher(self, name: str) -> Publisher:
        """Return a publisher for a topic of the bag, latched as in the recording."""
        latched = any(
            profile.get('durability') == 'transient_local' for profile in self._bag.qos(name)
        )
        # Relative, so that namespaces and remappings move it.
        qos = latched_qos() if latched else output_qos(PLAYBACK_DEPTH)
        return self.create_publisher(_message_class(self._bag.types[name]), name.lstrip('/'), qos)

    def _batches(self, first_ns: int) -> Generator[Batch, None, None]:
        """Yield Batch after Batch, round after round; `first_ns` is due at the start."""
        offset = 0.0  # start of the round, s
        while True:
            until = offset
            for raw in self._bag.stretches(self._topics):
                # Messages that were recorded out of order are due with the latest one before.
                recorded = (raw.received_ns() - first_ns) * 1e-9 + offset
                due = np.maximum.accumulate(np.maximum(recorded, until))
                until = float(due[-1])
                yield Batch(due, [self._players[k] for k in raw.topic], raw.packed.views(), until)
            offset = until + PAUSE
            if not self.settings.loop:
                return


def _message_class(message_type: str) -> Any:
    """Return the class of a type such as sensor_msgs/msg/Imu, or None when it is not installed."""
    if message_type.count('/') != 2:
        return None
    package, _, name = message_type.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError, ValueError):
        return None


def main(arguments: list[str] | None = None) -> int:
    """Run the node; return the exit code."""
    return run_node(BagPlayerNode, arguments)


if __name__ == '__main__':
    sys.exit(main())

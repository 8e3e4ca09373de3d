"""The live view of a node for Foxglove: open while parameter 'foxglove' is true; without it the node runs unchanged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from imu_calibration.errors import InputError
from imu_calibration.nodes.complaints import Complaints
from imu_calibration.settings import setting

if TYPE_CHECKING:
    from imu_calibration.use_cases.foxglove_server import FoxgloveServer


@dataclass(frozen=True)
class FoxgloveSettings:
    """Whether, and where, a node shows itself to Foxglove."""

    foxglove: bool = setting(False, '', 'show it live to Foxglove over a websocket; needs foxglove-sdk', live=True, session=True,
                             symptom='the application finds no server; the node prints the address, or the missing package, at its start')
    foxglove_host: str = setting('127.0.0.1', '', 'address to listen on; 0.0.0.0: on every network, without access control',
                                 symptom='only programs on the same host find it', fixed='the server is bound to the address at its start')
    foxglove_port: int = setting(8766, '', 'port to listen on, different from the 8765 of foxglove_bridge; 0: any free port', (0, 65535),
                                 'a program uses the port: the node warns and has no view',
                                 fixed='the server is bound to the port at its start')


class LiveView:
    """
    The view of a node, stored while it is off, so that it can be turned on at any moment.

    Parameters
    ----------
    node : rclpy.node.Node
    topics : tuple of str
        Of `view_messages`.
    settings : FoxgloveSettings

    """

    def __init__(self, node: Any, topics: tuple[str, ...], settings: FoxgloveSettings):
        self._node, self._topics, self._complaints = node, topics, Complaints(node.get_logger())
        self._server: FoxgloveServer | None = None
        self._latest: dict[str, Callable[[], Any]] = {}
        try:
            self.change(settings)
        except InputError as error:
            node.get_logger().warning(f'no view, the node continues without it: {error}')

    @property
    def is_on(self) -> bool:
        """Whether there is a server."""
        return self._server is not None

    def change(self, settings: FoxgloveSettings) -> None:
        """Begin or end showing; raises an InputError where it cannot begin."""
        if self.is_on and not settings.foxglove:
            self.close()
        elif settings.foxglove and not self.is_on:
            from imu_calibration.use_cases.foxglove_server import FoxgloveServer  # a second of imports, only on request
            self._server = FoxgloveServer(self._node.get_fully_qualified_name(), host=settings.foxglove_host, port=settings.foxglove_port,
                                          topics=self._topics, clock=lambda: self._node.get_clock().now().nanoseconds,
                                          complain=self._complaints.event)
            for topic, make in self._latest.items():
                self._server.show(topic, make)
            self._node.get_logger().info(f'Foxglove finds it at {self._server.address}')

    def show(self, topic: str, make: Callable[[], Any]) -> None:
        """Show the result of `make` from now on."""
        self._latest[topic] = make
        if self._server is not None:
            self._server.show(topic, make)

    def add(self, topic: str, make: Callable[[], Any]) -> None:
        """Send the pairs (time in ns, content) that `make` yields, if a client is connected."""
        if self._server is not None:
            self._server.add(topic, make)

    def close(self) -> None:
        """End the server."""
        server, self._server = self._server, None
        if server is not None:
            server.close()

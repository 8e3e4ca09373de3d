"""View of a running node in Foxglove over a websocket: made in a separate thread, and only while a client is connected."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from imu_calibration.errors import InputError, shortened
from imu_calibration.use_cases.foxglove_file import channel_of, foxglove

PERIOD = 0.1
"""Seconds between two checks for new content and for clients."""
AGAIN = 1.0
"""Seconds after which valid content is sent again, for later clients: a websocket stores no messages."""
MOST_STRETCHES = 40
"""Largest number of queued stretches of a stream, the oldest are dropped first; ten seconds of quarters."""

Make = Callable[[], Any]
Rows = Callable[[], Iterable[tuple[int, Any]]]


class FoxgloveServer(threading.Thread):
    """
    A websocket server that sends the last content of each topic to every subscriber.

    Content is given as functions that make it: callers do not wait for them, and none runs without a client. The callbacks of
    foxglove-sdk are not used: they are called under a lock that its channels acquire as well.

    Parameters
    ----------
    name : str
        Name in Foxglove.
    host : str
        Address to listen on.
    port : int
        0: any that is free.
    topics : sequence of str
        Of `view_messages`.
    clock : callable
        Time of content without a time, ns.
    complain : callable
        Called with a line when something cannot be shown.

    Raises
    ------
    InputError
        When foxglove-sdk is not installed, or the address cannot be used.

    """

    def __init__(self, name: str, *, host: str, port: int, topics: Sequence[str], clock: Callable[[], int],
                 complain: Callable[[str], None]):
        super().__init__(name='foxglove', daemon=True)
        sdk = foxglove()
        self._context = context = sdk.Context()   # without it, the channels are nobody's
        try:
            self._server = sdk.start_server(name=name, host=host, port=port, context=context)
        except RuntimeError as error:
            raise InputError(f"a view needs an address that is free, {host}:{port} is not ({error}); choose another 'foxglove_port', "
                             'or 0 for any', code='address_taken') from error
        self.address = f'ws://{host}:{self._server.port}'
        self._channels = {topic: channel_of(sdk, topic, context) for topic in topics}
        self._news: dict[str, Make] = {}
        self._shown: dict[str, tuple[Any, float]] = {}
        self._streams: dict[str, deque[Rows]] = {topic: deque(maxlen=MOST_STRETCHES) for topic in topics}
        self._clock, self._complain, self._ending = clock, complain, threading.Event()
        self.start()

    def show(self, topic: str, make: Make) -> None:
        """Show the result of `make` in place of the topic's earlier content."""
        self._news[topic] = make

    def add(self, topic: str, make: Rows) -> None:
        """Send the messages that `make` yields, each (time in ns, content), after the topic's earlier ones."""
        self._streams[topic].append(make)

    def run(self) -> None:
        """Send new content, until `close`."""
        while not self._ending.wait(PERIOD):
            for topic, channel in self._channels.items():
                try:
                    self._send(topic, channel)
                except Exception as error:   # a failed view must not end its node
                    self._complain(f'{topic} cannot be shown: {shortened(f"{type(error).__name__}: {error}", 200)}')

    def _send(self, topic, channel):
        if not channel.has_sinks():
            return
        stream = self._streams[topic]
        while stream:
            for time_ns, content in stream.popleft()():
                channel.log(content, log_time=time_ns)
        make, now = self._news.pop(topic, None), time.monotonic()
        content, last = self._shown.get(topic, (None, now))
        if make is not None:
            content = make()
        elif now - last < AGAIN:
            return
        self._shown[topic] = content, now
        channel.log(content, log_time=self._clock())

    def close(self) -> None:
        """End the thread and the server."""
        self._ending.set()
        self.join(2.0)
        self._server.stop()

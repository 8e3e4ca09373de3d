"""The other end of the websocket: what the Foxglove application does to see a node, without the application."""

import asyncio
import json
import struct
import threading

from tornado.websocket import websocket_connect

PROTOCOL = 'foxglove.sdk.v1'
HEAD = struct.Struct('<BIQ')
"""Of a message: kind, subscription, time in ns; https://github.com/foxglove/ws-protocol."""
MESSAGE_DATA = 1


class FoxgloveClient(threading.Thread):
    """
    Subscribes to every topic of a server.

    Parameters
    ----------
    address : str
        ws://HOST:PORT

    """

    def __init__(self, address):
        super().__init__(name='client', daemon=True)
        self._address, self._ending = address, False
        self.name_of_server, self.schemas = '', {}
        self.received = {}
        """Topic -> [(time in ns, content)]; JSON as it says, others as bytes."""
        self.start()

    def run(self):
        """Gather until the connection or the test ends."""
        asyncio.run(self._gather())

    async def _gather(self):
        connection, topics = await websocket_connect(self._address, subprotocols=[PROTOCOL]), {}
        while (message := await connection.read_message()) is not None and not self._ending:
            if isinstance(message, str):
                told = json.loads(message)
                self.name_of_server = told.get('name', self.name_of_server)
                for channel in told.get('channels', ()):
                    topics[channel['id']] = channel
                    self.schemas[channel['topic']] = channel['schemaName']
                    self.received[channel['topic']] = []
                    wanted = {'op': 'subscribe', 'subscriptions': [{'id': channel['id'], 'channelId': channel['id']}]}
                    await connection.write_message(json.dumps(wanted))
            elif message[0] == MESSAGE_DATA:
                _, number, time_ns = HEAD.unpack_from(message)
                channel, data = topics[number], message[HEAD.size:]
                self.received[channel['topic']].append((time_ns, json.loads(data) if channel['encoding'] == 'json' else data))
        connection.close()

    def close(self):
        """Leave with the next message."""
        self._ending = True

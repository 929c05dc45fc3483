# SPDX-License-Identifier: Apache-2.0
"""
A server of rosbridge's protocol 2.0, as much of it as watching topics takes.

JSON texts over a WebSocket: ``subscribe`` with a topic, and a ``publish`` for each message, in
which ``uint8[]`` is base64, as the protocol's public description has it
(https://github.com/RobotWebTools/rosbridge_suite/blob/ros2/ROSBRIDGE_PROTOCOL.md, "4.3 rosbridge
operations"). Ours to compare with: what it takes is the encoding's share, not that package's.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import json
import threading
from typing import Any

import rclpy
from rclpy.qos import qos_profile_sensor_data

_BYTES = ('sequence<uint8>', 'sequence<octet>')


def fields(message: Any) -> Any:
    """Return a message as JSON has it."""
    if not hasattr(message, 'get_fields_and_field_types'):
        return message
    return {
        name: base64.b64encode(bytes(getattr(message, name))).decode() if kind in _BYTES
        else fields(getattr(message, name))
        for name, kind in message.get_fields_and_field_types().items()}


class Server:
    """Serves one topic to its subscribers."""

    def __init__(self, topic: str, kind: Any) -> None:
        self._topic = topic
        self._loop = asyncio.new_event_loop()
        self._queues: set[asyncio.Queue[str]] = set()
        self.node = rclpy.create_node('rosbridge')
        self.node.create_subscription(kind, topic, self._heard, qos_profile_sensor_data)

    def _heard(self, message: Any) -> None:
        text = json.dumps({'op': 'publish', 'topic': self._topic, 'msg': fields(message)})
        self._loop.call_soon_threadsafe(self._hand_on, text)

    def _hand_on(self, text: str) -> None:
        for waiting in self._queues:
            if not waiting.full():
                waiting.put_nowait(text)

    async def _serve(self, link: Any) -> None:
        waiting: asyncio.Queue[str] = asyncio.Queue(64)
        while json.loads(await link.recv()) != {'op': 'subscribe', 'topic': self._topic}:
            pass
        self._queues.add(waiting)
        try:
            while True:
                await link.send(await waiting.get())
        finally:
            self._queues.discard(waiting)

    async def _run(self, port: int) -> None:
        from websockets.asyncio.server import serve
        async with serve(self._serve, '127.0.0.1', port, compression=None, max_size=None):
            await asyncio.Event().wait()

    def run(self, port: int) -> None:
        """Serve until the process is ended."""
        threading.Thread(target=rclpy.spin, args=(self.node,), daemon=True).start()
        self._loop.run_until_complete(self._run(port))


def main() -> None:
    """Run it: a topic, its package and message, a port."""
    import importlib
    parser = argparse.ArgumentParser()
    for word in ('topic', 'package', 'message'):
        parser.add_argument(word)
    parser.add_argument('port', type=int)
    options = parser.parse_args()
    rclpy.init()
    kind = getattr(importlib.import_module(f'{options.package}.msg'), options.message)
    Server(options.topic, kind).run(options.port)


if __name__ == '__main__':
    main()

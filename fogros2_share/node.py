# SPDX-License-Identifier: Apache-2.0
"""
The relay of one machine: publishes here what other robots publish, and sends them what is here.

Messages pass as bytes. Types and QoS come from the ROS graphs, so a launch file names only topics.
The main thread has rclpy's executor; everything else happens in asyncio's thread.
"""

from __future__ import annotations

import asyncio
from collections import deque
import contextlib
import json
import os
from pathlib import Path
import sys
import threading
import time
from typing import Any, Optional

from ament_index_python.packages import get_package_prefix
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.utilities import get_message

from fogros2_share.wire import decode, DEEPEST, Echoes, encode, Form, LARGEST, LINE

#: The socket in the folder of a machine.
NAME = 'relay'
#: Seconds between two looks at the graph and at the other machines, and between two changes of
#: the type or QoS of another machine's topic. Messages that a publisher or subscription queues.
LOOK, CHANGE, DEPTH = 0.25, 1.0, 10
#: Maximum number of other machines, and of bytes that wait for one of them.
MOST, WAITING = 64, 1 << 27
#: By topic, what publishes for another machine: its form, since when, and the publisher.
Publishers = dict[str, tuple[Form, float, Any]]


class Shared:
    """A topic, as the publishers of this launch have it."""

    def __init__(self) -> None:
        #: The type that nodes of this launch use; '' if none uses the topic.
        self.kind = ''
        self.form: Optional[Form] = None
        self.subscription: Any = None
        #: What later machines get.
        self.kept: deque[bytes] = deque(maxlen=0)
        self.echoes = Echoes()
        #: Contents that the publishers for other machines still give to later subscribers.
        self.theirs: dict[Path, deque[int]] = {}


class Relay(Node):
    """
    The node.

    :param settings: ``topics``; ``folders``, the machine's own, and the folder of all.
    """

    def __init__(self, settings: dict[str, Any]) -> None:
        super().__init__(f'share_{os.urandom(4).hex()}', start_parameter_services=False)
        self._shared = {name: Shared() for name in settings['topics']}
        self._own, self._others = map(Path, settings['folders'])
        self._robots: dict[Path, asyncio.Task[None]] = {}
        self._readers: set[asyncio.StreamWriter] = set()
        self._complained: set[str] = set()

    async def run(self) -> None:
        """Relay until rclpy ends."""
        self._loop = asyncio.get_running_loop()
        async with await asyncio.start_unix_server(self._serve, self._own / NAME):
            # the users of machines have any number
            (self._own / NAME).chmod(0o666)
            while rclpy.ok(context=self.context):
                for name, shared in self._shared.items():
                    self._look(name, shared)
                for folder in sorted(self._others.iterdir())[:MOST]:
                    if folder not in self._robots and not os.path.samefile(folder, self._own):
                        self._robots[folder] = asyncio.create_task(self._follow(folder))
                await asyncio.sleep(LOOK)

    def _complain(self, text: str) -> None:
        """Log a warning once."""
        if text not in self._complained and len(self._complained) < DEEPEST:
            self._complained.add(text)
            self.get_logger().warning(text)

    def _imported(self, kind: str) -> Any:
        """Return the class of a type, None for none; complain if no ROS package here has it."""
        try:
            get_package_prefix(kind.partition('/')[0])
            return get_message(kind)
        except (ImportError, AttributeError, ValueError, LookupError) as error:
            self._complain(f"the type '{kind}' of a topic can't be imported: {error}")

    # -- from this launch to other robots -------------------------------------------------------

    def _look(self, name: str, shared: Shared) -> None:
        """Subscribe with the type and QoS of the publishers, and again when these change."""
        publishers, subscriptions = ([one for one in found if one.node_name != self.get_name()]
                                     for found in (self.get_publishers_info_by_topic(name),
                                                   self.get_subscriptions_info_by_topic(name)))
        shared.kind = next((one.topic_type for one in (*publishers, *subscriptions)), '')
        profiles = [one.qos_profile for one in publishers]
        kept = sum(one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in profiles)
        form = Form(
            shared.kind, all(one.reliability == ReliabilityPolicy.RELIABLE for one in profiles),
            min(kept, DEEPEST) if kept == len(profiles) else 0) if profiles else None
        if form == shared.form or form and self._imported(form.kind) is None:
            return
        if shared.subscription is not None:
            self.destroy_subscription(shared.subscription)
        shared.form, shared.kept = form, deque(shared.kept, form.kept if form else 0)
        shared.subscription = form and self.create_subscription(
            self._imported(form.kind), name, lambda data: self._loop.call_soon_threadsafe(
                self._heard, name, shared, form, data), profile(form, DEPTH), raw=True)

    def _heard(self, name: str, shared: Shared, form: Form, data: bytes) -> None:
        if shared.echoes.heard(time.monotonic(), data) or any(
                hash(data) in kept for kept in shared.theirs.values() if kept):
            return
        if len(data) > LARGEST:
            return self._complain(f'{name}: {len(data)} bytes are too large to be shared')
        frame = encode(name, form, data)
        shared.kept.append(frame)
        for reader in self._readers:
            if reader.transport.get_write_buffer_size() < WAITING:
                reader.write(frame)

    async def _serve(self, stream: asyncio.StreamReader, reader: asyncio.StreamWriter) -> None:
        """Send to another relay until it leaves; it has nothing to say."""
        with contextlib.closing(reader), contextlib.suppress(OSError):
            if len(self._readers) < MOST:
                for shared in self._shared.values():
                    reader.writelines(shared.kept)
                self._readers.add(reader)
                await stream.read(1)
        self._readers.discard(reader)

    # -- from another robot to this launch ------------------------------------------------------

    async def _follow(self, folder: Path) -> None:
        """Publish what another relay sends until it ends, as its publishers do then."""
        publishers: Publishers = {}
        try:
            stream, writer = await asyncio.open_unix_connection(folder / NAME, limit=LINE)
            with contextlib.closing(writer):
                while line := await stream.readline():
                    name, form, size = decode(line)
                    self._take(folder, publishers, name, form, await stream.readexactly(size))
        except (OSError, EOFError):
            pass  # its machine is starting or ending
        except (ValueError, RuntimeError) as error:
            self._complain(f'the machine {folder.name} shares no messages: {error}')
            await asyncio.sleep(CHANGE)
        finally:
            for name, (_, _, publisher) in publishers.items():
                self._shared[name].theirs.pop(folder, None)
                self.destroy_publisher(publisher)
            del self._robots[folder]

    def _take(
        self, folder: Path, publishers: Publishers, name: str, form: Form, data: bytes,
    ) -> None:
        """Publish a message, if its topic is shared here, and with this type."""
        shared, now = self._shared.get(name), time.monotonic()
        if shared is None:
            return
        if shared.kind not in ('', form.kind):
            return self._complain(
                f'{name} is {form.kind} on another robot, so it is not shared here')
        known, since, publisher = publishers.get(name, (None, -CHANGE, None))
        if publisher is None or known != form:
            message = self._imported(form.kind) if now - since >= CHANGE else None
            if message is None:
                return
            if publisher is not None:
                self.destroy_publisher(publisher)
            publisher = self.create_publisher(message, name, profile(form))
            publishers[name] = form, now, publisher
            shared.theirs[folder] = deque(maxlen=form.kept)
        shared.theirs[folder].append(hash(data))
        if shared.subscription is not None:
            shared.echoes.add(now, data)
        publisher.publish(data)


def profile(form: Form, least: int = 1) -> QoSProfile:
    """Return the QoS of a topic's messages, with a queue of ``least`` messages or more."""
    return QoSProfile(
        depth=max(form.kept, least) if form.kept else DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if form.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if form.kept else DurabilityPolicy.VOLATILE)


def main() -> None:
    """Run until a signal; the first argument is the settings as JSON."""
    rclpy.init()
    settings = json.loads(sys.argv[1])
    if not os.path.isdir(settings['folders'][0]):
        sys.exit('no topic is shared: this machine was made without share=')
    node = Relay(settings)

    def relay() -> None:
        try:
            asyncio.run(node.run())
        except RuntimeError:
            if rclpy.ok():  # else rclpy has ended during a call
                raise
        finally:
            rclpy.try_shutdown()

    thread = threading.Thread(target=relay)
    thread.start()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    rclpy.try_shutdown()
    thread.join()

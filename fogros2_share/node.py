# SPDX-License-Identifier: Apache-2.0
"""
The relay of one machine: publishes here what other robots publish, and sends them what is here.

Messages pass as bytes. Types and QoS come from the ROS graphs, so a launch file names only topics.
The folder of each machine belongs to the host's root. It has the list of the machine's topics, and
a folder in which only the machine's relay writes: its socket is there, and what proves to other
relays which machine reads from them.
The main thread has rclpy's executor, and sends to other machines from its callbacks. A thread for
each other machine publishes here, so a message changes threads once in each process.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
import contextlib
import fcntl
import itertools
import json
import os
from pathlib import Path
import selectors
import socket
import stat
import sys
import threading
import time
from typing import Any, cast, Optional

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from fogros2 import ros_types
from fogros2_share.wire import decode, DEEPEST, Echoes, encode, Form, LARGEST, LINE
from image_transport_h264 import ending
from image_transport_h264.lazy import every

#: In the folder of a machine: its topics in lines, and the folder of its relay, with its socket
#: and with a file for each other machine.
TOPICS, OWN, NAME, PROOF = 'topics', 'own', 'relay', 'to-{}'
#: Seconds between two looks at the graph and at the other machines, and between two changes of
#: the type or QoS of another machine's topic. Messages that a publisher or subscription queues.
LOOK, CHANGE, DEPTH = 0.25, 1.0, 10
#: Maximum number of other machines, and of connections that have not said which machine they are
#: of; maximum bytes that wait for a machine, and what a part takes in memory beside its bytes.
MOST, WAITING, PART = 64, 1 << 27, 400
#: Bytes that are read at once.
BUFFER = 1 << 16
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
        self.kept: deque[tuple[bytes, bytes]] = deque(maxlen=0)
        self.echoes = Echoes()
        #: Hashes of the messages that publishers for other machines give to later subscribers.
        self.theirs: dict[Path, deque[int]] = {}


class Reader:
    """
    Another relay that reads from here. Its messages wait in memory while it is slow.

    :param topics: those that it gets.
    :param waiting: what to send first.
    """

    def __init__(
        self, link: socket.socket, topics: frozenset[str], waiting: Iterable[bytes],
    ) -> None:
        self._link = link
        self.topics = topics
        self._waiting = deque[memoryview](memoryview(part) for part in waiting)
        self._size = sum(map(_memory, self._waiting))
        self._news, self._left = threading.Condition(), False
        threading.Thread(target=self._send, name='fog-share-send', daemon=True).start()

    def put(self, *parts: bytes) -> None:
        """Send a message without waiting; drop it if too much waits already."""
        with self._news:
            sent, rest = 0, deque[memoryview](memoryview(part) for part in parts)
            if not self._waiting:
                with contextlib.suppress(OSError):  # the other thread notices the end
                    sent = self._link.sendmsg(parts, [], socket.MSG_DONTWAIT)
            elif self._size >= WAITING:
                return
            while rest and sent >= len(rest[0]):
                sent -= len(rest.popleft())
            if rest:
                rest[0] = rest[0][sent:]
                self._waiting += rest
                self._size += sum(map(_memory, rest))
                self._news.notify()

    def _send(self) -> None:
        """Send what waits, in a thread."""
        with self._link, contextlib.suppress(OSError):
            while True:
                with self._news:
                    self._news.wait_for(lambda: self._waiting or self._left)
                    if self._left:
                        return
                    part = self._waiting[0]
                self._link.sendall(part)
                with self._news:
                    # a message that comes meanwhile has to queue behind this one
                    self._size -= _memory(self._waiting.popleft())

    def has_left(self) -> bool:
        """Return whether the other relay has closed its end; it has nothing to say."""
        try:
            return self._link.recv(1, socket.MSG_DONTWAIT) is not None
        except BlockingIOError:
            return False
        except OSError:
            return True

    def close(self) -> None:
        """Close the connection."""
        with self._news, contextlib.suppress(OSError):
            self._left = True
            self._news.notify()
            self._link.shutdown(socket.SHUT_RDWR)


def machine_of(own: Path, folders: Path) -> str:
    """
    Return the name of the folder that a machine has in the folder of all.

    :raises FileNotFoundError: it has none.
    """
    for folder in folders.iterdir():
        with contextlib.suppress(OSError):  # another machine begins or ends
            if os.path.samefile(folder / OWN, own):
                return folder.name
    raise FileNotFoundError(f'{folders} has no folder of this machine')


class Relay(Node):
    """
    The node.

    :param settings: ``topics``; ``folders``, the machine's own, and the folder of all.
    """

    def __init__(self, settings: dict[str, Any]) -> None:
        super().__init__(f'share_{os.urandom(4).hex()}', start_parameter_services=False)
        self._shared = {name: Shared() for name in settings['topics']}
        self._own, self._others = map(Path, settings['folders'])
        #: The name of this machine's folder.
        self._machine = machine_of(self._own, self._others)
        #: Guards everything below, and the topics.
        self._lock = threading.Lock()
        self._robots: dict[Path, threading.Thread] = {}
        self._links: set[socket.socket] = set()
        #: By machine.
        self._readers: dict[str, Reader] = {}
        self._complained: set[str] = set()
        (self._own / NAME).unlink(missing_ok=True)
        self._server = socket.socket(socket.AF_UNIX)
        self._server.bind(str(self._own / NAME))
        # the users of machines have any number
        (self._own / NAME).chmod(0o666)
        self._server.listen()
        listed = topics_of(self._others / self._machine)
        if missing := sorted(self._shared.keys() - listed):
            self._complain(f"{', '.join(missing)} of other robots are not heard: the machine was "
                           f"made for {', '.join(sorted(listed))}; delete it, and launch again")
        threading.Thread(target=self._serve, name='fog-share-serve', daemon=True).start()
        every(self, LOOK, self._tick)

    def _tick(self) -> None:
        """Look for changes of the topics and of the other machines."""
        with self._lock:
            for name in [name for name, one in self._readers.items() if one.has_left()]:
                self._readers.pop(name).close()
        for name, shared in self._shared.items():
            self._look(name, shared)
        with contextlib.suppress(OSError):  # a machine ends
            for folder in sorted(self._others.iterdir())[:MOST]:
                if folder not in self._robots and folder.name != self._machine:
                    self._robots[folder] = threading.Thread(
                        target=self._follow, args=(folder,), name='fog-share', daemon=True)
                    self._robots[folder].start()

    def destroy_node(self) -> None:
        """End the threads, then destroy the node."""
        self.close()
        super().destroy_node()

    def close(self) -> None:
        """End the threads."""
        with self._lock:
            for link in (self._server, *self._links):
                with contextlib.suppress(OSError):  # it may not be connected
                    link.shutdown(socket.SHUT_RDWR)
            for reader in self._readers.values():
                reader.close()
            # a signal may have come before the start of one
            threads = [thread for thread in self._robots.values() if thread.is_alive()]
        for thread in threads:
            thread.join(2 * CHANGE)

    def _complain(self, text: str) -> None:
        """Log a warning once."""
        if text not in self._complained and len(self._complained) < DEEPEST:
            self._complained.add(text)
            self.get_logger().warning(text)

    def _imported(self, kind: str) -> Any:
        """Return the class of a type, None for none; complain if no ROS package here has it."""
        try:
            return ros_types.message(kind)
        except LookupError as error:
            self._complain(f'a topic is not shared: {error}')

    # -- from this launch to other robots -------------------------------------------------------

    def _look(self, name: str, shared: Shared) -> None:
        """Subscribe with the type and QoS of the publishers, and again when these change."""
        publishers = others(self, self.get_publishers_info_by_topic(name))
        subscriptions = others(self, self.get_subscriptions_info_by_topic(name))
        shared.kind = next((one.topic_type for one in (*publishers, *subscriptions)), '')
        form = form_of(publishers)
        if form == shared.form or form and self._imported(form.kind) is None:
            return
        if shared.subscription is not None:
            self.destroy_subscription(shared.subscription)
        with self._lock:
            shared.form, shared.kept = form, deque(shared.kept, form.kept if form else 0)
            latched = itertools.chain(*shared.theirs.values()) if form and form.kept else ()
            shared.echoes.restart(time.monotonic(), latched)
            try:
                shared.subscription = form and self.create_subscription(
                    self._imported(form.kind), name,
                    lambda data: self._heard(name, shared, form, data), profile(form, DEPTH),
                    raw=True)
            except RuntimeError as error:  # with Fast DDS, a process has one type of a topic
                shared.subscription = None
                self._complain(f'{name} is {shared.kind} here and another type on another robot, '
                               f'so it is not shared: {error}')

    def _heard(self, name: str, shared: Shared, form: Form, data: bytes) -> None:
        with self._lock:
            if shared.echoes.heard(time.monotonic(), data):
                return
            if len(data) > LARGEST:
                return self._complain(f'{name}: {len(data)} bytes are too large to be shared')
            head = encode(name, form, len(data))
            for reader in self._readers.values():
                if name in reader.topics:
                    reader.put(head, data)
            shared.kept.append((head, data))

    def _serve(self) -> None:
        """Accept other relays; the oldest of too many connections that say nothing goes."""
        silent: list[socket.socket] = []
        with selectors.DefaultSelector() as chosen, contextlib.suppress(OSError):
            chosen.register(self._server, selectors.EVENT_READ)
            while True:
                for key, _ in chosen.select():
                    link = cast(socket.socket, key.fileobj)
                    if link is self._server:
                        silent.append(self._server.accept()[0])
                        chosen.register(silent[-1], selectors.EVENT_READ)
                        link = silent[0]
                    if len(silent) > MOST or link is key.fileobj and link in silent:
                        chosen.unregister(link)
                        silent.remove(link)
                        if link is not key.fileobj or not self._admit(link):
                            link.close()
        for link in silent:
            link.close()

    def _admit(self, link: socket.socket) -> bool:
        """Add a reader that proves of which machine it is, in place of an earlier one of it."""
        try:
            data, files, _, _ = socket.recv_fds(link, 256, 1)
        except OSError:
            return False
        with contextlib.ExitStack() as undo:
            for file in files:
                undo.callback(os.close, file)
            try:
                name = data.decode()
                folder = self._others / name
                if not files or folder.parent != self._others or not proven(
                        files[0], folder / OWN / PROOF.format(self._machine)):
                    return False
                topics = topics_of(folder)
            except (OSError, ValueError):
                return False
        with self._lock:
            if before := self._readers.pop(name, None):
                before.close()
            self._readers[name] = Reader(link, topics, [
                part for topic, shared in self._shared.items() if topic in topics
                for frame in shared.kept for part in frame])
        return True

    # -- from another robot to this launch ------------------------------------------------------

    def _follow(self, folder: Path) -> None:
        """Publish what another relay sends until it ends, as its publishers do then."""
        publishers: Publishers = {}
        link = socket.socket(socket.AF_UNIX)
        with self._lock:
            self._links.add(link)
        try:
            self._connect(link, folder)
            with link.makefile('rb', BUFFER) as stream:
                while line := stream.readline(LINE):
                    name, form, size = decode(line)
                    data = stream.read(size)
                    if len(data) < size:
                        break
                    old_form, since, _ = publishers.get(name, (form, 0.0, None))
                    if old_form != form:  # not dropped: a map is sent only once
                        time.sleep(max(0.0, since + CHANGE - time.monotonic()))
                    with self._lock:
                        self._take(folder, publishers, name, form, data)
        except OSError:
            pass  # its machine is starting or ending
        except (ValueError, RuntimeError) as error:
            if rclpy.ok():  # else rclpy has ended during a call
                self._complain(f'the machine {folder.name} shares no messages: {error}')
                time.sleep(CHANGE)
        finally:
            with self._lock:
                for name, (_, _, publisher) in publishers.items():
                    self._shared[name].theirs.pop(folder, None)
                    self.destroy_publisher(publisher)
                self._links.discard(link)
                link.close()
                del self._robots[folder]

    def _connect(self, link: socket.socket, folder: Path) -> None:
        """
        Connect to the relay of another machine, and prove to it of which machine this one is.

        A machine could make its socket a link to a socket of this machine.

        :raises OSError: there is no relay.
        """
        proof = self._own / PROOF.format(folder.name)
        with contextlib.ExitStack() as undo:
            place = os.open(folder / OWN / NAME, os.O_PATH | os.O_NOFOLLOW)
            undo.callback(os.close, place)
            if not stat.S_ISSOCK(os.fstat(place).st_mode):
                raise FileNotFoundError
            link.connect(f'/proc/self/fd/{place}')
            file = os.open(proof, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            undo.callback(os.close, file)
            socket.send_fds(link, [self._machine.encode()], [file])

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
        old_form, _, publisher = publishers.get(name, (None, now, None))
        if publisher is None or old_form != form:
            message = self._imported(form.kind)
            if message is None:
                return
            if publisher is not None:
                self.destroy_publisher(publisher)
            publisher = self.create_publisher(message, name, profile(form))
            publishers[name] = form, now, publisher
            shared.theirs[folder] = deque(maxlen=form.kept)
        # the relay hears the message only when the lock is free
        publisher.publish(data)
        shared.theirs[folder].append(hash(data))
        if shared.subscription is not None:
            shared.echoes.add(now, data)


def _memory(part: memoryview) -> int:
    return len(part) + PART


def proven(file: int, path: Path) -> bool:
    """
    Return whether an open file is the one of a path, and open for writing.

    Others can reach the file of a machine at most for reading, because their folders are mounted
    so.
    """
    return os.path.samestat(os.fstat(file), os.stat(path, follow_symlinks=False)) \
        and fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDWR


def topics_of(folder: Path) -> frozenset[str]:
    """Return the topics that a machine was made for, from its folder."""
    return frozenset((folder / TOPICS).read_text().split())


def others(node: Node, endpoints: Iterable[Any]) -> list[Any]:
    """Return the publishers or subscriptions that are not of a node itself."""
    return [one for one in endpoints if one.node_name != node.get_name()]


def form_of(publishers: Sequence[Any]) -> Optional[Form]:
    """Return the form of a topic's messages, None without publishers."""
    profiles = [one.qos_profile for one in publishers]
    kept = sum(one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in profiles)
    return Form(
        publishers[0].topic_type,
        all(one.reliability == ReliabilityPolicy.RELIABLE for one in profiles),
        min(kept, DEEPEST) if kept == len(profiles) else 0) if publishers else None


def profile(form: Form, least: int = 1) -> QoSProfile:
    """Return the QoS of a topic's messages, with a queue of ``least`` messages or more."""
    return QoSProfile(
        depth=max(form.kept, least) if form.kept else DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if form.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if form.kept else DurabilityPolicy.VOLATILE)


def main() -> None:
    """Run until a signal; the first argument is the settings as JSON."""
    settings = json.loads(sys.argv[1])
    if not os.path.isdir(settings['folders'][0]):
        sys.exit('no topic is shared: this machine was made without share=')
    ending.run(lambda: Relay(settings))

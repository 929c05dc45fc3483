# SPDX-License-Identifier: Apache-2.0
"""Relays of shared topics as processes, each in a ROS domain that stands for a robot's launch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import json
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from typing import Any, Optional

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from fogros2.waiting import wait_until
from fogros2_share.node import OWN, TOPICS
from rigs.domains import taken

ROOT = Path(__file__).parents[2]
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class Robot:
    """A robot: a domain with a node of the test, and the relay of its machine."""

    def __init__(self, fleet: Path, name: str, domain: str) -> None:
        self.folder, self.fleet, self.domain = fleet / name, fleet, domain
        (self.folder / OWN).mkdir(parents=True)
        self.lines: list[str] = []
        self.relay: Optional[subprocess.Popen[str]] = None
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(domain))
        self.node = Node('planner', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()

    @property
    def environment(self) -> dict[str, str]:
        """
        Return the environment of programs in its domain, with the middleware of its node.

        Fast DDS does not notice the end of a subscription of Cyclone DDS.
        """
        return {**os.environ, 'ROS_DOMAIN_ID': self.domain,
                'RMW_IMPLEMENTATION': rclpy.get_rmw_implementation_identifier(),
                'PYTHONPATH': os.pathsep.join(
                    filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')]))}

    def start(self, *topics: str) -> None:
        """Start its relay."""
        if self.folder.exists():
            (self.folder / TOPICS).write_text('\n'.join(topics))
        self.relay = relay = subprocess.Popen(
            [sys.executable, str(ROOT / 'fogros2_share/scripts/share'), json.dumps({
                'topics': topics, 'folders': [str(self.folder / OWN), str(self.fleet)]})],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            env=self.environment)
        threading.Thread(target=lambda: self.lines.extend(relay.stdout or ()), daemon=True).start()

    def stop(self) -> int:
        """Interrupt its relay."""
        assert self.relay is not None
        self.relay.send_signal(signal.SIGINT)
        return self.relay.wait(60)

    def heard(self, kind: Any, topic: str, qos: Any = 10) -> list[Any]:
        """Return the messages that its node hears, a list that grows."""
        found: list[Any] = []
        self.node.create_subscription(kind, topic, found.append, qos)
        return found

    def publisher(self, kind: Any, topic: str, qos: Any = 10) -> Any:
        return self.node.create_publisher(kind, topic, qos)

    def close(self) -> None:
        if self.relay is not None and self.relay.poll() is None:
            self.relay.kill()
            self.relay.wait()
        self.executor.shutdown()
        self.thread.join(60)
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Robot]]:
    """Return what makes a robot; their DDS stays on the loopback, in domains of their own."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    # a path of a socket is short
    fleet = Path(tempfile.mkdtemp(prefix='fogt'))
    with contextlib.ExitStack() as undo:
        undo.callback(shutil.rmtree, fleet)

        def make(name: str) -> Robot:
            made = Robot(fleet, name, undo.enter_context(taken()))
            undo.callback(made.close)
            return made

        yield make


def repeated(publisher: Any, make: Callable[[int], Any], heard: list[Any], count: int = 5) -> None:
    """Publish until so many messages were heard."""
    numbers = iter(range(10_000))

    def look() -> bool:
        publisher.publish(make(next(numbers)))
        return len(heard) >= count

    wait_until(look, timeout=60, longest=0.05, what='the shared messages')

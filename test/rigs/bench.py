# SPDX-License-Identifier: Apache-2.0
"""A node in the test's process, and nodes under test as processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from rigs.domains import taken

ROOT = Path(__file__).parents[2]
SUDO = [] if os.geteuid() == 0 else ['sudo', '-n']
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class Bench:
    """A node in this process, and the processes under test."""

    def __init__(self) -> None:
        self.environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(
            filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')]))}
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(os.environ['ROS_DOMAIN_ID']))
        self.node = Node('bench', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.processes: list[tuple[subprocess.Popen[str], list[str], threading.Thread]] = []

    def renew(self) -> None:
        """Replace the node, so that the next test has no publisher or subscription of this one."""
        self.executor.remove_node(self.node)
        self.node.destroy_node()
        self.node = Node('bench', context=self.context)
        self.executor.add_node(self.node)

    def start(
        self, role: str, *words: str, package: str = 'image_transport_h264',
    ) -> list[str]:
        """Start an encoder or decoder; return the lines that it writes, which grow."""
        return self.run(
            sys.executable, str(ROOT / f'{package}/scripts/{role}'), '--ros-args', *words)

    def run(self, *command: str) -> list[str]:
        """Start a node; return the lines that it writes, which grow."""
        process = subprocess.Popen(
            command, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            # of a shell's background the tests themselves have inherited an ignored one
            text=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
        lines: list[str] = []
        assert process.stdout is not None
        reader = threading.Thread(target=lambda: lines.extend(process.stdout or ()), daemon=True)
        reader.start()
        self.processes.append((process, lines, reader))
        return lines

    def pair(self, *words: str, codec: str = 'h264') -> tuple[list[str], list[str]]:
        """Start both, from /camera to /seen/camera."""
        common = ['-p', f'codec:={codec}', '-p', f'stream:=/camera/{codec}']
        return (self.start('encoder', '-r', 'image:=/camera', *common, *words),
                self.start('decoder', '-r', 'image:=/seen/camera', *common))

    def until(
        self, condition: Callable[[], object], what: str, *, timeout: float = 60.0,
        meanwhile: Callable[[], object] = lambda: None,
    ) -> None:
        """Let the node work, and do something 30 times a second, until a condition holds."""
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, f'{what} did not come in {timeout} s'
            meanwhile()
            step = time.monotonic() + 1 / 30
            while time.monotonic() < step:
                self.executor.spin_once(timeout_sec=0.01)

    def heard(self, kind: Any, topic: str, qos: QoSProfile = RELIABLE) -> list[Any]:
        """Return the messages of a topic, a list that grows."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    @contextlib.contextmanager
    def lossy(self) -> Iterator[None]:
        """Lose every fifth datagram of the domain; it takes root, and nodes started inside."""
        table = f'fogt{os.getpid()}'
        first = 7400 + 250 * int(os.environ['ROS_DOMAIN_ID'])
        self.environment['FASTDDS_BUILTIN_TRANSPORTS'] = 'UDPv4'
        rules = (f'table inet {table} {{ chain lose {{ type filter hook input priority 0; '
                 f'udp dport {first}-{first + 249} numgen random mod 5 == 0 drop; }}; }}')
        subprocess.run([*SUDO, 'nft', '-f', '-'], input=rules, text=True, check=True)
        try:
            yield
        finally:
            subprocess.run([*SUDO, 'nft', 'delete', 'table', 'inet', table], check=True)

    def close(self) -> None:
        for process, _, _ in self.processes:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        codes = []
        for process, _, reader in self.processes:
            try:
                codes.append(process.wait(60))
            except subprocess.TimeoutExpired:
                process.kill()
                codes.append(process.wait())
            reader.join(5)
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()
        assert set(codes) <= {0}, (codes, [''.join(lines) for _, lines, _ in self.processes])


@contextlib.contextmanager
def made(setenv: Callable[[str, str], None]) -> Iterator[Bench]:
    """
    Make a bench whose DDS stays on this computer, in a domain of its own.

    :param setenv: sets a variable of this process until the test ends.
    """
    setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with taken() as domain:
        setenv('ROS_DOMAIN_ID', domain)
        bench = Bench()
        try:
            yield bench
        finally:
            bench.close()

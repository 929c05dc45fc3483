# SPDX-License-Identifier: Apache-2.0
"""Nodes that a signal ends at any moment of their life."""

from __future__ import annotations

import contextlib
import random
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
from rigs.bench import Bench

#: A node without timers, whose executor has nothing to do. It says when it begins.
IDLE = """
import os
import signal
signal.signal(signal.SIGINT, lambda *_: os._exit(0))
signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
from rclpy.node import Node
from image_transport_h264 import ending
print('begins', flush=True)
ending.run(lambda: Node('idle'))
"""
STARTS = 4


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_idle_node_ends_at_any_moment(bench: Bench, number: signal.Signals) -> None:
    for _ in range(STARTS):
        moment = random.uniform(0.0, 0.3)
        with subprocess.Popen([sys.executable, '-c', IDLE], env=bench.environment, text=True,
                              stdout=subprocess.PIPE, stderr=subprocess.PIPE) as node:
            try:
                assert node.stdout is not None and node.stdout.readline() == 'begins\n'
                with contextlib.suppress(subprocess.TimeoutExpired):
                    node.wait(moment)
                node.send_signal(number)
                _, errors = node.communicate(timeout=60)
            finally:
                node.kill()
        assert (node.returncode, errors) == (0, ''), f'signal after {moment:.4f} s'


#: A node whose own end takes a second; its middleware hangs in C with the interpreter's lock.
HANGING = """
import ctypes
import sys
import time
from rclpy.node import Node
from image_transport_h264 import ending
class Hanging(Node):
    handle = property(lambda self: self if self.ending else super().handle)
    ending = False
    def __enter__(self):
        super().handle.__enter__()
    def __exit__(self, *words):
        super().handle.__exit__(*words)
        if 'hang' in sys.argv:
            ctypes.PyDLL(None).sleep(60)
    def destroy_node(self):
        time.sleep(1.0)
        self.ending = False
        super().destroy_node()
        print('destroyed', flush=True)
def make():
    node = Hanging('hanging')
    node.context.on_shutdown(node.end)
    print('made', flush=True)
    return node
Hanging.end = lambda self: setattr(self, 'ending', True)
ending.TOO_LONG = 0.5
ending.run(make)
print('ended')
if 'hang' not in sys.argv:
    time.sleep(1.0)
"""


@pytest.mark.parametrize('word, said', [('hang', ''), ('end', 'ended\n')])
def test_node_that_hangs_in_its_end_exits(bench: Bench, word: str, said: str) -> None:
    with subprocess.Popen([sys.executable, '-c', HANGING, word], env=bench.environment, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as node:
        try:
            assert node.stdout is not None and node.stdout.readline() == 'made\n'
            node.send_signal(signal.SIGINT)
            output = node.communicate(timeout=50)
        finally:
            node.kill()
    assert (node.returncode, *output) == (0, f'destroyed\n{said}', '')

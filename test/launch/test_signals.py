# SPDX-License-Identifier: Apache-2.0
"""Signals to a launch of its own process: each ends it in order, with everything taken down."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys
import threading

import pytest

SCRIPT = """
import sys
sys.path.insert(0, {folder!r})
from conftest import FakeLaunch
from launch import EventHandler, LaunchDescription, LaunchService
from launch.actions import ExecuteProcess, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnShutdown
from launch.events import Shutdown
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from fogros2.runtime.coordinator import Coordinator

class Fake(FakeLaunch):
    def note(self, *what):
        super().note(*what)
        sys.stdout.write(f'note: {{what[0]}}\\n')
        sys.stdout.flush()
    def down(self):
        self.note('down')
        if {slow_down}:
            # until the test has seen 'down' and sent its second signal
            sys.stdin.readline()
        self.note('all is gone')
        return []

def fail(which):
    print(f'note: {{which}} handler fails', flush=True)
    raise OSError('the handler failed')

fake = Fake()
service = LaunchService()
Coordinator(service.context, make_launch=fake)
planner = ContainerInstance(name='planner', ros_workspace='')
service.include_launch_description(FogROSLaunchDescription([
    CloudNode(machine=planner, package='demo', executable='talker'),
    {entities}
    ExecuteProcess(cmd=['sleep', '600'], name='robot'),
]))
status = service.run()
print('note: status', status, flush=True)
sys.exit(status)
"""


class Program:
    """A launch in a process of its own whose lines are awaited."""

    def __init__(self, package, tmp_path, *, ignore=(), **settings):
        text = SCRIPT.format(folder=str(Path(__file__).parent), **{
            'slow_down': False, 'entities': '', **settings})

        def defaults():
            os.setsid()
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_DFL)
            for number in ignore:
                signal.signal(number, signal.SIG_IGN)

        self.process = subprocess.Popen(
            [sys.executable, '-c', text], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, preexec_fn=defaults,
            env={**os.environ, 'PYTHONUNBUFFERED': '1', 'ROS_LOG_DIR': str(tmp_path / 'log')})
        self.lines = []
        self.killer = threading.Timer(300, self.process.kill)
        self.killer.start()

    def send(self, number):
        """Send a signal to the launch; SIGINT to its processes too, as a terminal does."""
        if number == signal.SIGINT:
            os.killpg(self.process.pid, number)
        else:
            self.process.send_signal(number)

    def wait_for(self, text):
        for line in self.process.stdout:
            self.lines.append(line.rstrip('\n'))
            if text in line:
                return line
        raise AssertionError(f'no {text!r} in:\n' + '\n'.join(self.lines))

    def end(self):
        self.lines += self.process.stdout.read().splitlines()
        status = self.process.wait(30)
        self.close()
        return status

    def close(self):
        self.killer.cancel()
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        self.process.stdout.close()
        if not self.process.stdin.closed:
            self.process.stdin.close()

    def notes(self):
        return [line.split()[1] for line in self.lines if line.startswith('note:')]


@pytest.fixture
def program(package, tmp_path):
    programs = []

    def start(**settings):
        programs.append(Program(package, tmp_path, **settings))
        return programs[-1]

    yield start
    for one in programs:
        one.close()


@pytest.mark.parametrize(('first', 'second'), [
    (signal.SIGINT, signal.SIGINT), (signal.SIGHUP, signal.SIGINT),
    (signal.SIGTERM, signal.SIGTERM)])
def test_second_signal_does_not_interrupt_the_rollback(program, first, second):
    launch = program(slow_down=True)
    launch.wait_for('[robot-')
    launch.send(first)
    launch.wait_for('note: down')
    launch.send(second)
    launch.wait_for('shutting down already' if first == second == signal.SIGTERM else 'ctrl-c')
    launch.process.stdin.write('\n')
    launch.process.stdin.flush()
    assert launch.end() == 0
    text = '\n'.join(launch.lines)
    assert launch.notes()[-4:] == ['stop', 'down', 'all', 'status'], text
    assert 'Traceback' not in text and 'orphaned' not in text


def test_failing_handlers_of_the_shutdown_stop_no_other(program):
    """Such as one that prints to a terminal that is closed; an ignored signal stays ignored."""
    handlers = (
        'OnShutdown(on_shutdown=lambda event, context: fail("the first"))',
        'OnShutdown(on_shutdown=[OpaqueFunction(function=lambda context: fail("the second"))])',
        'EventHandler(matcher=lambda event: isinstance(event, Shutdown), '
        'entities=[OpaqueFunction(function=lambda context: fail("the third"))])')
    launch = program(ignore=[signal.SIGHUP], entities=''.join(
        f'RegisterEventHandler({handler}),' for handler in handlers))
    launch.wait_for('[robot-')
    launch.send(signal.SIGHUP)
    launch.send(signal.SIGTERM)
    assert launch.end() == 1
    assert [note for note in launch.notes() if note != 'the'][-4:] == [
        'stop', 'down', 'all', 'status'], '\n'.join(launch.lines)
    for which in ('first', 'second', 'third'):
        assert f'note: the {which} handler fails' in launch.lines
    text = '\n'.join(launch.lines)
    assert 'handler failed' in text and 'SIGTERM: shutting down' in text and 'SIGHUP' not in text

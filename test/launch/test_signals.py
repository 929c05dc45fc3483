# SPDX-License-Identifier: Apache-2.0
"""Signals to a launch of its own process: each ends it in order, with everything taken down."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import sys

import pytest

from rigs.launched import launching

SCRIPT = """
from pathlib import Path
import sys
sys.path.insert(0, {folder!r})
from conftest import FakeLaunch
from launch import EventHandler, LaunchDescription, LaunchService
from launch.actions import ExecuteProcess, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnShutdown
from launch.events import Shutdown
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from fogros2.runtime.coordinator import Coordinator
from fogros2.waiting import wait_until

class Fake(FakeLaunch):
    def note(self, *what):
        super().note(*what)
        sys.stdout.write(f'note: {{what[0]}}\\n')
        sys.stdout.flush()
    def down(self):
        self.note('down')
        wait_until(lambda: Path({go!r}).exists(), timeout=60, what='the second signal')
        self.note('all is gone')
        return []

def fail(which):
    sys.stdout.write(f'note: {{which}} handler fails\\n')
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


@pytest.fixture
def program(package, tmp_path):
    """Return what starts a launch; its ``down`` waits for a file, unless that exists."""
    def start(*, entities='', prefix=()):
        text = SCRIPT.format(
            folder=str(Path(__file__).parent), go=str(tmp_path / 'go'), entities=entities)
        return run(text, program=(sys.executable, '-uc'), prefix=prefix, environment={
            **os.environ, 'ROS_LOG_DIR': str(tmp_path / 'log')})

    with launching() as run:
        yield start
        (tmp_path / 'go').touch()


def notes(launch):
    return [line.split()[1] for line in launch.said if line.startswith('note:')]


@pytest.mark.parametrize(('first', 'second', 'reply'), [
    (signal.SIGINT, signal.SIGINT, 'again'), (signal.SIGHUP, signal.SIGINT, 'ctrl-c'),
    (signal.SIGTERM, signal.SIGTERM, 'shutting down already')])
def test_second_signal_does_not_interrupt_the_rollback(
        program, tmp_path, first, second, reply):
    launch = program()
    launch.wait_for('[robot-')
    send(launch, first)
    launch.wait_for('note: down')
    send(launch, second)
    launch.wait_for(reply)
    (tmp_path / 'go').touch()
    assert launch.ended() == 0
    assert notes(launch)[-4:] == ['stop', 'down', 'all', 'status'], launch.text
    assert 'Traceback' not in launch.text and 'orphaned' not in launch.text


def send(launch, number):
    """Send a signal to the launch; SIGINT to its processes too, as a terminal does."""
    if number == signal.SIGINT:
        os.killpg(launch.child.pid, number)
    else:
        launch.child.send_signal(number)


def test_failing_handlers_of_the_shutdown_stop_no_other(program, tmp_path):
    """Such as one that prints to a terminal that is closed; an ignored signal stays ignored."""
    handlers = (
        'OnShutdown(on_shutdown=lambda event, context: fail("the first"))',
        'OnShutdown(on_shutdown=[OpaqueFunction(function=lambda context: fail("the second"))])',
        'EventHandler(matcher=lambda event: isinstance(event, Shutdown), '
        'entities=[OpaqueFunction(function=lambda context: fail("the third"))])')
    (tmp_path / 'go').touch()
    # which ignores SIGHUP
    launch = program(prefix=['nohup'], entities=''.join(
        f'RegisterEventHandler({handler}),' for handler in handlers))
    launch.wait_for('[robot-')
    for number in (signal.SIGHUP, signal.SIGTERM):
        send(launch, number)
    assert launch.ended() == 1
    assert [note for note in notes(launch) if note != 'the'][-4:] == [
        'stop', 'down', 'all', 'status'], launch.text
    for which in ('first', 'second', 'third'):
        assert f'note: the {which} handler fails\n' in launch.said
    assert 'handler failed' in launch.text
    assert 'SIGTERM: shutting down' in launch.text and 'SIGHUP' not in launch.text

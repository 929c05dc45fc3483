# SPDX-License-Identifier: Apache-2.0
"""A machine that vanishes under a running launch."""

from __future__ import annotations

import shutil
import subprocess
import time
import uuid

import pytest

from fogros2.model import Command
from fogros2.process import argv
from fogros2.waiting import wait_until
from fogros2_testing.plugins import install
from rigs.launched import launching

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

#: Other runs of these tests may be under way on the same computer.
RUN = uuid.uuid4().hex[:6]

LAUNCH = """
from fogros2 import (
    CloudNode, ContainerInstance, FogROSLaunchDescription, MachineInterrupted)
from launch import EventHandler
from launch.actions import LogInfo, OpaqueFunction, RegisterEventHandler
from launch_ros.actions import Node


class Warned(ContainerInstance):
    provider = {provider!r}


def generate_launch_description():
    machines = [Warned(name=name, network={network!r}, on_interrupt={on_interrupt!r},
                       vpn_path=path) for name, path in {machines!r}.items()]

    def say(context):
        event = context.locals.event
        return [LogInfo(msg=f'noticed: {{event.machine}} lost {{event.lost}}')]

    return FogROSLaunchDescription([
        *[CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                    name='speaker', namespace=f'arm{{number}}',
                    remappings=[('chatter', '/chatter')], parameters=[{{'period': 0.2}}],
                    output='screen') for number, machine in enumerate(machines)],
        Node(package='fogros2_examples', executable='listener', output='screen'),
        RegisterEventHandler(EventHandler(
            matcher=lambda event: isinstance(event, MachineInterrupted),
            entities=[OpaqueFunction(function=say)])),
    ])
"""


#: Its machines say beforehand that they will be taken away, as spot instances do.
PROVIDER = """
import dataclasses

from fogros2.provider.container import ContainerProvider


class WarningProvider(ContainerProvider):
    name = 'warning'
    capabilities = dataclasses.replace(
        ContainerProvider.capabilities, preemption_notice=('cat', '/run/notice'))
"""


@pytest.fixture
def launched(cloud_network, tmp_path):
    with launching() as launch:
        def start(machines, on_interrupt, provider='container'):
            path = tmp_path / 'interrupted.launch.py'
            path.write_text(LAUNCH.format(machines=machines, network=cloud_network,
                                          on_interrupt=on_interrupt, provider=provider))
            return launch(str(path))
        yield start


def test_preemption_notice_moves_the_nodes_in_time(
    launched, engine, tmp_path, monkeypatch,
):
    monkeypatch.setenv('PYTHONPATH', install(
        tmp_path / 'plugin', 'fogros2.provider', 'warning', PROVIDER, 'WarningProvider'))
    name = f'warned-{RUN}'
    run = launched({name: 'auto'}, 'robot', 'warning')
    run.wait_for(f'I heard: [Hello World from {name} ')
    words = argv(Command((engine, 'exec', f'fogros2-{name}', 'sh', '-c',
                          'echo "terminate at 12:00" >/run/notice'), sudo=True))
    subprocess.run(words, check=True, capture_output=True, timeout=60)
    run.wait_for(f'noticed: {name} lost False')
    run.wait_for(f"the machine '{name}' is being reclaimed: terminate at 12:00; its nodes")
    here = subprocess.run(['hostname'], capture_output=True, text=True).stdout.strip()
    run.wait_for(f'I heard: [Hello World from {here} ')
    # the one there has ended: nobody says anything twice
    begin = time.monotonic()
    wait_until(lambda: len(run.since(begin, f'I heard: [Hello World from {here} ')) >= 5,
               timeout=60.0, what='messages of the robot')
    # its last messages may be read late
    second, _ = run.since(begin, f'I heard: [Hello World from {here} ')[1]
    assert run.since(second, f'Hello World from {name} ') == []
    assert 'process has' not in run.text and run.errors == [], run.text
    run.interrupt()
    assert run.ended() == 0, run.text


def test_new_machines_replace_killed_ones(launched, engine):
    """On the robot meanwhile; each machine has the same name, and launch sees no exit."""
    machines = {f'gone-{RUN}-{path}': path for path in ('auto', 'stream')}
    run = launched(machines, 'replace')
    for name in machines:
        run.wait_for(f'I heard: [Hello World from {name} ')
    begin = time.monotonic()
    # as somebody would who knows nothing of the launch
    words = argv(Command((engine, 'rm', '-f', '-t', '0', *(
        f'fogros2-{name}' for name in machines)), sudo=True))
    subprocess.run(words, check=True, capture_output=True, timeout=60)
    for name in machines:
        run.wait_for(f'noticed: {name} lost True')
        run.wait_for(f"the machine '{name}' is gone")
    here = subprocess.run(['hostname'], capture_output=True, text=True).stdout.strip()
    # the new machines may be there before the listener finds these nodes
    run.wait_for(f'Publishing: "Hello World from {here} ')
    for name in machines:
        run.wait_for(f'{name}: a new machine runs the nodes')
    replaced = time.monotonic()
    for name in machines:
        wait_until(lambda n=name: run.since(replaced, f'I heard: [Hello World from {n} ') or None,
                   timeout=60, what='a message of the new machine')
    last = run.times[-1]
    for name in machines:
        wait_until(lambda n=name: len(run.since(last, f'Hello World from {n} ')) > 5,
                   timeout=60, what='more messages')
        # the last messages of the robot's may be read late
        third, _ = run.since(last, f'Hello World from {name} ')[2]
        assert run.since(third, f'Hello World from {here} ') == [], 'it runs once'
        assert f'[{name}.talker' in run.text
    assert len(run.since(begin, 'process started')) == 4, run.text
    assert '[arm0.speaker]' in run.text and '[arm1.speaker]' in run.text
    run.interrupt()
    assert run.ended() == 0, run.text

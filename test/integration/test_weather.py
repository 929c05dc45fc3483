# SPDX-License-Identifier: Apache-2.0
"""
A whole launch over a bad network: delay, loss, a cut, and another address of the robot's.

The robot dials its machine through a relay. A provider made for these tests says so: it makes the
machines that ContainerProvider makes, and tells the relay's address for theirs.
"""

from __future__ import annotations

from collections.abc import Iterator
import ipaddress
import json
from pathlib import Path
import re
import shutil
import subprocess
import sys
import time
from typing import Any
import uuid

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2.waiting import wait_until
from fogros2_testing.plugins import install
from rigs.launched import Launched, launching

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

#: Other runs of these tests may be under way on the same computer.
NAME = f'weather-{uuid.uuid4().hex[:6]}'
RELAY = Path(__file__).parents[1] / 'relay.py'
#: Seconds after the link's return within which messages flow again: usually 0.2. WireGuard waits
#: 5 s before it repeats a handshake.
TARGET = 4.0
PERIOD = 0.1

PROVIDER = """
import dataclasses
import json
import os
from pathlib import Path

from fogros2.provider.container import ContainerProvider
from fogros2.waiting import wait_until

FOLDER = Path(os.environ['FOGT_RELAY'])


class RelayedProvider(ContainerProvider):
    name = 'relayed'

    def create(self, spec, request):
        write('port', str(request.vpn_port))
        return super().create(spec, request)

    def describe(self, machine_id):
        machine = super().describe(machine_id)
        if not machine.vpn_host:
            return machine
        write('host', machine.vpn_host)
        relay = FOLDER / 'relay'
        wait_until(relay.exists, timeout=60.0, what='the relay')
        host, _, port = relay.read_text().partition(':')
        return dataclasses.replace(machine, vpn_host=host, vpn_port=int(port))


def write(name, text):
    (FOLDER / f'{name}.new').write_text(text)
    (FOLDER / f'{name}.new').rename(FOLDER / name)
"""

LAUNCH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from launch_ros.actions import Node


class Relayed(ContainerInstance):
    provider = 'relayed'


def generate_launch_description():
    machine = Relayed(name={name!r}, network={network!r}, vpn_path='udp')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  parameters=[{{'period': {period}}}]),
        Node(package='fogros2_examples', executable='listener', output='screen'),
        CloudNode(machine=machine, package='fogros2_examples', executable='listener',
                  remappings=[('chatter', 'from_here')], output='screen'),
        Node(package='fogros2_examples', executable='talker', name='talker_here',
             remappings=[('chatter', 'from_here')], parameters=[{{'period': {period}}}]),
    ])
"""


class Relay:
    """The relay's process, started as soon as it is known where the machine is."""

    def __init__(self, folder: Path, **settings: float) -> None:
        for name in ('host', 'port'):
            wait_until((folder / name).exists, timeout=60.0, what=f"the machine's {name}")
        target = ':'.join((folder / name).read_text() for name in ('host', 'port'))
        self.process = subprocess.Popen(
            [sys.executable, str(RELAY), '127.0.0.1:0', target, '--seed', '7',
             *(word for key, value in settings.items() for word in (f'--{key}', str(value)))],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
        assert self.process.stdin is not None and self.process.stdout is not None
        self._ask, self._answers = self.process.stdin, self.process.stdout
        address = json.loads(self._answers.readline())['listen']
        (folder / 'relay.new').write_text(address)
        (folder / 'relay.new').rename(folder / 'relay')

    def change(self, **settings: Any) -> dict[str, int]:
        """Change the weather; return the counters."""
        self._ask.write(json.dumps(settings) + '\n')
        counters: dict[str, int] = json.loads(self._answers.readline())
        return counters

    def close(self) -> None:
        """End it."""
        self._ask.close()
        self.process.wait(60)
        self._answers.close()


@pytest.fixture
def weather(tmp_path, monkeypatch) -> Iterator[Path]:
    """Install the provider for the launches of a test; return the folder it talks through."""
    monkeypatch.setenv('PYTHONPATH', install(
        tmp_path / 'plugin', 'fogros2.provider', 'relayed', PROVIDER, 'RelayedProvider'))
    folder = tmp_path / 'talk'
    folder.mkdir()
    monkeypatch.setenv('FOGT_RELAY', str(folder))
    yield folder


def second_address(engine: str, network: str) -> str:
    """Return another address of this computer in the machine's network; it goes with that."""
    asked = process.run(Command((
        engine, 'network', 'inspect', network, '--format',
        '{{.NetworkInterface}} {{range .Subnets}}{{.Subnet}}{{end}}'), sudo=True), timeout=60)
    interface, subnet = asked.stdout.split()
    address = str(list(ipaddress.ip_network(subnet).hosts())[-2])  # no machine gets it
    words = ('ip', 'address', 'replace', f'{address}/32', 'dev', interface)
    process.run(Command(words, sudo=True), timeout=60)
    return address


def heard(run: Launched, since: float, where: str) -> list[tuple[float, int]]:
    """Return times and numbers of the messages that a listener got since then."""
    # a machine's output comes with its name, and only when the connection carries it again
    return [(at, int(re.search(r': (\d+)\]', line)[1]))
            for at, line in run.since(since, 'I heard')
            if (f'[{NAME}.listener' in line) == (where == 'there')]


def flow(run: Launched, since: float, where: str, within: float) -> float:
    """Wait for a message, and return how long after ``since`` it came."""
    found = wait_until(lambda: heard(run, since, where) or None, timeout=within + 10.0,
                       longest=0.02, what=f'messages {where}')
    return found[0][0] - since


@pytest.mark.parametrize('cut', [7.0, pytest.param(30.0, marks=pytest.mark.soak)])
def test_launch_survives_a_bad_network(weather, engine, cloud_network, tmp_path, cut):
    path = tmp_path / 'weather.launch.py'
    path.write_text(LAUNCH.format(name=NAME, network=cloud_network, period=PERIOD))
    with launching() as launch:
        run = launch(str(path))
        relay = Relay(weather, delay=0.02, jitter=0.005)
        try:
            for where in ('here', 'there'):
                wait_until(lambda w=where: len(heard(run, 0.0, w)) >= 3, timeout=60.0,
                           what=f'messages {where}')
            assert relay.change()['bytes'] > 0, 'the VPN goes past the relay'

            # 5 % of all packets are lost, both ways; what was published arrives all the same
            relay.change(loss=0.05)
            begin = time.monotonic()
            wait_until(lambda: len(heard(run, begin, 'here')) >= 40, timeout=60.0,
                       what='messages in spite of loss')
            for where in ('here', 'there'):
                numbers = [number for _, number in heard(run, begin, where)]
                assert len(numbers) > 0.9 * (numbers[-1] - numbers[0]), where

            # the link is gone, then there again
            before = {where: heard(run, begin, where)[-1][1] for where in ('here', 'there')}
            relay.change(cut=True)
            gone = time.monotonic()
            wait_until(lambda: time.monotonic() - gone > cut, timeout=cut + 5.0, what='a cut')
            relay.change(cut=False, loss=0.0)
            back = time.monotonic()
            assert heard(run, gone + 1.0, 'here') == [] or (
                heard(run, gone + 1.0, 'here')[0][0] >= back), 'the link was not cut'
            assert flow(run, back, 'here', TARGET) < TARGET

            # a message to the machine tells of itself through the connection for control, which
            # doesn't go through the relay: it says when the machine's node got it
            assert flow(run, back, 'there', TARGET) < TARGET

            # the robot's packets come from another address, as on another network
            relay.change(source=second_address(engine, cloud_network))
            moved = time.monotonic()
            for where in ('here', 'there'):
                assert flow(run, moved + 0.1, where, TARGET) < TARGET

            # the same nodes all the while
            after = {where: heard(run, moved, where)[-1][1] for where in ('here', 'there')}
            assert all(after[where] > before[where] + cut / PERIOD * 0.8 for where in after)
            assert run.text.count('process started with pid') == 4, run.text
            assert 'process has' not in run.text and run.errors == [], run.text
            run.interrupt()
            assert run.ended() == 0, run.text
        finally:
            print(run.text)  # shown if the test fails
            relay.close()

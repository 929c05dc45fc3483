# SPDX-License-Identifier: Apache-2.0
"""Tests of fogros2.deploy against real containers, SSH, WireGuard and agents."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import os
from pathlib import Path
import shutil
import sys
import threading
import time
import uuid
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

import pytest

from fogros2 import ros2_daemon
from fogros2.deploy import Launch
from fogros2.errors import FogError, NameTaken
from fogros2.feature import Feature
from fogros2.model import Command, MachineSpec, NodeSpec
from fogros2.process import run
from fogros2.report import StepDone, StepStarted
from fogros2.waiting import wait_until
from fogros2_testing.plugins import instead

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]


class Ros2cliHandler(SimpleXMLRPCRequestHandler):
    """Answers at the path that the daemon of ros2 has."""

    rpc_paths = ('/ros2cli/',)


class Injected(FogError):
    """The fault of these tests."""


#: Other runs of these tests may be under way on the same computer.
RUN = uuid.uuid4().hex[:6]


@pytest.fixture
def spec(cloud_network):
    def make(name='planner', **changes):
        return MachineSpec(f'{name}-{RUN}', 'container', {'network': cloud_network}, **changes)
    return make


def test_launch_stops_the_daemon_of_its_terminals_before_its_vpn():
    launch = Launch()
    seen = []
    try:
        environment = launch.robot_environment()
        folder = launch.store.launch_folder(launch.id)
        ros2_daemon.install(folder, sys.executable)
        server = SimpleXMLRPCServer(
            ('127.0.0.1', int((folder / ros2_daemon.PORT_FILE).read_text())), Ros2cliHandler,
            logRequests=False, allow_none=True)
        interface = Path('/sys/class/net', launch.robot_vpn().interface.name)

        def stop():
            seen.append(interface.exists())
            threading.Thread(target=server.shutdown).start()

        def serve():
            with server:
                server.serve_forever(0.05)

        server.register_function(stop, 'system.shutdown')
        thread = threading.Thread(target=serve)
        thread.start()
        assert environment and interface.exists()
    finally:
        assert launch.down() == []
    thread.join(60)
    assert not thread.is_alive()
    assert seen == [True] and not interface.exists() and not folder.exists()


class Failing(Feature):
    """Ends the machine that it is used on."""

    @staticmethod
    def options():
        return None

    def machine(self, running, own):
        assert running.run(Command(('echo', 'up'), what='look'), timeout=60) == 'up\n'
        raise Injected('no')


def test_a_fault_in_the_last_step_leaves_nothing(spec, monkeypatch):
    instead(monkeypatch, 'fogros2.feature', {'failing': Failing})
    launch = Launch()
    try:
        with pytest.raises(Injected):
            launch.up(spec(on_exit='keep', features={'failing': {}}))
    finally:
        assert launch.down() == [] and not launch.store.exists(spec().name)


def test_a_cancel_in_a_step_leaves_nothing(spec):
    launch = Launch(report=lambda event: cancel.set() if (
        isinstance(event, StepStarted) and event.step == 'ROS 2') else None)
    cancel = launch.cancel
    with pytest.raises(FogError):
        launch.up(spec())
    assert launch.down() == []


def test_machines_come_up_in_parallel_and_reach_each_other(spec, tmp_path):
    """Their folders come home, and a VPN that is killed comes back."""
    events, heard = [], []
    launch = Launch(report=events.append)
    specs = [spec('one', features={'results': {
        'fetch': ['~/bags'], 'fetch_to': str(tmp_path / 'home')}}), spec('two')]
    launch.prepare(specs)
    launch.expect(each.name for each in specs)
    try:
        with ThreadPoolExecutor(2) as pool:
            machines = list(pool.map(launch.up, specs))
        for machine, other in zip(machines, reversed(machines)):
            machine.shell.run(
                Command(('ping', '-c', '1', '-W', '5', other.vpn_address)), timeout=60)
        machines[0].subscribe(heard.append)
        code = ('import os, pathlib, socket; print(socket.gethostname(), os.getuid(), flush=True);'
                'folder = pathlib.Path.home() / "bags/deep"; folder.mkdir(parents=True);'
                '(folder / "one").write_text("here")')
        machines[0].start([NodeSpec('a-1', 'node-1', arguments=('python3', '-c', code))])
        wait_until(lambda: any(e['event'] == 'exited' for e in heard), timeout=60,
                   what='the node to end')
        interface = launch.robot_vpn().interface.name
        before = wireguard_of(interface)
        run(Command(('sh', '-c', 'kill -9 "$@"', 'sh', *map(str, before)), sudo=True), timeout=60)
        wait_until(lambda: wireguard_of(interface) - before, timeout=60,
                   what='another wireguard-go')
        begin = time.monotonic()
        wait_until(lambda: machines[0].heartbeat.age < time.monotonic() - begin, timeout=60,
                   what='an answer through the VPN')
    finally:
        assert launch.down() == []
    name, user = ''.join(e['text'] for e in heard if e['event'] == 'output').split()[:2]
    assert name == f'one-{RUN}' and user != '0', 'nodes must not run as root'
    one, = (tmp_path / 'home').glob(f'one-{RUN}-*/bags/deep/one')
    assert one.read_text() == 'here'
    # a repair of the robot's may fail before it succeeds
    started, done = (sorted((e.machine, e.step) for e in events if isinstance(e, kind)
                            and e.machine) for kind in (StepStarted, StepDone))
    assert started == done


def test_two_launches_at_once_do_not_meet(spec):
    """The next one reuses a machine that was stopped."""
    first, second = Launch(), Launch()
    stopped = spec('one', on_exit='stop')
    try:
        one, two = first.up(stopped), second.up(spec('two'))
        assert one.vpn_address != two.vpn_address
        with pytest.raises(NameTaken, match='another launch on this robot'):
            second.up(spec('one'))
        assert [made.kind for made in first.store.load(stopped.name).made] == ['VPN', 'nodes']
        assert first.down() == []
        assert first.store.load(stopped.name).made == ()
        assert two.agent.request('status')['machine'] == f'two-{RUN}'
    finally:
        assert first.down() == []
        assert second.down() == []
    third = Launch()
    try:
        assert third.up(spec('one')).machine.id == one.machine.id
    finally:
        assert third.down() == []


def wireguard_of(interface):
    """Return the processes of an interface: none where the kernel does it."""
    found = set()
    for pid in filter(str.isdigit, os.listdir('/proc')):
        try:
            with open(f'/proc/{pid}/cmdline', errors='replace') as cmdline:
                words = cmdline.read().split('\0')
        except OSError:
            continue
        if words[0].endswith('wireguard-go') and interface in words:
            found.add(int(pid))
    return found

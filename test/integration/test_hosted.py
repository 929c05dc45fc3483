# SPDX-License-Identifier: Apache-2.0
"""Robots that share a host: a container machine for each, with the same launch file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import glob
import json
from pathlib import Path
import subprocess
import threading
import uuid

import pytest

from fogros2 import process
from fogros2.errors import Cancelled, NameTaken, PrerequisiteError, ShellError
from fogros2.model import Command, CreateRequest, MachineSpec, MachineState
from fogros2.provider import Attached
from fogros2.shell.ssh import SSHShell
from fogros2.waiting import wait_until
from fogros2_testing import request_for
from rigs.container_machines import key
from rigs.fleet import Fleet, fleet, heard, LAUNCH
from rigs.launched import Launched, ROS2

__all__ = ['key']

pytestmark = [
    pytest.mark.usefixtures('engine', 'root_at_login'),
    pytest.mark.skipif(process.which('sshd') is None, reason='needs sshd (openssh-server)'),
]


@pytest.fixture(scope='module')
def host(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    with fleet(tmp_path_factory.mktemp('fleet')) as running:
        yield running
        wait_until(lambda: not running.traces(), timeout=60.0, what='all traces to be gone')


def request(key: Path, spec: MachineSpec) -> CreateRequest:
    return dataclasses.replace(
        request_for(spec), authorized_key=key.with_suffix('.pub').read_text())


def test_robots_have_machines_of_the_same_name(
    host: Fleet, key: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    """Each logs in to its own, through a port of the host, within the limits it asked for."""
    spec = MachineSpec('planner', 'hosted', {**host.options, 'memory': '300m', 'cpus': 0.5})
    machines = []
    for robot in ('one', 'two'):
        monkeypatch.setenv('XDG_CONFIG_HOME', str(tmp_path / robot))
        provider = host.provider()
        machines.append((provider, provider.create(spec, request(key, spec))))
        with pytest.raises(NameTaken, match="'planner' already") as error:
            provider.create(spec, request(key, spec))
        assert error.value.hint == 'ros2 fog delete planner'
    (one, first), (two, second) = machines
    assert first != second and len(host.containers()) == 2
    for container in host.containers().values():
        assert container['HostConfig']['Memory'] == 300 << 20
        assert container['HostConfig']['NanoCpus'] == 500_000_000
    machine = one.reachable(first, name='planner', timeout=60.0)
    assert machine.endpoint is not None and machine.endpoint.host == '127.0.0.1'
    assert len({22, host.on['port'], machine.endpoint.port, machine.vpn_port}) == 4
    shell = SSHShell(dataclasses.replace(machine.endpoint, key_file=str(key)), name='planner')

    def answers() -> bool:
        with contextlib.suppress(ShellError):
            return shell.run(Command(('true',)), timeout=60.0).returncode == 0
        return False

    wait_until(answers, timeout=60.0, what='the SSH server')
    # the key is of the machine alone, and the host's own files are not there
    assert shell.run(Command(('hostname',)), timeout=60.0).stdout == 'planner\n'
    assert shell.run(Command(('ls', '/srv', '/home')), timeout=60.0).stdout.split() == [
        '/home:', 'fog', '/srv:']
    shell.close()
    one.destroy(first)
    assert two.describe(second).state is not MachineState.DELETED
    two.destroy(second)


def test_host_refuses_what_it_lacks(host: Fleet, key: Path) -> None:
    spec = MachineSpec('planner', 'hosted', {**host.options, 'engine': 'docker', 'image': 'a'})
    if process.which('docker') is None:
        with pytest.raises(PrerequisiteError, match='no container engine'):
            host.provider().create(spec, request(key, spec))
    spec = MachineSpec('planner', 'hosted', {**host.options, 'mounts': ['/no/such/folder']})
    with pytest.raises(Exception, match="'/no/such/folder' of mounts= doesn't exist"):
        host.provider().create(spec, request(key, spec))
    assert host.containers() == {}


def test_volume_stays_on_the_host_and_has_one_machine(
    host: Fleet, key: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    provider, name = host.provider(), f'models-{uuid.uuid4().hex[:6]}'
    # the host's name is not one of ~/.ssh/config here
    find = provider._find_host
    monkeypatch.setattr(provider, '_find_host', lambda on: find({**host.on, **on}))

    def create(machine: str) -> str:
        spec = MachineSpec(machine, 'hosted', host.options)
        return provider.create(spec, dataclasses.replace(
            request(key, spec), with_volumes={name: ('/data', 50)}))

    machine_id = create('planner')
    try:
        assert provider.attach(machine_id, name, 50) == Attached()
        volume, = (one for one in provider.volumes(['127.0.0.1']) if one.name == name)
        assert volume.user == 'planner'
        for take in (lambda: create('other'), lambda: provider.delete_volume(volume.id)):
            with pytest.raises(NameTaken, match=f"'planner' .*has the volume '{name}'"):
                take()
    finally:
        provider.destroy(machine_id)
    provider.delete_volume(volume.id)
    assert name not in [one.name for one in provider.volumes(['127.0.0.1'])]


def test_cancelled_creation_leaves_nothing(host: Fleet, key: Path) -> None:
    provider, spec = host.provider(), MachineSpec('planner', 'hosted', host.options)
    provider.cancel = threading.Event()
    timer = threading.Timer(0.6, provider.cancel.set)
    timer.start()
    with contextlib.suppress(Cancelled):
        provider.create(spec, request(key, spec))
    timer.join()
    # as the launch does when it has no id
    for machine in provider.find({'fogros2-name': 'planner'}):
        provider.destroy(machine.id)

    def settled() -> bool:
        for machine in host.provider().find({'fogros2-name': 'planner'}):
            provider.destroy(machine.id)
        busy = process.run(Command(('pgrep', '-f', 'hosts.served')), timeout=60.0,
                           check=False).stdout
        return not busy and not host.traces()

    wait_until(settled, timeout=60.0, what='the engine to finish')


def fog(host: Fleet, robot: str, *words: str) -> str:
    done = subprocess.run([ROS2, 'fog', *words], env=host.environment(robot), timeout=120,
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_robots_hear_shared_topics_of_each_other_alone(
    host: Fleet, launch: Callable[..., Launched], nothing_left: None,
) -> None:
    path = host.launch_file()
    one = launch(str(path), 'robot:=one', environment=host.environment('one'))
    one.wait_for('heard count of one')
    # the second robot comes later, and gets the map that was published before
    path = host.launch_file(LAUNCH.replace('robot_timeout=5', "on_exit='keep'"))
    two = launch(str(path), 'robot:=two', 'vpn_path:=stream',
                 environment=host.environment('two'))
    two.wait_for('VPN path')
    two.wait_for('heard map of one')
    one.wait_for('heard map of two')
    for each in (one, two):
        each.wait_for('heard count', times=len(heard(each, 'heard')) + 10, timeout=60.0)
    assert heard(one, 'heard') == {'map of one', 'map of two', 'count of one'}
    assert heard(two, 'heard') == {'map of one', 'map of two', 'count of two'}
    assert heard(one, 'sees') | heard(two, 'sees') <= {'', '/of_one', '/of_two'}
    assert not heard(one, 'sees') & {'/of_two'} and not heard(two, 'sees') & {'/of_one'}
    assert one.text.count('heard map of two') == two.text.count('heard map of one') == 1

    # no other account of a machine writes where its relay does
    assert set(host.shared().values()) == {'fog 711'}

    # both are in both lists, each its own robot's
    for robot in ('one', 'two'):
        rows = [row for row in json.loads(fog(host, robot, 'list', '--json'))['machines']
                if row['provider'] == 'hosted']
        assert sorted('(robot ' in row['state'] for row in rows) == [False, True], rows
        assert {row['name'] for row in rows} == {'planner'}

    # limits hold: a runaway node of one robot is slowed down, and the other robot goes on
    fog(host, 'one', 'connect', 'planner', '--', 'sh', '-c',
        'for each in 1 2; do timeout 120 sh -c "while :; do :; done" >/dev/null 2>&1 & done')
    throttled = next(iter(
        one['Id'] for one in host.containers().values()
        if one['Config']['Labels']['fogros2-robot'] == robot_of(host, 'one')))
    wait_until(lambda: slowed(throttled), timeout=60.0, what='the limit to take hold')
    two.wait_for('heard count of two', times=two.text.count('heard count of two') + 5)

    # a killed robot's machine ends by itself, the other's stays
    one.kill()
    wait_until(lambda: len(host.containers()) == 1, timeout=60.0, what='the machine to end')
    assert two.child.poll() is None
    fog(host, 'one', 'gc')
    assert fog(host, 'one', 'list', '--json') and len(host.containers()) == 1
    two.interrupt()
    assert two.ended() == 0, two.text
    assert two.clean, two.text

    # a kept machine is deleted by its robot; a computer without a record knows no host to ask
    assert len(host.containers()) == 1
    assert 'hosted' not in {row['provider'] for row in json.loads(
        fog(host, 'stranger', 'list', '--json'))['machines']}
    fog(host, 'two', 'delete', 'planner', '--yes')
    wait_until(lambda: not host.traces(), timeout=60.0, what='all traces to be gone')


def robot_of(host: Fleet, robot: str) -> str:
    rows = json.loads(fog(host, robot, 'list', '--json'))['machines']
    return next(str(row['robot']) for row in rows if '(robot ' not in row['state'])


def slowed(identity: str) -> bool:
    """Return whether the kernel has slowed a container down."""
    # Path.rglob fails where a group of another container goes meanwhile
    for group in glob.glob(f'/sys/fs/cgroup/**/*{identity}*/cpu.stat', recursive=True):
        for line in Path(group).read_text().splitlines():
            if line.startswith('nr_throttled ') and int(line.split()[1]) > 0:
                return True
    return False

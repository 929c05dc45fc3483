# SPDX-License-Identifier: Apache-2.0
"""Tests of fogros2.deploy's ways out, against a provider and a shell that remember."""

from __future__ import annotations

from concurrent.futures import Future
import contextlib
import dataclasses
import json
import socket
import threading
import time
from types import SimpleNamespace

import pytest

from fogros2 import plan, plugin_system, process
from fogros2.agent_client import AgentClient
from fogros2.bootstrap import RosInstall
from fogros2.deploy import entering, Launch, robot_vpn, watching
from fogros2.deploy import launch as launches
from fogros2.deploy.creating import Creation
from fogros2.deploy.deployment import Deployment
from fogros2.deploy.entering import Entrance
from fogros2.deploy.guarding import Guard
from fogros2.deploy.job import Job
from fogros2.deploy.joining import Joining
from fogros2.deploy.robot_vpn import RobotVpn, VpnMember
from fogros2.errors import (
    AgentError,
    Cancelled,
    CommandError,
    ConfigurationError,
    ConnectError,
    DeadlineExceeded,
    FogError,
    HostKeyError,
    NameTaken,
    PrerequisiteError,
    ProviderError,
    StoreError,
    VpnError,
)
from fogros2.model import (
    Command,
    Endpoint,
    Machine,
    MachineSpec,
    MachineState,
    Peer,
    Result,
    VpnInterface,
)
from fogros2.shell import host_key
from fogros2.store import MachineDirectory, Store
from fogros2.testing.fakes import FakeProvider, FakeShell, FakeStream
from fogros2.waiting import Timeouts, wait_until

SPEC = MachineSpec('planner', 'fake')
#: As it is; the fixture below has it do nothing.
ENSURE = RobotVpn.ensure
ROBOT = VpnInterface('fog0a0b0c', '198.18.7.1', '198.18.7.0/24', 0, '/nowhere/key', guarded=True)


@pytest.fixture
def provider(monkeypatch):
    fake = FakeProvider()
    monkeypatch.setattr(launches, 'provider', lambda name: fake)
    return fake


@pytest.fixture
def launch(tmp_path, monkeypatch):
    def choose(self, launch, folder):
        self._launch, self._lock, self.interface = launch, threading.Lock(), ROBOT
        self._members, self._up, self._stop = {}, False, threading.Event()

    monkeypatch.setattr(RobotVpn, '__init__', choose)
    monkeypatch.setattr(RobotVpn, 'ensure', lambda self: Peer('robot', '', ROBOT.address))
    return Launch(store=Store(tmp_path), environment={})


def test_a_machine_is_ended_though_its_id_could_not_be_written_down(
        launch, provider, monkeypatch):
    save = MachineDirectory.save

    def full(self, record):
        if record.machine_id is not None:
            raise StoreError('record.json can not be written: No space left on device')
        save(self, record)

    monkeypatch.setattr(MachineDirectory, 'save', full)
    with pytest.raises(StoreError):
        launch.up(SPEC)
    assert list(provider.find({})) == []


def test_a_machine_is_ended_whose_creation_failed_half_way(launch, provider, monkeypatch):
    create = provider.create

    def cut(spec, request):
        create(spec, request)
        raise ProviderError('the answer was lost')

    monkeypatch.setattr(provider, 'create', cut)
    with pytest.raises(ProviderError):
        launch.up(SPEC)
    assert list(provider.find({})) == []


def test_of_a_refused_creation_nothing_is_told_but_the_refusal(launch, provider):
    refused = ProviderError('your token has expired')
    refused.refused = True
    provider.failures.update(create=refused)
    with pytest.raises(ProviderError, match='has expired'):
        launch.up(SPEC)
    assert 'find' not in provider.calls
    assert launch.down() == []
    assert not launch.store.machine(SPEC.name).exists()


def test_a_machine_that_may_have_been_made_is_not_forgotten(launch, provider):
    lost = ProviderError('the API server does not answer')
    provider.failures.update(create=lost, find=lost)
    with pytest.raises(ProviderError, match='does not answer'):
        launch.up(SPEC)
    assert 'find' in provider.calls
    assert launch.down() == [lost]
    assert launch.store.machine(SPEC.name).exists()


def test_the_interface_goes_though_a_machine_ends_with_an_error_of_no_known_kind(launch):
    def fail():
        raise KeyError('InstanceId')

    gone = []
    up = Future()
    up.set_result(SimpleNamespace(close=fail))
    launch._ups['talker'] = up
    launch.undo.callback(gone.append, 'interface')
    with pytest.raises(KeyError):
        launch.down()
    assert gone == ['interface']


def kept(store, provider, **changes):
    """Leave a machine behind, as a launch does that keeps it."""
    spec = MachineSpec('planner', 'fake', on_exit='keep', options={'size': 1})
    launch = Launch(store=store, environment={})
    with store.machine('planner').lock():
        mine = Job(launch, spec)
        Creation(mine)._claim('token')
        machine = Machine('fake-1', 'planner', 'fake', MachineState.PENDING, tags={
            'fogros2-on-exit': 'keep'})
        provider._machines['fake-1'], provider._waits['fake-1'] = machine, 0
        mine.save(machine_id='fake-1', launch='', pid=0, pid_start=0)
    return spec


@pytest.mark.parametrize(('changes', 'error', 'text'), [
    ({'options': {'size': 2}}, NameTaken, 'another size'),
    ({'options': {}}, NameTaken, 'another size'),
    ({'on_exit': 'stop'}, ConfigurationError, 'not made to be stopped')])
def test_a_kept_machine_is_not_taken_for_another(launch, provider, changes, error, text):
    spec = kept(launch.store, provider)
    asked = {'options': spec.options, 'on_exit': 'delete', **changes}
    with pytest.raises(error, match=text):
        launch.up(MachineSpec('planner', 'fake', **asked))
    assert [machine.id for machine in provider.find({})] == ['fake-1']
    assert launch.store.machine('planner').load().machine_id == 'fake-1'


def test_a_step_that_fails_ends_those_beside_it(launch, provider, monkeypatch):
    syncing = threading.Event()

    def join(self, *arguments):
        assert syncing.wait(10)
        raise VpnError('no way there')

    def sync(self, *arguments):
        syncing.set()
        wait_until(lambda: False, timeout=60, cancel=self.job.cancel, what='the workspace')

    stand_in = [
        (Creation, 'run', None), (Entrance, 'connect', None), (Joining, 'interface', None),
        (Joining, 'fit', None), (Guard, 'arm', None),
        (Deployment, 'prepare_host', RosInstall('ros', ())),
        (Deployment, 'configure_dds', {})]
    for part, name, value in stand_in:
        monkeypatch.setattr(part, name, lambda self, *_, value=value: value)
    monkeypatch.setattr(Joining, 'join', join)
    monkeypatch.setattr(Deployment, 'sync', sync)
    begin = time.monotonic()
    with pytest.raises(VpnError, match='no way there'):
        launch.up(SPEC)
    assert time.monotonic() - begin < 20
    assert not launch.cancel.is_set(), 'other machines of the launch go on'


def test_the_workspace_travels_and_the_vpn_comes_up_while_ros_is_installed(
        launch, provider, monkeypatch):
    travelling, joining = threading.Event(), threading.Event()
    equipped = []

    def prepare_host(self, shell, on_plan):
        on_plan(RosInstall('ros', ()))
        assert travelling.wait(10) and joining.wait(10)
        assert not equipped
        raise PrerequisiteError('no such package')

    def sync(self, shell, ros, installed):
        travelling.set()
        installed.result()

    for part, name, value in [
            (Creation, 'run', None), (Entrance, 'connect', None), (Joining, 'interface', None),
            (Joining, 'fit', None), (Guard, 'arm', None), (Deployment, 'configure_dds', {})]:
        monkeypatch.setattr(part, name, lambda self, *_, value=value: value)
    monkeypatch.setattr(Joining, 'join', lambda self, *arguments: joining.set())
    monkeypatch.setattr(Deployment, 'prepare_host', prepare_host)
    monkeypatch.setattr(Deployment, 'sync', sync)
    monkeypatch.setattr(Deployment, 'equip', lambda self, equipment: equipped.append(equipment))
    with pytest.raises(PrerequisiteError, match='no such package'):
        launch.up(SPEC)
    assert not equipped


class BusyAgent(FakeStream):
    """The agent of another launch, which has the machine."""

    def write(self, data):
        for line in data.splitlines():
            number = json.loads(line)['id']
            reply = {'id': number, 'ok': False, 'kind': 'busy', 'hint': '',
                     'error': "this machine belongs to launch 'abc'"}
            self.say(json.dumps(reply).encode() + b'\n')


def test_a_computer_that_another_robot_uses_by_the_same_name_is_left_alone(
        launch, provider, monkeypatch):
    shell = FakeShell(
        handlers={'sh': lambda command: Result(0, 'there\n', '')},
        streams=[BusyAgent()])
    machine = Machine('x', 'planner', 'ssh', MachineState.RUNNING, owned=False,
                      shell=Endpoint('fake', user='fog'))
    monkeypatch.setattr(Creation, 'run', lambda self: machine)
    monkeypatch.setattr(Entrance, 'connect', lambda self, machine: shell)
    with pytest.raises(AgentError, match="belongs to launch 'abc'"):
        launch.up(MachineSpec('planner', 'ssh'))
    assert shell.files == {}
    assert not [command for command in shell.commands if command.argv[0] != 'sh']
    assert not [command for command in shell.commands if 'install' in command.argv[-1]]


@pytest.fixture
def mute():
    """Return the port of a server that takes connections and never says a word."""
    with socket.create_server(('127.0.0.1', 0), backlog=16) as server:
        yield server.getsockname()[1]


def reach(launch, port):
    mine = Job(launch, MachineSpec('planner', 'ssh'))
    machine = Machine('x', 'planner', 'ssh', MachineState.RUNNING, owned=False, shell=Endpoint(
        'ssh', '127.0.0.1', port, 'fog', host_key='ssh-ed25519 AAAA', key_file='/nowhere'))
    with mine.undo:
        Entrance(mine).connect(machine)


def test_a_login_that_nobody_answers_can_be_cancelled(launch, provider, monkeypatch, mute):
    monkeypatch.setattr(entering, 'LOGIN_ATTEMPT', 0.5)
    timer = threading.Timer(0.2, launch.cancel.set)
    timer.start()
    begin = time.monotonic()
    with pytest.raises(Cancelled):
        reach(launch, mute)
    assert time.monotonic() - begin < 15
    timer.join()


@pytest.fixture
def closed_port():
    """Return a port that refuses connections, and that no other program can take."""
    with socket.socket() as taken:
        taken.bind(('127.0.0.1', 0))
        yield taken.getsockname()[1]


@pytest.mark.parametrize('ended', [True, False])
def test_a_machine_that_ends_while_it_boots_is_waited_for_no_longer(
        launch, provider, monkeypatch, ended, closed_port):
    monkeypatch.setattr(entering, 'ADDRESS_INTERVAL', 0.1)
    monkeypatch.setattr(FakeProvider, 'firewall', True)
    mine = Job(launch, SPEC)
    Creation(mine).run()
    machine = dataclasses.replace(provider.describe(mine.machine_id), shell=Endpoint(
        'ssh', '127.0.0.1', closed_port, 'fog', host_key='ssh-ed25519 AAAA', key_file='/nowhere'))
    launch.timeouts = mine.timeouts = Timeouts(ssh=0.8)
    if ended:
        provider.destroy(mine.machine_id)
    known = (ProviderError, 'ended while') if ended else (ConnectError, 'refuses connections')
    with mine.undo, pytest.raises(known[0], match=known[1]):
        Entrance(mine).connect(machine)


def test_a_machine_that_boots_slowly_has_the_time_of_its_boot(launch, provider, monkeypatch):
    mine = Job(launch, SPEC)
    mine.timeouts = Timeouts(boot=300.0, ssh=60.0)
    mine.record = dataclasses.replace(mine.record, armed=time.time() - 20)
    assert Entrance(mine)._patience() == 60.0
    monkeypatch.setattr(FakeProvider, 'one_time_host_key', True)
    assert 270 < Entrance(mine)._patience() <= 280
    mine.record = dataclasses.replace(mine.record, host_key='its own')
    assert Entrance(mine)._patience() == 60.0


def test_a_login_that_is_refused_to_the_end_says_so(launch, provider, mute):
    with socket.create_server(('127.0.0.1', 0)) as server:
        port = server.getsockname()[1]
    launch.timeouts = Timeouts(ssh=0.3)
    with pytest.raises(ConnectError, match='refuses connections'):
        reach(launch, port)


def test_the_vpn_is_looked_after_though_looking_fails_once(launch, monkeypatch):
    seen = []

    def run(command, **arguments):
        seen.append(command)
        if len(seen) == 1:
            raise DeadlineExceeded('it took longer than 30 s')
        robot._stop.set()
        raise FogError('enough')

    robot = launch.robot_vpn()
    robot.vpn = plugin_system.load('fogros2.vpn', 'wireguard')()
    monkeypatch.setattr(process, 'run', run)
    monkeypatch.setattr(robot._stop, 'wait', lambda timeout: robot._stop.is_set())
    robot._keep()
    assert len(seen) == 2


def test_a_vpn_that_cannot_be_repaired_is_told_now_and_then(launch, monkeypatch):
    waits = []

    def wait(seconds):
        waits.append(seconds)
        return len(waits) > 8

    def run(command, **arguments):
        if command.what.startswith('repair') and len(waits) < 7:
            raise FogError('no')
        return Result(1 if len(waits) < 8 else 0, '', '')

    robot = launch.robot_vpn()
    robot.vpn = plugin_system.load('fogros2.vpn', 'wireguard')()
    monkeypatch.setattr(process, 'run', run)
    monkeypatch.setattr(robot._stop, 'wait', wait)
    robot._keep()
    assert waits == [1.0, 2.0, 4.0, 8.0, 15.0, 15.0, 15.0, 1.0, 1.0]


def test_an_interface_that_was_taken_down_does_not_come_up_again(launch, monkeypatch):
    robot = launch.robot_vpn()
    robot._stop.set()
    monkeypatch.setattr(process, 'run', None)
    with pytest.raises(Cancelled):
        ENSURE(robot)
    assert robot.down


def test_what_ended_wrongly_is_all_told_before_an_error_that_nobody_expected(launch):
    steps, gone = [], []
    launch.report = steps.append
    launch.undo.callback(gone.append, 'interface')

    def machine(error):
        def close():
            raise error

        up = Future()
        up.set_result(SimpleNamespace(close=close))
        return up

    launch._ups = {'a': machine(ValueError('odd')), 'b': machine(ProviderError('still there'))}
    with pytest.raises(ValueError, match='odd'):
        launch.down()
    assert [(step.machine, step.reason) for step in steps] == [('b', 'still there')]
    assert gone == ['interface']


class Members:
    """Machines of a VPN whose commands a test answers."""

    def __init__(self, robot):
        self.robot = robot
        self.away = set()
        self.told = []

    def add(self, number):
        name = f'm{number}'
        place = plan.Place(Peer(name, f'key {name}', f'198.18.7.{number}', f'{name}:1'))

        def on(commands):
            for peers in commands:
                if name in self.away:
                    raise ConnectError(f"'{name}' is out of reach")
                self.told.append((name, peers))

        member = VpnMember(place, ROBOT, on, lambda peers: None)
        member.up(self.robot)
        self.robot.admit(member)
        self.robot.spread(member)


@pytest.fixture
def members(launch, monkeypatch):
    robot = launch.robot_vpn()
    names = staticmethod(lambda interface, peers: [sorted(peer.name for peer in peers)])
    robot.vpn = type('Names', (), {'up': names, 'peers': names})()
    monkeypatch.setattr(launch, 'robot', lambda commands: None)
    return Members(robot)


def test_a_new_machine_does_not_fail_as_another_cannot_be_told_of_it(members, monkeypatch):
    monkeypatch.setattr(robot_vpn, 'TELLING', 0.2)
    members.add(2)
    members.away = {'m2'}
    begin = time.monotonic()
    members.add(3)
    assert time.monotonic() - begin < 5
    assert members.told[-1] == ('m3', ['m2', 'robot'])
    members.away = set()
    wait_until(lambda: ('m2', ['m3', 'robot']) in members.told, timeout=10,
               what='an update of the first machine')


def test_everybody_knows_of_a_new_machine_when_it_is_up(members):
    members.add(2)
    members.add(3)
    members.add(4)
    assert members.told[-2:] in (
        [('m2', ['m3', 'm4', 'robot']), ('m3', ['m2', 'm4', 'robot'])],
        [('m3', ['m2', 'm4', 'robot']), ('m2', ['m3', 'm4', 'robot'])])


def test_a_port_that_speaks_no_ssh_is_told_soon(launch, provider, monkeypatch):
    monkeypatch.setattr(FakeProvider, 'owned', False)
    monkeypatch.setattr(entering, 'LOGIN_ATTEMPT', 0.5)
    with socket.create_server(('127.0.0.1', 0)) as server:
        def serve():
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    connection.sendall(b'HTTP/1.1 400 Bad Request\r\n\r\n')
                    connection.close()

        thread = threading.Thread(target=serve)
        thread.start()
        begin = time.monotonic()
        with pytest.raises(ConnectError, match='does not answer as an SSH server'):
            reach(launch, server.getsockname()[1])
        assert time.monotonic() - begin < 10
        server.shutdown(socket.SHUT_RDWR)
        thread.join(10)


def test_a_host_key_is_taken_from_what_the_machine_prints():
    assert host_key.parse('motd\nssh-ed25519 AAAA+/x== planner\n') == 'ssh-ed25519 AAAA+/x=='
    for said in ('', 'ssh-rsa AAAA x', 'ssh-ed25519 $(id)'):
        with pytest.raises(HostKeyError, match='made no host key'):
            host_key.parse(said)


def test_a_machine_with_a_network_that_overlaps_the_vpn_s_keeps_it(launch, provider):
    launch.expect(['planner'])
    mine = Job(launch, SPEC)
    joining = Joining(mine, Guard(mine))
    plain = joining.interface()
    assert joining.fit(plain, ['10.0.0.0/8', '172.17.0.0/16']) == plain
    fitted = joining.fit(plain, ['10.0.0.0/8', '198.18.0.0/16'])
    assert fitted.host_routes and launch.store.machine('planner').load().vpn == fitted


@pytest.mark.parametrize('there', [True, False])
def test_connection_that_breaks_at_the_end_is_opened_again(launch, provider, there):
    ran = []

    def run(command, **_):
        ran.append(command.argv[0])
        if len(ran) == 1 or not there:
            raise ConnectError('the connection was lost')

    mine = Job(launch, SPEC)
    mine.ask, mine.shell = lambda seconds: None, SimpleNamespace(run=run)
    mine.patience(30.0)
    mine.ask = None
    if there:
        mine.tidy(mine.shell, [Command(('remove',))])
        assert ran == ['remove', 'true', 'remove']
    else:
        with pytest.raises(ConnectError):
            mine.tidy(mine.shell, [Command(('remove',))])
        assert ran == ['remove', 'true'] and mine.patience(30.0) < 30.0


@pytest.mark.parametrize('where', ['describe', 'found', 'gone'])
def test_a_watch_that_fails_says_so_and_is_a_fault_in_the_end(
        launch, provider, monkeypatch, where):
    heard = []
    launch.report = heard.append
    mine = Job(launch, SPEC)
    mine.record = dataclasses.replace(mine.record, machine_id='fake-1')
    state = MachineState.DELETED if where == 'gone' else MachineState.RUNNING

    def describe(machine_id):
        if where == 'describe':
            raise KeyError('Reservations')
        return Machine('fake-1', 'planner', 'fake', state)

    def fail(told):
        raise KeyError('Reservations')

    monkeypatch.setattr(provider, 'describe', describe)
    watch = watching.Watch(mine, SimpleNamespace(silent_for=60.0), SimpleNamespace(age=60.0),
                           gone=fail, found=fail)
    wait_until(lambda: bool(heard), timeout=10, what='a word of it')
    assert "KeyError: 'Reservations'" in heard[0].reason and heard[0].machine == 'planner'
    with pytest.raises(KeyError):
        watch.close()
    watch.close()


def test_a_port_of_the_robot_that_is_taken_says_what_to_do(launch, monkeypatch):
    def run(command, **arguments):
        raise CommandError(
            command, Result(1, '', 'UDP port 51820: Address already in use'), 'this computer')

    robot = launch.robot_vpn()
    robot.vpn = plugin_system.load('fogros2.vpn', 'wireguard')()
    monkeypatch.setattr(process, 'run', run)
    with pytest.raises(VpnError, match='in use already.*FOGROS2_VPN_PORT names another'):
        robot._bring_up()


@pytest.mark.parametrize(('on_exit', 'owned', 'hint'), [
    ('keep', True, 'ros2 fog delete planner'), ('delete', False, 'nothing needs to be done')])
def test_what_stays_on_a_machine_out_of_reach_is_told_once(
        launch, provider, monkeypatch, on_exit, owned, hint):
    monkeypatch.setattr(FakeProvider, 'owned', owned)
    mine = Job(launch, dataclasses.replace(SPEC, on_exit=on_exit))
    mine.reused = True

    def silent(command):
        raise ConnectError("'planner' has not answered for 2 s")

    shell = mine.shell = FakeShell(handlers={'ip': silent, 'true': silent})
    with mine.undo:
        Creation(mine)._claim('token')
        mine.undoing('end', Creation(mine)._end)
        for name in ('agent', 'VPN', 'nodes'):
            mine.undoing(name, lambda: mine.tidy(shell, [Command(('ip', 'link'))]))
    told, = launch.down()
    assert 'stays there (nodes, VPN, agent)' in str(told) and hint in told.hint


def test_a_machine_that_vanishes_while_it_ends_its_nodes_is_given_up(launch):
    said = FakeStream()
    client = AgentClient(FakeShell(streams=[said]), '/run/x', agent_path='agent.py')
    begin = time.monotonic()
    with pytest.raises(DeadlineExceeded, match="hasn't said a word for 0.3 s"):
        client.request('release', timeout=30.0, silent=0.3)
    assert time.monotonic() - begin < 5
    client.close()


def test_a_machine_is_ended_while_another_still_comes_up(launch):
    ended = threading.Event()
    slow, fast = Future(), Future()
    launch._ups.update(slow=slow, fast=fast)
    fast.set_result(SimpleNamespace(close=ended.set))

    def fail():
        slow.set_exception(Cancelled() if ended.wait(10) else AssertionError('one by one'))

    thread = threading.Thread(target=fail)
    thread.start()
    assert launch.down() == []
    thread.join(10)
    assert isinstance(slow.exception(), Cancelled)

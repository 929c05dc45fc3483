# SPDX-License-Identifier: Apache-2.0
"""Tests of fogros2.deploy's ways out, against a provider and a shell that remember."""

from __future__ import annotations

from concurrent.futures import Future, wait
import contextlib
import copy
import dataclasses
import hashlib
import math
import os
from pathlib import Path
import re
import signal
import socket
import threading
import time
from types import SimpleNamespace

import pytest

from fogros2 import plan, process, ros2_daemon
from fogros2.agent_client import agent_program, AgentClient
from fogros2.dds import Router
from fogros2.dds.zenoh import Zenoh
from fogros2.deploy import Launch, robot_router, robot_vpn, undo
from fogros2.deploy import launch as deployed
from fogros2.deploy.robot_vpn import VpnMember
from fogros2.deploy.running import RunningMachine
from fogros2.deploy.steps import arming, connecting, dds, installing, watching
from fogros2.deploy.steps.arming import Arming
from fogros2.deploy.steps.connecting import Connection
from fogros2.deploy.steps.creating import Creation
from fogros2.deploy.steps.joining import Joining
from fogros2.deploy.steps.watching import Watch
from fogros2.errors import (
    AgentError,
    Cancelled,
    CommandError,
    ConfigurationError,
    ConnectError,
    DdsError,
    DeadlineExceeded,
    FogError,
    HostKeyError,
    NameTaken,
    PrerequisiteError,
    ProviderError,
    ShellError,
    StoreError,
    VpnError,
    WorkspaceError,
)
from fogros2.feature import Feature
from fogros2.host.bootstrap import RosInstall
from fogros2.host.inspection import HostFacts
from fogros2.model import (
    Command,
    CreateRequest,
    Endpoint,
    Machine,
    MachineSpec,
    MachineState,
    NodeSpec,
    Peer,
    Result,
)
from fogros2.provider import Capabilities
from fogros2.report import Silence, StepDone, StepFailed, Warned
from fogros2.shell import host_key
from fogros2.store import Made, process_start, Store
from fogros2.vpn import addresses, STAYS
from fogros2.waiting import in_thread, Periodic, Timeouts, wait_until
from fogros2_features.guests import invitation
from fogros2_features.guests.provider import JoinedProvider
from fogros2_features.replacement import Replacement
from fogros2_testing.fakes import (
    FAKE_ENDPOINT,
    FakeProvider,
    FakeShell,
    FakeStream,
    FakeVpn,
)
from fogros2_testing.plugins import instead
from ros2fog_cli.api import endings

SPEC = MachineSpec('planner', 'fake')


@pytest.fixture
def provider(monkeypatch):
    fake = FakeProvider()

    def ssh():
        made = copy.copy(fake)
        made.name = 'ssh'
        return made

    instead(monkeypatch, 'fogros2.provider', {'fake': lambda: fake, 'ssh': ssh})
    return fake


@pytest.fixture
def events():
    return []


@pytest.fixture
def launch(tmp_path, monkeypatch, events):
    instead(monkeypatch, 'fogros2.vpn', {'wireguard': FakeVpn})
    made = Launch(store=Store(tmp_path), environment={}, report=events.append)
    yield made
    made.down()


def begun(launch, spec=SPEC, **changes):
    """Return the context and the job of a machine that is about to be deployed."""
    context = dataclasses.replace(launch.context(spec), **changes)
    return context, RunningMachine(context, spec)


# -- what is checked before the VPN ---------------------------------------------------------


@pytest.fixture
def checked(provider, monkeypatch):
    """Return a provider whose machines have a shell of a known kind."""
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(shell_kind='local'))
    return provider


def test_missing_program_is_found_without_the_vpn(launch, checked):
    with pytest.raises(WorkspaceError, match="^planner: .*no package 'demo'"):
        launch.check_here([SPEC], {'planner': [('demo', 'talker')]})
    # only the machine knows its packages
    checked.has_own_packages = lambda spec: True
    launch.check_here([SPEC], {'planner': [('demo', 'talker')]})
    assert checked.calls == ['check']
    assert list((launch.store.root / 'launches').glob('*/vpn.key')) == []


def test_domain_that_is_no_number_is_refused(launch):
    launch.user_environment['ROS_DOMAIN_ID'] = 'seven'
    with pytest.raises(ConfigurationError, match='ROS_DOMAIN_ID=seven is no number .use 0 to 101'):
        launch.dds()


@pytest.mark.parametrize(('robot', 'changes', 'count', 'words'), [
    ({'ROS_SECURITY_ENABLE': 'true'}, {}, 1, "not those of machine 'm0', which has no keystore"),
    ({}, {'environment': {'ROS_DOMAIN_ID': '5'}}, 1, 'ROS_DOMAIN_ID=5, those here 0'),
    ({}, {}, 33, 'has 33 machines, and the robot.s router can have 32')])
def test_machines_that_no_node_would_hear_are_not_created(
        launch, checked, monkeypatch, robot, changes, count, words):
    monkeypatch.setattr(deployed, 'check_robot', lambda: None)
    monkeypatch.setattr(plan, 'check_rmw', lambda *_: None)
    launch.user_environment.update(robot)
    launch.use_dds('zenoh')
    specs = [dataclasses.replace(SPEC, name=f'm{n}', **changes) for n in range(count)]
    with pytest.raises(DdsError, match=words):
        launch.prepare(specs)
    assert checked.calls == []
    launch.prepare([dataclasses.replace(SPEC, name=f'm{n}', environment=robot)
                    for n in range(32)])


@pytest.mark.parametrize(('dds', 'counts', 'crowded'), [
    ('cyclonedds', [11, 10, 12], ['m0, m2']), ('cyclonedds', [11, 10, 10], []),
    ('fastdds', [11, 11, 12], [])])
def test_warning_of_processes_that_would_not_meet(
        launch, checked, events, monkeypatch, dds, counts, crowded):
    monkeypatch.setattr(deployed, 'check_robot', lambda: None)
    monkeypatch.setattr(plan, 'check_rmw', lambda *_: None)
    checked.has_own_packages = lambda spec: True
    launch.use_dds(dds)
    for number, count in enumerate(counts):  # as machines whose nodes come later
        launch.prepare([dataclasses.replace(SPEC, name=f'm{number}')], {
            f'm{number}': [NodeSpec(f'n{n}', 'n', 'demo', 'talker') for n in range(count)]})
    assert [event.text.partition(' run more than 10')[0] for event in events
            if isinstance(event, Warned) and 'discover' in event.text] == crowded


@pytest.mark.parametrize(('dds', 'environment', 'drops'), [
    ('fastdds', {}, True), ('fastdds', {'ROS_DOMAIN_ID': '5'}, True),
    ('fastdds', {'ROS_DOMAIN_ID': '3'}, False), ('fastdds', {'ROS_DOMAIN_ID': '03'}, False),
    ('fastdds', {'ROS_DOMAIN_ID': 'x'}, False), ('zenoh', {'ROS_DOMAIN_ID': '5'}, False)])
def test_filter_drops_dds_of_other_domains(launch, monkeypatch, dds, environment, drops):
    monkeypatch.setattr(plan, 'check_rmw', lambda *_: None)
    launch.user_environment['ROS_DOMAIN_ID'] = '3'
    launch.use_dds(dds)
    assert launch.drops(environment) == drops


def test_launch_without_a_port_for_a_daemon_of_ros2_begins(launch, monkeypatch):
    def none(folder):
        raise PrerequisiteError('no TCP port is free')

    monkeypatch.setattr(ros2_daemon, 'programs', none)
    assert launch.programs() is None


class Offers(FakeProvider):
    """A provider that stands for the other one."""

    name = 'offers'
    capabilities = Capabilities(shell_kind='local', places=True)

    def places(self, spec):
        return [('fake', dataclasses.replace(spec, provider='fake'))]


@pytest.mark.parametrize('owned', [True, False])
@pytest.mark.parametrize('name', ['fake', 'offers'])
def test_machine_that_cannot_be_stopped_is_refused(launch, checked, monkeypatch, owned, name):
    instead(monkeypatch, 'fogros2.provider', {'fake': lambda: checked, 'offers': Offers})
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(owned=owned, stop=False))
    monkeypatch.setattr(deployed, 'check_robot', lambda: None)
    spec = dataclasses.replace(SPEC, provider=name, on_exit='stop')
    with pytest.raises(ConfigurationError, match="'fake' can't stop 'planner'"):
        launch.check_here([spec])
        launch.prepare([spec])
    assert checked.calls == []


def test_provider_of_another_name_is_refused(launch, monkeypatch):
    """Nobody would find its machines."""
    instead(monkeypatch, 'fogros2.provider', {'my_fake': FakeProvider})
    with pytest.raises(ConfigurationError, match="FakeProvider has the name 'fake'"):
        launch.check_here([dataclasses.replace(SPEC, provider='my_fake')])


def test_first_problem_ends_the_early_checks(launch, checked, monkeypatch):
    """A check that is slow does not hold the launch."""
    monkeypatch.setattr(deployed, '_QUICK', 60.0)
    let_go = threading.Event()

    def check(spec):
        if spec.name == 'planner':
            let_go.wait(60.0)
        raise PrerequisiteError(f'{spec.name} lacks a host')

    monkeypatch.setattr(checked, 'check', check)
    with pytest.raises(PrerequisiteError, match='slam lacks a host'):
        launch.check_here([SPEC, dataclasses.replace(SPEC, name='slam')])
    monkeypatch.setattr(deployed, '_QUICK', 0.05)
    launch.check_here([SPEC])
    let_go.set()


def test_machine_is_deleted_if_its_id_cannot_be_stored(
        launch, provider, monkeypatch):
    save = Store.save

    def full(self, record):
        if record.machine_id is not None:
            raise StoreError('record.json can not be written: No space left on device')
        save(self, record)

    monkeypatch.setattr(Store, 'save', full)
    with pytest.raises(StoreError):
        launch.up(SPEC)
    assert list(provider.find({})) == []


def test_machine_without_a_connection_is_deleted(launch, provider, monkeypatch):
    def fail(connection):
        raise ConnectError('no SSH server')

    monkeypatch.setattr(Connection, 'open', fail)
    with pytest.raises(ConnectError, match='no SSH server'):
        launch.up(dataclasses.replace(SPEC, on_exit='keep'))
    assert list(provider.find({})) == [] and not launch.store.exists(SPEC.name)


def joined(launch, monkeypatch, name, network):
    """Return a machine of another robot, in the VPN with a network."""
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(launch.store.root))
    return MachineSpec(name, 'joined', {'invitation': invitation.seal(invitation.Invitation(
        'planner', 'nLDHqcSHfnzLjlrO6PdzdSUWfvrWqPqRUQgyn6lKsjw=', network.replace('.0/24', '.2'),
        '203.0.113.9:50000', network.replace('.0/24', '.224'), network, 'rmw_fastrtps_cpp', 3,
        time.time() + 600, 'foga1b2c3m0', '5a' * 32),
        invitation.public_text(invitation.own_key(launch.store)))})


def test_launch_s_network_differs_from_one_that_it_joins(launch, monkeypatch):
    own = addresses.choose_subnet([], launch_id=launch.id)
    monkeypatch.setattr(addresses, 'parse_used', lambda output: [])
    launch.check_here([joined(launch, monkeypatch, 'planner', own)])
    assert launch.robot_vpn().interface.network != own


def test_robot_s_nodes_may_send_to_machines_that_it_joins(launch, monkeypatch):
    """Its filter would drop what they send to a machine that has not sent to them before."""
    filters = []

    class Filtered(FakeVpn):
        def __init__(self, ports=(), asked=()):
            self.asked = asked

        def up(self, interface, peers):
            filters.append(self.asked)
            return super().up(interface, peers)

    instead(monkeypatch, 'fogros2.vpn', {'wireguard': Filtered})
    monkeypatch.setattr(JoinedProvider, 'join', lambda *_: contextlib.nullcontext())
    launch.user_environment['ROS_STATIC_PEERS'] = '192.0.2.7'
    early, late = (joined(launch, monkeypatch, name, f'198.18.{number}.0/24')
                   for name, number in (('early', 9), ('late', 8)))
    launch.check_here([early])
    launch.robot_vpn().ensure()
    known = ['192.0.2.7', '198.18.9.2', '239.18.9.2']
    assert filters == [known]
    for spec in (early, late, late):
        launch.join(spec)
    assert filters == [known, ['192.0.2.7', '198.18.9.2', '198.18.8.2', '239.18.9.2',
                               '239.18.8.2']]


def test_robot_asks_machines_and_names_its_middleware(launch, events, monkeypatch):
    monkeypatch.setattr(deployed, 'check_robot', lambda: None)
    launch.use_dds('fastdds')
    launch.expect(['first'])
    path = Path(launch.robot_environment()['FASTRTPS_DEFAULT_PROFILES_FILE'])
    network = launch.robot_vpn().interface.network.rpartition('.')[0].partition('.')[2]
    assert f'<address>239.{network}.2</address>' in path.read_text()
    assert f'<address>239.{network}.3</address>' not in path.read_text()
    # nodes that start from now on know the second, too
    launch.expect(['first', 'second'])
    assert f'<address>239.{network}.3</address>' in path.read_text()
    assert [one.detail for one in events
            if isinstance(one, StepDone) and one.step == 'middleware'] == ['rmw_fastrtps_cpp']


def test_launch_warns_of_a_firewall_that_drops_topics(launch, events, monkeypatch):
    trouble = 'the firewall refuses', 'allow in on fog+'
    monkeypatch.setattr(deployed, 'check_robot', lambda: None)
    monkeypatch.setattr(deployed, 'firewall_trouble', lambda: trouble)
    launch.robot_environment()
    assert events.count(Warned('', *trouble)) == 1


@pytest.mark.parametrize(('handshake', 'device', 'words'), [
    (0.0, '', 'is UDP port 51999 open'), (1.8e9, '', "a firewall of 'planner'"),
    (1.8e9, 'other', 'dev other .*: sudo ip rule add pref 100 to 198.18.0.0/15 lookup main')])
def test_cause_of_a_silent_vpn_depends_on_the_handshake(
        launch, provider, monkeypatch, handshake, device, words):
    context, mine = begun(launch)
    own = context.vpn.interface
    mine.interface = dataclasses.replace(own, address='198.18.7.2', port=51999)
    mine.record = dataclasses.replace(mine.record, public_key='KEY')
    counters = {'KEY': {'handshake': handshake}}
    monkeypatch.setattr(FakeVpn, 'parse_status', lambda vpn, text: counters)
    monkeypatch.setattr(arming, 'run', lambda commands, timeout:
                        f'198.18.7.2 dev {device or own.name} src {own.address}')
    assert re.search(words, Arming(context, mine)._cause())


def refusal():
    error = ProviderError('your token has expired')
    error.refused = True
    return error


def test_a_machine_that_may_have_been_made_is_not_forgotten(launch, provider):
    lost = ProviderError('the API server does not answer')
    provider.failures.update(create=lost, find=lost)
    with pytest.raises(ProviderError, match='does not answer'):
        launch.up(SPEC)
    assert launch.down() == [lost]
    assert launch.store.exists(SPEC.name)


@pytest.mark.parametrize(('error', 'appears', 'kept'), [
    (Cancelled('the request'), False, True),
    (DeadlineExceeded('no answer for 30 s'), False, True),
    (Cancelled('the request'), True, False),
    (ProviderError('the answer was lost'), True, False),
    (refusal(), False, False)])
def test_request_without_an_answer_is_kept(launch, provider, monkeypatch, error, appears, kept):
    create = provider.create

    def cut(spec, request):
        if appears:
            create(spec, request)
        raise error

    monkeypatch.setattr(provider, 'create', cut)
    with pytest.raises(type(error)):
        launch.up(SPEC)
    assert ('find' in provider.calls) != (error.refused is True)
    assert list(provider.find({})) == [] and not launch.store.exists(SPEC.name)
    requests = [record for record, _ in launch.store.requests()]
    assert [record.last for record in requests] == [launch.id] * kept
    errors = launch.down()
    assert [f"'{SPEC.name}' may still appear" in str(error) for error in errors] == [True] * kept


@pytest.mark.parametrize('ended', [False, True])
def test_launch_deletes_what_it_could_not_delete_before(launch, provider, ended):
    """Such as before it creates a machine anew."""
    for error in ConnectError('no network'), None:
        context, mine = begun(launch, dataclasses.replace(SPEC, on_exit='keep'))
        Creation(context, mine).run()
        if error is not None:
            provider.failures['destroy'] = error
            mine.close()
            assert launch.store.load('planner').spec.on_exit == 'delete'
            if ended:
                provider.machines.clear()
    assert [*provider.machines] == [mine.machine_id]


def test_launch_deletes_its_machine_that_appears_late(launch, provider, monkeypatch):
    requests, create = [], provider.create

    def cut(*request):
        requests.append(request)
        raise Cancelled('the request')

    monkeypatch.setattr(provider, 'create', cut)
    context, mine = begun(launch)
    with pytest.raises(Cancelled):
        Creation(context, mine).run()
    mine.close()
    create(*requests[0])
    monkeypatch.setattr(provider, 'create', create)
    context, mine = begun(launch)
    Creation(context, mine).run()
    assert [*provider.machines] == [mine.machine_id] and launch.store.requests() == []


def test_next_launch_keeps_the_request_of_a_killed_one(launch, provider):
    killed, job = begun(launch)
    with launch.store.lock(SPEC.name):
        Creation(killed, job)._claim('token')
    launch.store.save(dataclasses.replace(
        launch.store.load(SPEC.name), launch='abc123', last='abc123', pid=0))
    provider.failures.update(create=ProviderError('no more'))
    with pytest.raises(ProviderError, match='no more'):
        launch.up(SPEC)
    ((record, age),) = launch.store.requests()
    assert (record.token, record.last, record.name) == ('token', 'abc123', SPEC.name)
    assert age < 60.0 and not launch.store.exists(SPEC.name)
    launch.store.answered(record)
    assert launch.store.requests() == []


def kept(store, provider):
    """Leave a machine behind, as a launch does that keeps it."""
    spec = MachineSpec('planner', 'fake', on_exit='keep', options={'size': 1})
    launch = Launch(store=store, environment={})
    with store.lock('planner'):
        context, mine = begun(launch, spec)
        Creation(context, mine)._claim('token')
        machine = Machine('fake-1', 'planner', 'fake', MachineState.PENDING, tags={
            'fogros2-on-exit': 'keep'})
        provider.machines['fake-1'], provider._waits['fake-1'] = machine, 0
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
    assert launch.store.load('planner').machine_id == 'fake-1'


@pytest.fixture
def killed(launch, provider):
    """Return a function that runs steps of a new launch on a machine, and kills the launch."""
    def run(*steps):
        context, mine = begun(Launch(store=launch.store, environment={}))
        with launch.store.lock(SPEC.name):
            Creation(context, mine).run()
            for step in steps:
                step(context, mine)
        launch.store.save(dataclasses.replace(launch.store.load(SPEC.name), pid=0))
        return mine

    return run


@pytest.mark.parametrize(('program', 'owned', 'requests'), [
    (agent_program(), True, ['configure']),
    # another robot's machine keeps its agent
    ('older', False, ['configure']),
    ('older', True, ['configure', 'release', 'status', 'configure'])])
def test_kept_machine_gets_the_agent_of_this_robot(monkeypatch, killed, program, owned, requests):
    source, asked, shells = agent_program(), [], []
    digest = hashlib.sha256(program.encode()).hexdigest()

    class Agent:
        def __init__(self, *_, **__):
            self.close = lambda: None

        def request(self, command, **_):
            asked.append(command)
            return {'pid': 4711}

    def arm(context, mine):
        mine.shell = FakeShell(handlers={
            'sha256sum': lambda command: Result(0, f'{digest}  {command.argv[1]}\n', ''),
            'sh': lambda command: Result(0, '', '')})
        shells.append(mine.shell)
        Arming(context, mine).arm()
        mine.rearming.close()

    monkeypatch.setattr(arming, 'AgentClient', Agent)
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(
        agent_program='/agent.py', owned=owned))
    killed(arm)
    killed(arm)
    first, later = shells
    assert asked == ['configure', *requests] and first.commands == []
    assert [(command.argv[4:], command.input) for command in later.commands[1:]] == [
        (('/agent.py', str(len(source)), '4711'), source.encode())] * (len(requests) > 1)


def test_machine_is_taken_over_after_several_killed_launches(provider, monkeypatch, killed):
    owners, lost = [''], [False, True, False]

    class Agent:
        def __init__(self, *_, **__):
            self.close = lambda: None

        def request(self, command, *, timeout, launch, force, **_):
            if owners[-1] and force != owners[-1]:
                raise AgentError(f"this machine belongs to launch '{owners[-1]}'")
            owners.append(launch)
            if lost.pop(0):
                raise ConnectError('the reply was lost')
            return {}

    def arm(context, mine):
        mine.shell = FakeShell(handlers={'sh': lambda _: Result(0, 'there', '')})
        Arming(context, mine).arm()
        mine.rearming.close()

    def arm_in_vain(context, mine):
        with pytest.raises(ConnectError):
            arm(context, mine)

    monkeypatch.setattr(arming, 'AgentClient', Agent)
    for steps in ((arm,), (), (arm_in_vain,), ()):
        killed(*steps)
    record = killed(arm).record
    assert owners[-1] == record.last and record.owners == (record.last,)
    assert len({*owners}) == 4 and provider.calls.count('create') == 1


def test_adopted_machine_uses_the_port_that_was_opened(provider, monkeypatch, killed):
    create, ports = provider.create, []
    monkeypatch.setattr(provider, 'create', lambda spec, request: (
        ports.append(request.vpn_port), create(spec, request))[1])
    killed()
    mine = killed(lambda context, mine: Joining(context, mine).choose_interface())
    assert ports == [mine.interface.port]


@pytest.mark.parametrize('id_known', [True, False])
def test_what_a_machine_that_is_gone_left_is_deleted(launch, provider, monkeypatch, id_known):
    spec, told = kept(launch.store, provider), []
    provider.machines.clear()
    if not id_known:
        launch.store.save(dataclasses.replace(launch.store.load('planner'), machine_id=None))
    monkeypatch.setattr(provider, 'destroy', told.append)
    monkeypatch.setattr(provider, 'tidy', lambda dead: told.extend(dead) or [])
    provider.failures.update(create=ProviderError('no more'))
    with pytest.raises(ProviderError, match='no more'):
        launch.up(spec)
    assert told == (['fake-1'] if id_known else ['token'])


def skip_early_steps(monkeypatch):
    """Replace the steps before ROS 2 is installed."""
    for step, name in [(Creation, 'run'), (Connection, 'open'), (Joining, 'choose_interface'),
                       (Joining, 'avoid'), (Arming, 'arm')]:
        monkeypatch.setattr(step, name, lambda self, *_: None)
    monkeypatch.setattr(dds, 'configure', lambda *_: {})


@pytest.mark.parametrize('step', ['join', 'feature'])
def test_a_step_that_fails_ends_those_beside_it(launch, provider, monkeypatch, step):
    syncing = threading.Event()

    def fail(*_):
        assert syncing.wait(60)
        raise VpnError('no way there')

    class Busy(Feature):
        always = True
        installing = fail

    def send(context, job, *_):
        syncing.set()
        wait_until(lambda: False, timeout=60, cancel=job.cancel, what='the workspace')

    skip_early_steps(monkeypatch)
    monkeypatch.setattr(installing, 'install_ros', lambda *_: RosInstall('ros'))
    monkeypatch.setattr(Joining, 'join', fail if step == 'join' else lambda self: None)
    instead(monkeypatch, 'fogros2.feature', {'busy': Busy} if step == 'feature' else {})
    monkeypatch.setattr(installing, 'send_workspaces', send)
    begin = time.monotonic()
    with pytest.raises(VpnError, match='no way there'):
        launch.up(SPEC)
    assert time.monotonic() - begin < 45
    assert not launch.cancel.is_set(), 'other machines of the launch go on'


@pytest.fixture
def mute():
    """Return the port of a server that takes connections and never says a word."""
    with socket.create_server(('127.0.0.1', 0), backlog=16) as server:
        yield server.getsockname()[1]


def reach(launch, port):
    context, mine = begun(launch, MachineSpec('planner', 'ssh'))
    mine.machine = Machine(
        'x', 'planner', 'ssh', MachineState.RUNNING, owned=False, endpoint=Endpoint(
            'ssh', '127.0.0.1', port, 'fog', host_key='ssh-ed25519 AAAA', key_file='/nowhere'))
    with mine.undo:
        Connection(context, mine).open()


def test_a_login_that_nobody_answers_can_be_cancelled(launch, provider, monkeypatch, mute):
    monkeypatch.setattr(connecting, 'LOGIN_TIMEOUT', 0.5)
    timer = threading.Timer(0.2, launch.cancel.set)
    timer.start()
    begin = time.monotonic()
    with pytest.raises(Cancelled):
        reach(launch, mute)
    assert time.monotonic() - begin < 45
    timer.join()


@pytest.fixture
def closed_port():
    """Return a port that refuses connections, and that no other program can take."""
    with socket.socket() as taken:
        taken.bind(('127.0.0.1', 0))
        yield taken.getsockname()[1]


@pytest.mark.parametrize('ended', [True, False])
def test_wait_ends_when_a_booting_machine_ends(
        launch, provider, monkeypatch, ended, closed_port):
    monkeypatch.setattr(connecting, 'POLL_INTERVAL', 0.1)
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(firewall=True))
    context, mine = begun(launch, timeouts=Timeouts(ssh=60.0 if ended else 0.8))
    Creation(context, mine).run()
    mine.machine = dataclasses.replace(provider.describe(mine.machine_id), endpoint=Endpoint(
        'ssh', '127.0.0.1', closed_port, 'fog', host_key='ssh-ed25519 AAAA', key_file='/nowhere'))
    if ended:
        provider.destroy(mine.machine_id)
    known = (ProviderError, 'ended while') if ended else (ConnectError, 'refuses connections')
    with mine.undo, pytest.raises(known[0], match=known[1]):
        Connection(context, mine).open()


def test_ssh_port_stays_closed_after_the_launch_has_left(launch, provider, monkeypatch):
    """A feature may just be about to open it."""
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(firewall=True))
    monkeypatch.setattr(provider, 'robot_address', lambda: '198.51.100.7/32', raising=False)
    allowed = []
    monkeypatch.setattr(provider, 'allow', lambda *words: allowed.append(words[1:]),
                        raising=False)
    context, mine = begun(launch)
    Creation(context, mine).run()
    mine.save(endpoint=FAKE_ENDPOINT, carried='stream')
    connection = Connection(context, mine)
    connection.enter_vpn()
    assert connection.open_outside() == FAKE_ENDPOINT
    assert allowed == [(FAKE_ENDPOINT.port, ['198.51.100.7/32'])]
    assert launch.store.load('planner').made[-1].kind == undo.SSH_PORT
    mine.undo.close()
    allowed.clear()
    with pytest.raises(Cancelled):
        connection.open_outside()
    # nor a login that is still under way
    monkeypatch.setattr(connecting, 'POLL_INTERVAL', 0.0)
    monkeypatch.setattr(provider, 'robot_address', lambda: '198.51.100.8/32')
    monkeypatch.setattr(provider, 'describe', lambda _: Machine(
        '', '', '', MachineState.RUNNING))
    connection._check()
    assert allowed == []


def test_a_machine_that_boots_slowly_has_the_time_of_its_boot(launch, provider, monkeypatch):
    context, mine = begun(launch, timeouts=Timeouts(boot=300.0, ssh=60.0))
    connection = Connection(context, mine)
    mine.claimed = time.monotonic() - 20
    mine.record = dataclasses.replace(mine.record, armed=1.0)  # the clock was wrong then
    assert connection._timeout() == 60.0
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(one_time_host_key=True))
    assert 270 < connection._timeout() <= 280
    mine.record = dataclasses.replace(mine.record, host_key='its own')
    assert connection._timeout() == 60.0
    mine.enter('up')
    assert connection._timeout() == connecting.LOGIN_TIMEOUT


def test_repair_that_keeps_failing_is_reported_once(launch, events, monkeypatch):
    failures = [FogError('no')] * 4 + [FogError('busy')]
    answers = [False, False]

    def run(command, **arguments):
        if command.what == 'health check':
            if answers:
                answers.pop()
                raise DeadlineExceeded('it took longer than 30 s')
            return Result(1, '', '')
        if failures:
            raise failures.pop()
        return Result(0, '', '')

    robot = launch.robot_vpn()
    monkeypatch.setattr(process, 'run', run)
    assert [robot.check_health() for _ in range(9)] == [
        2.0, 4.0, 8.0, 15.0, 15.0, 15.0, 15.0, 1.0, 1.0]
    assert [event.reason for event in events if isinstance(event, StepFailed)] == ['busy', 'no']
    failures.append(FogError('no'))
    robot.check_health()
    assert isinstance(events[-1], StepFailed)


@pytest.mark.parametrize('refused', [False, True])
def test_launch_folder_stays_as_long_as_the_interface(launch, monkeypatch, refused):
    """Such as where sudo wants a password again."""
    down = Command(('false' if refused else 'true',), what='take it down')
    monkeypatch.setattr(FakeVpn, 'down', lambda self, interface: iter([down]))
    launch.robot_vpn().ensure()
    folder = launch.store.launch_folder(launch.id)
    assert len(launch.down()) == refused
    assert folder.exists() == refused
    # what gc sees when this process has gone
    monkeypatch.setattr(endings, 'launch_process', lambda folder: (1, False))
    assert [one.name for one in endings.leftovers(launch.store)] == [launch.id] * refused


def test_user_is_warned_each_time_sudo_wants_a_password(launch, events, monkeypatch):
    robot = launch.robot_vpn()
    for granted in (True, False, False, True, False):
        monkeypatch.setattr(process, 'sudo_trouble',
                            lambda granted=granted: None if granted else process.PASSWORD)
        robot._refresh_ticket()
    assert [event.fatal for event in events if isinstance(event, StepFailed)] == [False, False]


@pytest.mark.parametrize('error', [DeadlineExceeded('10 s'), PrerequisiteError('no memory')])
def test_sudo_that_fails_once_ends_no_health_check(launch, events, monkeypatch, error):
    robot = launch.robot_vpn()
    robot.ensure()

    def slow():
        raise error

    looked = []
    monkeypatch.setattr(process, 'sudo_trouble', slow)
    monkeypatch.setattr(process, 'run', lambda *_, **__: looked.append(1) or Result(0, '', ''))
    robot._ticket, robot._ticket_refreshed = True, -1e9
    assert robot.check_health() == robot_vpn.POLL_INTERVAL and looked == [1, 1]
    assert not [event for event in events if isinstance(event, StepFailed)]


@pytest.mark.parametrize(('helped', 'ticket', 'repaired'), [
    (False, True, True), (True, False, True), (False, False, False)])
def test_lost_filter_of_the_robot_is_repaired(launch, monkeypatch, helped, ticket, repaired):
    """Somebody has run ``nft flush ruleset``; only root, or the helper for it, can see that."""
    calls = []

    def run(command, **arguments):
        calls.append(command.what)
        return Result(int(command.what == 'status'), '', 'the packet filter is missing')

    robot = launch.robot_vpn()
    monkeypatch.setattr(process, 'run', run)
    monkeypatch.setattr(process, 'sudo_trouble', lambda: None if ticket else process.PASSWORD)
    robot.helped, robot._ticket = helped, not helped
    robot.check_health()
    assert 'repair' not in calls, 'not at each look'
    robot._ticket_refreshed = -1e9
    robot.check_health()
    assert ('repair' in calls) == ('status' in calls) == repaired


def test_interface_does_not_come_up_after_the_end(launch, monkeypatch):
    robot = launch.robot_vpn()
    robot.ensure()
    launch.undo.close()
    monkeypatch.setattr(process, 'run', None)
    with pytest.raises(Cancelled):
        robot.ensure()


@pytest.mark.parametrize('killed', [False, True])
def test_router_of_the_robot_runs_again_until_its_launch_ends(tmp_path, monkeypatch, killed):
    monkeypatch.setattr(robot_router, 'PAUSE', 0.01)
    program = tmp_path / 'lib/pack/router'
    program.parent.mkdir(parents=True)
    program.write_text('#!/bin/sh\necho $$ $ZENOH_CONFIG_OVERRIDE$SETTINGS; exec sleep 60\n')
    program.chmod(0o755)
    pipes, pipe = [], os.pipe
    monkeypatch.setattr(os, 'pipe', lambda: pipes.append(pipe()) or pipes[-1])
    end = robot_router.run(
        Router('pack', 'router', 'SETTINGS', 'text'), tmp_path,
        {**os.environ, 'AMENT_PREFIX_PATH': str(tmp_path), 'ZENOH_CONFIG_OVERRIDE': 'of-nodes:'})

    def started(times):
        lines = [line.split() for line in (tmp_path / 'router.log').read_text().splitlines()]
        starts = [words for words in lines if words[-1].endswith('router.json5')]
        return len(starts) >= times and starts[-1]

    pid, config = wait_until(lambda: started(1), timeout=60, what='the router')
    assert Path(config).read_text() == 'text'
    os.kill(int(pid), signal.SIGKILL)
    again, _ = wait_until(lambda: started(2), timeout=60, what='its restart')
    if killed:
        os.close(pipes[0][1])
    else:
        end()
    wait_until(lambda: process_start(int(again)) is None, timeout=60, what='its end')


def test_known_errors_are_reported_before_unknown_ones(launch, events):
    gone = []
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
    assert [(step.machine, step.reason) for step in events] == [('b', 'still there')]
    assert gone == ['interface']


class Members:
    """Machines of a VPN whose commands a test answers."""

    def __init__(self, robot):
        self.robot = robot
        self.away = set()
        self.told = []
        self.watched = []

    def add(self, number):
        name = f'm{number}'
        route = plan.Route(Peer(name, f'key {name}', f'198.18.7.{number}', f'{name}:1'))

        def run(commands):
            for command in commands:
                if name in self.away:
                    raise ConnectError(f"'{name}' is out of reach")
                self.told.append((name, [*command.argv[1:]]))
            return ''

        member = VpnMember(route, self.robot.interface, run, lambda peers: self.watched.append(
            (name, [peer.name for peer in peers])))
        member.up(self.robot)
        self.robot.admit(member)
        self.robot.spread(member)
        return member


@pytest.fixture
def members(launch):
    return Members(launch.robot_vpn())


def test_everybody_knows_of_a_new_machine_when_it_is_up(members, monkeypatch):
    monkeypatch.setattr(robot_vpn, 'UPDATE_TIMEOUT', 0.2)
    members.add(2)
    members.away = {'m2'}
    members.add(3)
    assert members.told[-1] == ('m3', ['m2', 'robot'])
    members.away = set()
    wait_until(lambda: ('m2', ['m3', 'robot']) in members.told, timeout=60,
               what='an update of the first machine')
    monkeypatch.setattr(robot_vpn, 'UPDATE_TIMEOUT', 60.0)
    members.add(4)
    assert members.told[-2:] in (
        [('m2', ['m3', 'm4', 'robot']), ('m3', ['m2', 'm4', 'robot'])],
        [('m3', ['m2', 'm4', 'robot']), ('m2', ['m3', 'm4', 'robot'])])


def test_agent_that_was_started_again_checks_the_vpn_again(members):
    member = members.add(2)
    assert members.watched == [('m2', ['robot'])]
    member.update(members.robot)
    assert len(members.watched) == 1
    member.restore(members.robot)
    assert members.watched == [('m2', ['robot'])] * 2


def test_agent_that_was_started_again_gets_router_and_watches(launch, provider):
    context, mine = begun(launch, dds=Zenoh())
    mine.interface = plan.machine_interface(launch.id, '198.18.7.0/24', 0, 50_000, '/key')
    requests, steps = [], []
    mine.agent = SimpleNamespace(
        request=lambda command, **words: requests.append((command, words)))
    mine.watch('idle', ['look'], 5.0, print)
    before = list(requests)
    mine.restoring = [lambda: steps.append('VPN'), lambda: dds.start_router(context, mine)]
    mine.restore()
    assert steps == ['VPN']
    assert [command for command, _ in requests] == ['watch', 'start', 'watch']
    assert requests[1][1]['nodes'][0].executable == 'rmw_zenohd'
    assert requests[2:] == before


def test_nodes_start_in_requests_that_the_agent_can_take(launch, provider, monkeypatch):
    _, mine = begun(launch)
    monkeypatch.setattr('fogros2.feature.used', lambda spec: ())
    requests = []
    mine.modules = SimpleNamespace(fitted=list)
    mine.agent = SimpleNamespace(
        request=lambda command, nodes: requests.append([node.name for node in nodes]))

    def node(name, size):
        return NodeSpec(f'{name}.1', name, files={'large.yaml': 'x' * size})
    mine.start([node('a', 9_000_000), node('b', 7_000_000), node('c', 2_000_000), node('d', 0)])
    assert requests == [['a', 'b'], ['c', 'd']]
    with pytest.raises(AgentError, match=r"'e' can't be sent: .* it has 170003\d\d bytes"):
        mine.start([node('a', 0), node('e', 17_000_000)])
    assert len(requests) == 2


def test_agent_that_was_started_again_watches_for_the_notice(launch, provider, monkeypatch):
    context, mine = begun(launch)
    requests = []
    mine.agent = SimpleNamespace(
        request=lambda command, **words: requests.append((command, words)))
    monkeypatch.setattr(provider, 'capabilities_of', lambda machine: dataclasses.replace(
        provider.capabilities, preemption_notice=('look',)))
    mine.machine = Machine('i-1', 'planner', 'fake', MachineState.RUNNING)
    mine.restart_lifetime(100.0)
    boot, suspended = time.clock_gettime, 30.0
    monkeypatch.setattr(time, 'clock_gettime', lambda clock: boot(clock) + suspended)
    Arming(context, mine).watch_notice()
    ((command, words),) = requests
    assert command == 'configure' and words['again'] and words['notice'] == ['look']
    # its lifetime goes on, also while the robot is suspended
    assert 60.0 < words['lifetime'] <= 70.0


def test_robot_alone_uses_a_relay(members, monkeypatch):
    dialled = []
    peers = FakeVpn.peers

    def recorded(self, interface, to):
        dialled.append([peer.endpoint for peer in to])
        return peers(self, interface, to)

    first = members.add(2)
    monkeypatch.setattr(FakeVpn, 'peers', recorded)
    members.robot.dial(first, '127.0.0.1:4', anew=True)
    # without the machine, its handshake begins again at once
    assert dialled == [[], ['127.0.0.1:4']]
    second = members.add(3)
    assert dialled[2] == ['127.0.0.1:4', 'm3:1']
    assert [peer.endpoint for peer in members.robot.peers_of(second)] == [None, 'm2:1']
    members.robot.dial(first, '', anew=False)
    assert dialled[-1] == ['m2:1', 'm3:1']
    members.robot.remove('m2')
    before = len(dialled)
    members.robot.dial(first, '127.0.0.1:5', anew=False)
    assert len(dialled) == before


def test_port_without_ssh_is_reported_soon(launch, provider, monkeypatch):
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(owned=False))
    monkeypatch.setattr(connecting, 'LOGIN_TIMEOUT', 0.5)
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
        assert time.monotonic() - begin < 45
        server.shutdown(socket.SHUT_RDWR)
        thread.join(60)


def test_a_host_key_is_taken_from_what_the_machine_prints():
    assert host_key.parse('motd\nssh-ed25519 AAAA+/x== planner\n') == 'ssh-ed25519 AAAA+/x=='
    for text in ('', 'ssh-rsa AAAA x', 'ssh-ed25519 $(id)'):
        with pytest.raises(HostKeyError, match='returned no host key'):
            host_key.parse(text)


def test_machine_keeps_a_network_that_overlaps_the_vpn(launch, provider):
    context, mine = begun(launch)
    joining = Joining(context, mine)
    joining.choose_interface()
    plain = mine.interface
    joining.avoid(HostFacts(routes=('10.0.0.0/8', '172.17.0.0/16')))
    assert mine.interface == plain
    joining.avoid(HostFacts(routes=('10.0.0.0/8', plain.network)))
    assert mine.interface.host_routes and launch.store.load('planner').vpn == mine.interface


def test_two_machines_of_a_launch_are_two_computers(launch, provider):
    """Both interfaces would have one port and one subnet."""
    first, second = (Joining(*begun(launch, dataclasses.replace(SPEC, name=name)))
                     for name in ('planner', 'mapper'))
    for joining in (first, second):
        joining.choose_interface()
        joining.avoid(HostFacts())  # one without /proc
    lab = HostFacts(network='6f2c1f5e net:[4026531840]')
    for _ in range(2):  # it is replaced
        first.avoid(lab)
    second.avoid(HostFacts(network='6f2c1f5e net:[4026532312]'))  # a container there
    with pytest.raises(ConfigurationError, match="'mapper' and 'planner' are one computer.*"
                                                 'use one machine for both'):
        second.avoid(lab)
    launch.robot_vpn().remove('planner')
    second.avoid(lab)


@pytest.mark.parametrize(('report', 'order'), [
    ({'vpn_host': '198.51.100.2'}, ['machine', 'robot']),
    ({'robot_host': '192.0.2.7'}, ['robot', 'machine'])])
def test_end_that_is_dialled_knows_its_peer_first(launch, provider, monkeypatch, report, order):
    """A handshake that comes before is nobody's, and the next one comes after 5 s."""
    context, mine = begun(launch)
    mine.machine = Machine('id', 'planner', 'fake', MachineState.RUNNING, **report)
    mine.shell = FakeShell()
    configured = []
    monkeypatch.setattr(VpnMember, 'up', lambda *_: configured.append('machine'))
    monkeypatch.setattr(robot_vpn.RobotVpn, 'admit', lambda *_: configured.append('robot'))
    monkeypatch.setattr(robot_vpn.RobotVpn, 'spread', lambda *_: None)
    joining = Joining(context, mine)
    joining.choose_interface()
    joining.join()
    assert configured == order


@pytest.mark.parametrize('there', [True, False])
def test_connection_that_breaks_at_the_end_is_opened_again(launch, provider, there):
    ran = []

    def run(command, **_):
        ran.append(command.argv[0])
        if len(ran) == 1 or not there:
            raise ConnectError('the connection was lost')
        return Result(0, '', '')

    _, mine = begun(launch)
    mine.shell = SimpleNamespace(run=run)
    mine.probes = [lambda seconds: None]
    mine.timeout(30.0)
    mine.probes = [lambda seconds: run(Command(('true',)))]
    if there:
        mine.clean_up([Command(('remove',))])
        assert ran == ['remove', 'true', 'remove']
    else:
        with pytest.raises(ConnectError):
            mine.clean_up([Command(('remove',))])
        assert ran == ['remove', 'true'] and mine.timeout(30.0) < 30.0


def test_failing_watch_is_reported_and_becomes_a_fault(launch, provider, monkeypatch):
    heard = []
    context, mine = begun(launch, report=heard.append)
    mine.agent, mine.heartbeat = SimpleNamespace(silent_for=60.0), SimpleNamespace(age=60.0)
    mine.record = dataclasses.replace(mine.record, machine_id='fake-1')

    def fail(machine_id):
        raise KeyError('Reservations')

    monkeypatch.setattr(provider, 'describe', fail)
    monkeypatch.setattr(watching, 'Periodic',
                        lambda name, interval, work, **stop: Periodic(
                            name, 0.01, work, **stop))
    watch = Watch(context, mine, over=print, found=print)
    failed = wait_until(
        lambda: [event for event in heard if isinstance(event, StepFailed)] or None,
        timeout=60, what='a word of it')
    assert "KeyError: 'Reservations'" in failed[0].reason and failed[0].machine == 'planner'
    with pytest.raises(KeyError):
        watch.close()
    watch.close()


@pytest.mark.parametrize('announced', [False, True])
def test_silence_after_the_announced_end_is_not_reported(
        launch, provider, monkeypatch, announced):
    heard = []
    context, mine = begun(launch, report=heard.append)
    mine.heartbeat, mine.announced = SimpleNamespace(age=10.0), announced
    monkeypatch.setattr(watching, 'Periodic', lambda *words, **named: None)
    Watch(context, mine, over=print, found=print)._look()
    assert [isinstance(event, Silence) for event in heard] == [True] * (not announced)


class Cut:
    """The agent and the heartbeats of a machine; the link is cut at a time."""

    def __init__(self):
        self.cut_at = None
        self.asked = []
        self.closed = False

    @property
    def age(self):
        return 0.0 if self.cut_at is None else time.monotonic() - self.cut_at

    silent_for = age

    def request(self, command, **arguments):
        self.asked.append(command)

    def subscribe(self, callback, since):
        pass

    def close(self):
        self.closed = True


@pytest.fixture
def cut(request, launch, provider, monkeypatch):
    """Return a running machine's link, what the launch reports, and what a session gets."""
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(
        owned=getattr(request, 'param', True)))
    reported, events = [], []
    provider.machines['fake-1'] = Machine('fake-1', 'planner', 'fake', MachineState.RUNNING)
    _, mine = begun(launch, report=reported.append)
    mine.agent = mine.heartbeat = link = Cut()
    mine.record = dataclasses.replace(mine.record, machine_id='fake-1')
    mine.begin()
    mine.subscribe(events.append)
    yield link, reported, events
    mine.close()


def test_silence_is_reported_and_its_end(cut, provider):
    link, reported, events = cut
    link.cut_at = time.monotonic() - 4.0  # some seconds ago
    wait_until(lambda: bool(reported), timeout=60, what='a report')
    link.cut_at = None
    wait_until(lambda: len(reported) > 1, timeout=60, what='the end')
    assert [(event.machine, event.over) for event in reported] == [
        ('planner', False), ('planner', True)]
    assert all(4.5 < event.seconds < 30 for event in reported) and events == []


def test_idle_machine_that_ends_already_is_left_to_its_steps(launch, provider):
    _, mine = begun(launch)
    reasons, subscribed, steps = [], [], []
    mine.agent = Cut()
    mine.agent.subscribe = lambda callback, since: subscribed.append(callback)
    mine.watch('idle', (), 1.0, reasons.append)
    mine.subscribe(reasons.append)
    mine.ending.set()
    subscribed[0]({'event': 'watched', 'what': 'idle', 'reason': 'nobody'})
    assert reasons == []
    fetches, fetched = threading.Event(), threading.Event()
    mine.undo.callback(steps.append, 'delete')
    mine.undo.callback(lambda: (fetches.set(), fetched.wait(60)))
    first = in_thread(mine.close)
    assert fetches.wait(60)
    second = in_thread(lambda: mine.end('idle'))
    wait([second], 0.2)
    assert steps == []
    fetched.set()
    for thread in (first, second):
        thread.result(60)
    assert steps == ['delete']


@pytest.mark.parametrize('error', [ShellError('no number'), KeyError('oops')])
def test_error_of_a_watch_is_reported_and_ends_no_other(launch, provider, events, error):
    def then(text):
        raise error

    _, mine = begun(launch)
    told, subscribed = [], []
    mine.agent = Cut()
    mine.agent.subscribe = lambda callback, since: subscribed.append(callback)
    mine.watch('mine', (), 1.0, then)
    mine.subscribe(told.append)
    subscribed[0]({'event': 'watched', 'what': 'mine', 'reason': 'x'})
    subscribed[0]({'event': 'exited', 'node': '1'})
    assert [event['event'] for event in told] == ['exited']
    assert [event.step for event in events if isinstance(event, StepFailed)] == ["watch 'mine'"]


def heard(*silences):
    """Return what is reported of silences: the seconds of each, and of the answers after it."""
    alarm, now, due = watching.SilenceAlarm(), 1000.0, []
    for seconds, answers in silences:
        for age in (tick / 5 for tick in range(int(5 * seconds) + 1)):
            due.append(alarm.due(age, now + age))
        now += seconds
        for tick in range(int(answers) + 1):
            due.append(alarm.due(0.5, now + tick))
        now += answers
    return [(round(one[0]), one[1]) for one in due if one is not None]


@pytest.mark.parametrize('silences, reported', [
    # on a busy computer, 46 of them came in 14 minutes
    ([(5.5, 12.0), (7.0, 13.0)] * 23, [(5, False), (5, True)]),
    ([(100.0, 5.0)], [
        (5, False), (10, False), (20, False), (40, False), (80, False), (100, True)]),
    ([(6.0, 5.0), (30.0, 5.0)], [
        (5, False), (6, True), (10, False), (20, False), (30, True)]),
    ([(6.0, watching.CALM + 9), (6.0, 9.0)], [(5, False), (6, True)] * 2)])
def test_silence_is_reported_by_its_duration(silences, reported):
    assert heard(*silences) == reported


@pytest.mark.parametrize('cut', [True, False], indirect=True)
def test_machine_without_any_word_is_lost(cut, provider, monkeypatch):
    """Its nodes stop there should it be back: they may run on the robot by then."""
    link, _, events = cut
    provider.failures.update(describe=ProviderError('no network'))
    monkeypatch.setattr(watching, 'POLL_INTERVAL', 60.0)
    monkeypatch.setattr(watching, 'LOSS', 5.5)
    link.cut_at = time.monotonic() - 4.0  # some seconds ago
    wait_until(lambda: link.closed, timeout=60, what='the verdict')
    assert [event['event'] for event in events] == ['lost']
    assert 'it is lost: no answer for ' in events[0]['reason'] and link.asked == ['stop']


@pytest.mark.parametrize('known, own, limit', [
    (True, {'on_interrupt': 'replace'}, 120.0), (False, {'on_interrupt': 'robot'}, 37.0),
    (True, {'on_interrupt': 'replace', 'on_loss_after': 300}, 300.0), (False, {}, 120.0)])
def test_silence_before_a_loss_depends_on_what_follows(
        launch, provider, known, own, limit):
    """A launch that would end, or replace it, waits as long as its nodes may run there."""
    provider.machines['fake-1'] = Machine('fake-1', 'planner', 'fake', MachineState.RUNNING)
    if not known:
        provider.failures.update(describe=ProviderError('no network'))
    context, mine = begun(launch)
    mine.record = dataclasses.replace(mine.record, machine_id='fake-1')
    mine.agent, mine.heartbeat = SimpleNamespace(silent_for=60.0), SimpleNamespace(age=limit)
    lost = []
    watch = Watch(context, mine, over=lambda *words: lost.append(words), found=print)
    with Replacement().machine(mine, Replacement.options(**own)):
        pass
    wait_until(lambda: provider.calls.count('describe') > 0, timeout=60, what='a question')
    if not known:
        watch._word_at = -math.inf
    watch._look()
    assert lost == []
    mine.heartbeat.age = limit + 0.1
    wait_until(lambda: lost or None, timeout=60, what='the verdict')
    assert lost == [('lost', f'it is lost: no answer for {limit:g} s'
                     + ('' if known else ', and no word of its provider'))]
    watch.close()


def test_retired_machine_is_deleted_and_created_anew(launch, provider, monkeypatch):
    ended = []

    def bring_up(context, spec):
        mine = RunningMachine(context, spec)
        mine.heartbeat = SimpleNamespace(age=0.0, close=lambda: ended.append('heartbeat'))
        mine.agent = SimpleNamespace(request=lambda *words, **named: None)
        Creation(context, mine)._claim('token')
        mine.save(machine_id=provider.create(spec, CreateRequest('t', '', {}, 1)))
        mine.begin()
        return mine

    monkeypatch.setattr(deployed, 'bring_up', bring_up)
    spec = dataclasses.replace(SPEC, on_exit='keep')
    first = launch.up(spec)
    provider.failures['destroy'] = ConnectError('no network')
    with pytest.raises(ConnectError):
        launch.retire('planner')
    assert launch.up(spec) is first and ended == ['heartbeat'], 'its nodes may still run'
    launch.retire('planner')
    assert provider.machines == {} and not launch.store.exists('planner')
    assert launch.up(spec) is not first
    launch.retire('planner')
    launch.retire('planner')


def test_undo_of_another_version_is_reported_others_are_done(launch, provider):
    context, mine = begun(launch)
    mine.shell = FakeShell(handlers={'sh': lambda command: Result(0, '', '')})
    with pytest.raises(StoreError, match="'balloon', which this version can't undo"):
        undo.unmake_all(mine, [Made(undo.WATCHDOG), Made('balloon')])
    assert mine.shell.commands


def test_what_could_not_be_undone_stays_in_the_record(launch, provider):
    context, mine = begun(launch, dataclasses.replace(SPEC, on_exit='keep'))
    mine.enter('up')
    ended = [1, 0]
    mine.shell = FakeShell(handlers={'sh': lambda c: Result(ended.pop(0), '', 'no')})
    with mine.undo:
        mine.push(undo.WATCHDOG, agent='/run/fogros2/planner')
    assert context.failures and mine.record.made == (Made(undo.WATCHDOG),)
    with mine.undo:
        mine.push(undo.WATCHDOG)
    assert mine.record.made == ()


def test_vpn_that_guests_keep_stays_in_the_record(launch, provider):
    context, mine = begun(launch, dataclasses.replace(SPEC, on_exit='keep'))
    joining = Joining(context, mine)
    joining.choose_interface()
    mine.enter('up')
    mine.released = True
    mine.shell = FakeShell(handlers={'true': lambda c: Result(0, f'{STAYS}\n', '')})
    with mine.undo:
        mine.push(undo.VPN)
    assert joining._former is None and mine.record.made == (Made(undo.VPN),)
    # the next launch needs its port
    joining.choose_interface()
    assert joining._former == mine.interface


def test_machine_that_its_provider_knows_is_not_lost(cut, provider, monkeypatch):
    link, _, events = cut
    monkeypatch.setattr(watching, 'LOSS', 5.5)
    monkeypatch.setattr(watching, 'POLL_INTERVAL', 0.2)
    link.cut_at = time.monotonic() - 4.0  # some seconds ago
    wait_until(lambda: provider.calls.count('describe') > 5 and link.age > 6.5, timeout=60,
               what='answers of the provider')
    assert events == []


def test_robot_port_that_is_taken_is_replaced_or_named(launch, monkeypatch):
    ports, free = [], [50_000]

    def up(self, interface, peers):
        ports.append(interface.port)
        if interface.port not in free:
            raise CommandError(
                Command(('true',)), Result(1, '', 'Address already in use'), 'this computer')
        return iter(())

    robot = launch.robot_vpn()
    monkeypatch.setattr(FakeVpn, 'up', up)
    monkeypatch.setattr(robot, '_choose_port', lambda: 50_000)
    robot._bring_up()
    assert len(ports) == 2 and ports[1] == robot.interface.port == 50_000
    free.clear()
    with pytest.raises(VpnError, match='in use already.*FOGROS2_VPN_PORT names another'):
        robot._bring_up()


@pytest.mark.parametrize(('on_exit', 'owned', 'hint'), [
    ('keep', True, 'ros2 fog delete planner'), ('delete', False, 'nothing needs to be done')])
def test_what_stays_on_a_machine_out_of_reach_is_told_once(
        launch, provider, monkeypatch, on_exit, owned, hint):
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(owned=owned))
    context, mine = begun(launch, dataclasses.replace(SPEC, on_exit=on_exit))
    mine.enter('kept')

    def silent(command):
        raise ConnectError("'planner' has not answered for 2 s")

    mine.shell = FakeShell(handlers={'ip': silent})
    mine.probes = [silent]
    with mine.undo:
        Creation(context, mine)._claim('token')
        for name in ('agent', 'VPN', 'nodes'):
            mine.undoing(name, lambda: mine.clean_up([Command(('ip', 'link'))]))
    told, = launch.down()
    assert 'stay there (nodes, VPN, agent)' in str(told) and hint in told.hint


def test_machine_that_vanishes_at_its_end_is_given_up():
    said = FakeStream()
    client = AgentClient(FakeShell(streams=[said]), '/run/x', agent_path='agent.py')
    begin = time.monotonic()
    with pytest.raises(DeadlineExceeded, match='sent nothing for 0.3 s'):
        client.request('release', timeout=30.0, silent=0.3)
    assert time.monotonic() - begin < 20
    client.close()


def test_a_machine_is_ended_while_another_still_comes_up(launch):
    ended = threading.Event()
    slow, fast = Future(), Future()
    launch._ups.update(slow=slow, fast=fast)
    fast.set_result(SimpleNamespace(close=ended.set))

    def fail():
        slow.set_exception(Cancelled() if ended.wait(60) else AssertionError('one by one'))

    thread = threading.Thread(target=fail)
    thread.start()
    assert launch.down() == []
    thread.join(60)
    assert isinstance(slow.exception(), Cancelled)


def test_vpn_goes_down_though_its_agent_fails(launch, provider):
    def refuse(*words, **named):
        raise AgentError('the agent is broken')

    context, mine = begun(launch, dataclasses.replace(SPEC, on_exit='keep'))
    Joining(context, mine).choose_interface()
    mine.enter('up')
    mine.agent = SimpleNamespace(request=refuse)
    mine.shell = FakeShell(handlers={'true': lambda c: Result(0, '', '')})
    with mine.undo:
        mine.push(undo.VPN)
    assert [str(failure) for failure in context.failures] == ['the agent is broken']
    assert [command.argv for command in mine.shell.commands] == [('true',)]

# SPDX-License-Identifier: Apache-2.0
"""Who may watch, by value: networks, what opens and closes a firewall, what the verbs say."""

from __future__ import annotations

import contextlib
import dataclasses
import http.client
import os
import socket
import threading
import time
from types import SimpleNamespace
import urllib.parse

from launch import LaunchContext
from launch.substitutions import TextSubstitution
import pytest

from fogros2 import ContainerInstance, Foxglove, ros_names
from fogros2.deploy import undo
from fogros2.deploy.steps.creating import Creation
from fogros2.errors import AgentError, ConfigurationError, ProviderError, Unsupported
from fogros2.model import Endpoint, Machine, MachineSpec, MachineState, VpnInterface
from fogros2.provider.kubernetes import manifests, ways
from fogros2.provider.kubernetes.names import MachineId
from fogros2.runtime import added_process
from fogros2.store import Made, Record, Store, this_process
from fogros2_monitor import access, action, addresses
from fogros2_monitor.browser import Ticket
from fogros2_monitor.feature import Monitor
from fogros2_testing.fakes import FakeProvider, FakeShell
from rigs import deploying
from ros2fog_cli.api.machines import Entry

SOURCES = ('198.51.100.0/28',)
NOTES = {'monitor': 'ws://198.18.7.2:8765', 'monitor_open': '198.51.100.9:8766'}
VPN = VpnInterface('fog1', '198.18.7.2', '198.18.7.0/24', 51820, '/key')


@pytest.mark.parametrize(('text', 'found'), [
    ('198.51.100.0/28', '198.51.100.0/28'), (' 198.51.100.7 ', '198.51.100.7/32'),
    ('2001:db8::1', '2001:db8::1/128')])
def test_networks_are_normalised(text, found):
    machine = ContainerInstance(name='a', monitor_allow=[text, TextSubstitution(text=text)])
    own = machine.spec(LaunchContext()).features['monitor']
    assert Monitor.options(**own) == (found, found)
    assert Monitor.options() is None and Monitor.options(launch_foxglove=True) == ()


@pytest.mark.parametrize(('given', 'said'), [
    (['198.51.100.7/28'], "write '198.51.100.0/28', or the address alone"),
    (['everybody'], "'everybody' is no network"),
    ('198.51.100.0/28', 'is no list'),
    ([''], "'' is no network")])
def test_invalid_network_is_refused_in_the_launch_file(given, said):
    for make in (lambda: ContainerInstance(name='a', monitor_allow=given),
                 lambda: Foxglove('a', monitor_allow=given)):
        with pytest.raises(ConfigurationError, match=said):
            make()


@pytest.mark.parametrize(('provider', 'given', 'said'), [
    ('hosted', {'monitor_allow': SOURCES}, "can't open a port of its host for monitor_allow"),
    ('joined', {'launch_foxglove': True}, "is another robot's, and serves no viewer"),
    ('joined', {'monitor_allow': SOURCES}, "is another robot's")])
def test_machine_that_cannot_serve_viewers_is_refused(provider, given, said):
    with pytest.raises(Unsupported, match=said):
        Monitor().check(MachineSpec('planner', provider), Monitor.options(**given))


def test_bridge_of_a_hosted_machine_is_for_its_robot():
    Monitor().check(MachineSpec('planner', 'hosted'), Monitor.options(launch_foxglove=True))
    Monitor().check(MachineSpec('planner', 'joined'), Monitor.options())


@pytest.fixture
def provider(monkeypatch):
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(firewall=True))
    return FakeProvider()


@pytest.mark.parametrize(
    ('on_exit', 'closed'), [('keep', True), ('stop', True), ('delete', False)])
def test_port_is_closed_at_the_end_of_the_launch(
        tmp_path, provider, on_exit, closed):
    _, running = deploying.job(
        tmp_path, MachineSpec('planner', 'fake', on_exit=on_exit), provider=provider)
    running.save(machine_id='fake-1')
    running.enter('up')
    running.machine = Machine(
        'fake-1', 'planner', 'fake', MachineState.RUNNING, vpn_host='198.51.100.9')
    assert running.open_port(8766, SOURCES) == ('198.51.100.9', 8766)
    assert provider.allowed == {('fake-1', 8766): list(SOURCES)}
    # the bridge was started again: nothing is opened twice
    assert running.open_port(8766, SOURCES) == ('198.51.100.9', 8766)
    assert provider.calls.count('allow') == 1
    running.close()
    assert provider.allowed == {('fake-1', 8766): [] if closed else list(SOURCES)}


def test_next_launch_closes_the_port_of_a_killed_one(
        tmp_path, provider):
    context, job = deploying.job(
        tmp_path, MachineSpec('planner', 'fake', on_exit='keep'), provider=provider)
    with context.store.lock('planner'):
        job.save(machine_id='fake-1', notes=NOTES,
                 made=(Made(undo.VPN), Made(undo.OPEN_PORT, 8766)))
        provider.machines['fake-1'] = machine = Machine(
            'fake-1', 'planner', 'fake', MachineState.RUNNING)
        Creation(context, job)._adopt(machine)
    assert provider.allowed == {('fake-1', 8766): []}
    after = context.store.load('planner')
    assert (after.notes, after.made) == ({}, (Made(undo.VPN),))


def entry(**changes):
    made = Record(
        'planner', 'fake', MachineSpec('planner', 'fake'), machine_id='fake-1', launch='abc123',
        vpn=VPN, notes=NOTES, agent='/run/fogros2', **this_process())
    return Entry('planner', 'fake', Machine(
        'fake-1', 'planner', 'fake', MachineState.RUNNING, endpoint=Endpoint('fake')),
        dataclasses.replace(made, **changes))


def test_monitor_address_is_shown_while_a_launch_serves_it():
    shown = entry().to_json()
    assert {key: shown[key] for key in NOTES} == NOTES
    for changes in ({'notes': {}}, {'pid': 0}):
        shown = entry(**changes).to_json()
        assert [shown[key] for key in NOTES] == [None, None]


@pytest.mark.parametrize(('changes', 'kind', 'said'), [
    ({'notes': {}}, ConfigurationError, 'has no Foxglove bridge'),
    ({'notes': {}, 'pid': 0}, AgentError, 'serves the topics'),
    ({'pid': 0}, AgentError, 'serves the topics'),
    ({'notes': {**NOTES, 'monitor_open': ''}}, ConfigurationError, 'only this robot')])
def test_share_of_a_closed_bridge_is_refused(changes, kind, said):
    with pytest.raises(kind, match=said):
        access.credentials_of(entry(**changes), FakeShell())


def test_browser_is_led_to_the_page_once_and_in_time(monkeypatch):
    with contextlib.closing(Ticket('http://localhost:1/?token=sesame')) as ticket:
        assert 'sesame' not in ticket.url
        place = urllib.parse.urlsplit(ticket.url)

        def ask(path: str) -> tuple[int, str]:
            with contextlib.closing(http.client.HTTPConnection(place.netloc)) as link:
                link.request('GET', path)
                answer = link.getresponse()
                return answer.status, answer.getheader('Location', '')

        assert ask('/') == (404, '')
        assert not ticket.used.is_set()
        assert ask(place.path) == (303, 'http://localhost:1/?token=sesame')
        assert ticket.used.is_set()
        assert ask(place.path) == (404, '')
    with contextlib.closing(Ticket('http://localhost:1/?token=sesame')) as ticket:
        place = urllib.parse.urlsplit(ticket.url)
        late = time.monotonic() + 61
        with monkeypatch.context() as patch:
            patch.setattr('fogros2_monitor.browser.time.monotonic', lambda: late)
            assert ask(place.path) == (404, '')


def test_silent_connection_does_not_hold_up_the_browser():
    ticket = Ticket('http://localhost:1/')
    place = urllib.parse.urlsplit(ticket.url)
    with socket.create_connection((place.hostname, place.port)):
        with contextlib.closing(http.client.HTTPConnection(place.netloc, timeout=5)) as link:
            link.request('GET', place.path)
            assert link.getresponse().status == 303
        closing = threading.Thread(target=ticket.close, daemon=True)
        closing.start()
        closing.join(60)
        assert not closing.is_alive()


def test_service_of_a_pod_keeps_the_callers_addresses():
    where = MachineId('robots', 'fogros2-planner', 'u-1', '')
    made = manifests.port_service('LoadBalancer', where, 8766, SOURCES)
    assert made['metadata']['name'] == 'fogros2-planner-8766'
    assert made['metadata']['ownerReferences'][0]['uid'] == 'u-1'
    assert made['spec']['loadBalancerSourceRanges'] == list(SOURCES)
    assert made['spec']['externalTrafficPolicy'] == 'Local'
    assert 'loadBalancerSourceRanges' not in manifests.port_service(
        'NodePort', where, 8766, SOURCES)['spec']


def test_service_that_cannot_be_removed_has_a_hint():
    from fogros2.kubernetes_client import ApiError

    class Api:
        def request(self, *_, **__):
            raise ApiError('may not', status=403, reason='Forbidden')

    with pytest.raises(ProviderError, match="port 8766 of 'fogros2-planner' can't be closed"):
        ways.close_port(Api(), MachineId('robots', 'fogros2-planner', 'u-1', ''), 8766)


@pytest.fixture
def made(monkeypatch):
    """Return the specs of the processes that actions make."""
    found = []

    class Added(added_process.AddedProcess):
        def __init__(self, spec):
            found.append(spec)
            super().__init__(spec)

    monkeypatch.setattr(action, 'AddedProcess', Added)
    monkeypatch.setattr(action, 'send', lambda process, machine: None)
    return found


def coordinated(monkeypatch, spec, *, on_robot=False):
    monkeypatch.setattr(action, 'Coordinator', SimpleNamespace(of=lambda _: SimpleNamespace(
        on_robot=lambda _: on_robot, resolve=lambda machine: machine,
        session=lambda _: SimpleNamespace(spec=spec),
        launch=SimpleNamespace(id='abc123', provider=lambda _: FakeProvider()))))


@pytest.mark.parametrize(('runs', 'on_robot'), [(True, False), (False, False), (True, True)])
def test_bridge_gets_the_options_of_the_machine(monkeypatch, made, runs, on_robot):
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(containers=runs))
    coordinated(monkeypatch, MachineSpec('planner', 'fake'), on_robot=on_robot)
    Foxglove('planner', topics=['/a', '/b*'], port=9000, image='x:1',
             monitor_allow=SOURCES).execute(LaunchContext())
    words = list(made[0].arguments)
    name = 'robot' if on_robot else 'planner'
    assert words[:4] == ['--name', name, '--listen', '127.0.0.1:9000']
    assert words[-5:] == ['--topic', '/a', '--topic', '/b*', '--ros-args']
    # a stream's images are looked at where they have come to, not fetched once more
    told = ros_names.remapped(made[0], {'/camera': '/fogros2/planner/camera'}).arguments
    assert told[-2:] == ('-r', '/camera:=/fogros2/planner/camera')
    # the robot's own has neither others nor an application
    if on_robot:
        folder = addresses.on_robot(Store(), 'planner')
        assert words[4:-5] == ['--secrets', f'{folder}/monitor-9000/process-{os.getpid()}']
    else:
        assert words[4:-5] == [
            '--secrets', '$FOGROS2_AGENT_DIRECTORY/monitor-9000/abc123', '--vpn', '9000',
            *(['--image', 'x:1'] if runs else []), '--public', '9001', '--allow', *SOURCES]

# SPDX-License-Identifier: Apache-2.0
"""Container machines on another computer: requests, answers, and the program that serves them."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import io
import json
from pathlib import Path
import socket
import tarfile
from typing import Any

import pytest

from fogros2.errors import (
    CommandError,
    ConfigurationError,
    ConnectError,
    FogError,
    MachineNotFound,
    NameTaken,
    PrerequisiteError,
    ProviderError,
    Unsupported,
)
from fogros2.model import (
    Command,
    CreateRequest,
    Endpoint,
    MachineSpec,
    MachineState,
    Result,
    to_json,
)
from fogros2.provider import Provider
from fogros2.provider.container import ContainerProvider
from fogros2.provider.container import engine as container_engine
from fogros2.provider.container import machine as container_machine
from fogros2.shell.local import LocalShell
from fogros2.store import Record, Store
from fogros2_features.hosts import hosted, served
from fogros2_features.hosts.hosted import HostedProvider, program, result_of
from fogros2_testing import FakeProvider, FakeShell, ProviderContract, request_for
from ros2fog_cli.api import machines

ID = 'podman:0123456789ab:0123-token'
REPORT = {
    'id': ID, 'state': 'running', 'created': 1700000000.5, 'vpn_host': '198.51.100.2', 'image': '',
    'endpoint': {
        'host': '198.51.100.2', 'port': 40001, 'user': 'fog', 'host_key': 'ssh-ed25519 AA'},
    'vpn_port': 40002, 'tags': {'fogros2-name': 'planner', 'fogros2-hosted': '-1234abcd'}}


@pytest.fixture
def on() -> Iterator[dict[str, Any]]:
    """Return the option of a host of which only the port answers."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        yield {'host': '127.0.0.1', 'port': server.getsockname()[1], 'user': 'lab'}


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch) -> FakeShell:
    """Return the shell of each host; its ``said`` is what the next calls print."""
    fake = FakeShell(handlers={'sh': lambda command: Result(0, fake.said, '')})
    fake.said = ''  # type: ignore[attr-defined]
    monkeypatch.setattr(hosted, 'connect', lambda endpoint, name: fake)
    return fake


class Engine(FakeProvider):
    """A host's container provider, whose containers are entries of a dictionary."""

    def check(self, spec: MachineSpec) -> None:
        assert spec.provider == ContainerProvider.name

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        made = super().create(spec, request)
        if made.startswith('fake-'):  # it is new
            identity = f'podman:{made[5:]:0>12}:{request.token}'
            self.machines[identity] = dataclasses.replace(self.machines.pop(made), id=identity)
            self._tokens[request.token], self._waits[identity] = identity, 0
        return self._tokens[request.token]


class TestHostedProvider(ProviderContract):
    """Against a host in memory; the contract of real containers is ``ContainerProvider``'s."""

    @pytest.fixture(autouse=True)
    def place(self, on: dict[str, Any], shell: FakeShell) -> None:
        self.options = {'on': on}
        engine = Engine(endpoint=Endpoint('ssh', '198.51.100.2', 40001, 'fog', 'ssh-ed25519 AA'))

        def serve(command: Command) -> Result:
            ask = json.loads(command.input or b'')
            reply: dict[str, Any]
            try:
                reply = {'result': served.answer(engine, ask['call'], ask['given'])}
            except FogError as error:
                reply = {'error': type(error).__name__, 'message': error.args[0],
                         'hint': error.hint}
            return Result(0, to_json(reply), '')

        shell._handlers['sh'] = serve

    def make(self) -> tuple[HostedProvider, dict[str, Any]]:
        provider = HostedProvider()
        provider.check(MachineSpec('any', 'hosted', self.options))
        return provider, self.options

    def another(self, provider: Provider, spec: MachineSpec) -> Provider:
        return self.make()[0]  # no record names the host


def spec_on(on: dict[str, Any], **options: Any) -> MachineSpec:
    return MachineSpec('planner', 'hosted', {'on': on, **options})


def asked(shell: FakeShell) -> dict[str, Any]:
    return json.loads(shell.commands[-1].input)  # type: ignore[no-any-return]


def test_create_asks_the_host_for_a_container(on: dict[str, Any], shell: FakeShell) -> None:
    shell.said = json.dumps({'result': ID})  # type: ignore[attr-defined]
    spec = spec_on(on, memory='2g', ports=['80'])
    machine_id = HostedProvider().create(spec, request_for(spec, token='0123-token'))
    assert machine_id.startswith(f'hosted:{ID}@ssh:')
    call = asked(shell)
    assert call['call'] == 'create'
    sent, request = call['given']['spec'], call['given']['request']
    assert sent['name'] == 'planner'
    assert sent['options'] == {'memory': '2g', 'ports': ['80', '22', '51820/udp']}
    assert request['token'] == '0123-token'
    assert {*request['tags']} == {'fogros2-name', 'fogros2-hosted'}


def test_host_may_go_on_with_a_lost_request(on: dict[str, Any], shell: FakeShell) -> None:
    def lost(command: Command) -> Result:
        raise ConnectError('the connection is lost')

    for handler in (lost, lambda command: Result(0, 'Welcome!', '')):
        shell._handlers['sh'] = handler
        with pytest.raises(FogError) as caught:
            HostedProvider().create(spec_on(on), request_for(spec_on(on)))
        assert caught.value.refused is False
    record = Record('planner', 'hosted', spec_on(on), token='0123-token', last='abc123')
    Store().set_aside(record)
    shell._handlers['sh'] = lambda command: Result(0, json.dumps({'result': [REPORT]}), '')
    assert [found.name for found in HostedProvider().find({})] == ['planner']


def test_machine_has_the_ports_of_its_host(on: dict[str, Any], shell: FakeShell) -> None:
    provider = HostedProvider()
    shell.said = json.dumps({'result': ID})  # type: ignore[attr-defined]
    machine_id = provider.create(spec_on(on), request_for(spec_on(on)))
    shell.said = json.dumps({'result': REPORT})  # type: ignore[attr-defined]
    machine = provider.describe(machine_id)
    assert machine.endpoint == Endpoint('ssh', '127.0.0.1', 40001, 'fog', 'ssh-ed25519 AA',
                                        alias='127.0.0.1')
    assert (machine.vpn_host, machine.vpn_port) == ('127.0.0.1', 40002)
    assert (machine.id, machine.name, machine.region) == (machine_id, 'planner', '127.0.0.1')
    assert machine.state is MachineState.RUNNING and machine.end_command
    # machines of one launch there dial each other in the engine's network
    assert machine.private_network and machine.private_ip == '198.51.100.2'
    assert asked(shell)['given'] == {'id': ID}
    # before the first boot has made a host key
    shell.said = json.dumps(  # type: ignore[attr-defined]
        {'result': {**REPORT, 'endpoint': None}})
    assert provider.describe(machine_id).endpoint is None


@pytest.mark.parametrize(('kind', 'raised'), [
    ('NameTaken', NameTaken), ('MachineNotFound', MachineNotFound), ('Unsupported', Unsupported),
    ('ConfigurationError', ConfigurationError), ('PrerequisiteError', PrerequisiteError),
    ('CommandError', ProviderError), ('SystemExit', ProviderError), ('print', ProviderError)])
def test_error_of_the_host_is_raised_here(kind: str, raised: type[FogError]) -> None:
    text = json.dumps({'error': kind, 'message': 'no\x1b]0;', 'hint': 'do'})
    with pytest.raises(raised) as error:
        result_of(f'welcome\n{text}\n', 'box')
    assert type(error.value) is raised
    assert error.value.hint == 'do' and '\x1b' not in str(error.value)


def test_program_is_sent_once(on: dict[str, Any], shell: FakeShell) -> None:
    there: list[bytes] = []

    def serve(command: Command) -> Result:
        if command.argv[2] == hosted._KEEP:
            there.append(command.input)
            return Result(0, '', '')
        return Result(0, json.dumps({'result': ID}), '') if there else Result(75, '', '')

    shell._handlers['sh'] = serve
    for _ in range(2):
        HostedProvider().create(spec_on(on), request_for(spec_on(on)))
    assert there == [program()[0]]


def test_host_without_python_is_named(on: dict[str, Any], shell: FakeShell) -> None:
    shell._handlers['sh'] = lambda command: Result(127, '', 'sh: python3: not found')
    with pytest.raises(CommandError, match="failed on '127.0.0.1'.*python3: not found"):
        HostedProvider().create(spec_on(on), request_for(spec_on(on)))


def test_host_that_is_off_is_no_lost_machine(on: dict[str, Any], shell: FakeShell) -> None:
    shell.said = json.dumps({'result': ID})  # type: ignore[attr-defined]
    machine_id = HostedProvider().create(spec_on(on), request_for(spec_on(on)))
    # nothing listens at this port
    off = machine_id.replace(f"port={on['port']}", 'port=1')
    with pytest.raises(ConnectError, match="the host '127.0.0.1' does not answer"):
        HostedProvider().describe(off)


def test_host_is_asked_for_an_answer_before_the_vpn() -> None:
    with socket.create_server(('127.0.0.1', 0)) as server:
        spec = MachineSpec('planner', 'hosted', {
            'on': {'host': '127.0.0.1', 'port': server.getsockname()[1]}})
        HostedProvider().check_here(spec)
    HostedProvider().check(spec)
    with pytest.raises(ProviderError, match='refuses connections'):
        HostedProvider().check_here(spec)


@pytest.mark.parametrize(('options', 'words'), [
    ({'on': {'host': 'box'}, 'memry': '2g'}, "has no option 'memry'"),
    ({'on': {'host': 'box'}, 'cpus': 'many'}, "'cpus' can't be"),
    ({'on': {'hots': 'box'}}, "has no option 'hots'"), ({}, "can't be the host"),
    ({'on': {'host': 'box', 'prt': 22}}, "has no option 'prt'"),
    ({'on': {'host': '-oProxyCommand=x'}}, "can't be the host"),
])
def test_wrong_options_are_refused_without_the_host(
    options: dict[str, Any], words: str,
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        HostedProvider().check(MachineSpec('planner', 'hosted', options))


@pytest.mark.parametrize('machine_id', ['x', ID, 'hosted:', f'hosted:{ID}', 'ssh:host=a'])
def test_foreign_id_is_no_machine(machine_id: str) -> None:
    with pytest.raises(MachineNotFound):
        HostedProvider().describe(machine_id)


def test_find_asks_the_hosts_of_the_records(
    on: dict[str, Any], shell: FakeShell, state_home: Path,
) -> None:
    with pytest.raises(Unsupported):
        list(HostedProvider().find({}))
    # a launch that was killed before it saved the id
    Store().save(Record('planner', 'hosted', spec_on(on)))
    shell.said = json.dumps({'result': [REPORT]})  # type: ignore[attr-defined]
    found, = HostedProvider().find({'fogros2-launch': 'abc'})
    assert asked(shell)['given'] == {'tags': {'fogros2-launch': 'abc'}}
    # the host's own machines are left out
    shell.said = json.dumps(  # type: ignore[attr-defined]
        {'result': [REPORT, {**REPORT, 'tags': {'fogros2-name': 'own'}}]})
    Store().save(Record('planner', 'hosted', spec_on(on), machine_id=found.id))
    assert [machine.id for machine in HostedProvider().find({})] == [found.id]


def test_leftovers_on_hosts_go(on: dict[str, Any], shell: FakeShell, state_home: Path) -> None:
    assert HostedProvider().tidy(['0123-token']) == []
    Store().save(Record('planner', 'hosted', spec_on(on)))
    shell.said = json.dumps({'result': ['the folder x']})  # type: ignore[attr-defined]
    assert HostedProvider().tidy(['0123-token']) == ['the folder x on 127.0.0.1']
    assert asked(shell) == {'call': 'tidy', 'given': {'dead': ['0123-token']}}
    shell.said = json.dumps({'result': [{}]})  # type: ignore[attr-defined]
    with pytest.raises(ProviderError, match='may be hijacked'):
        HostedProvider().tidy()


def test_host_that_is_off_hides_no_machine_of_another(
    on: dict[str, Any], shell: FakeShell, state_home: Path,
) -> None:
    with socket.create_server(('127.0.0.1', 0)) as server:
        off = {**on, 'port': server.getsockname()[1]}
    for name, host in (('first', off), ('planner', on)):
        Store().save(Record(name, 'hosted', spec_on(host)))
    shell.said = json.dumps({'result': [REPORT]})  # type: ignore[attr-defined]
    search = HostedProvider().find({})
    assert next(search).name == 'planner'
    with pytest.raises(ProviderError, match='refuses connections'):
        next(search)


def test_host_that_is_off_hides_no_volume_of_another(
    monkeypatch: pytest.MonkeyPatch, on: dict[str, Any], shell: FakeShell,
) -> None:
    find_host = HostedProvider._find_host

    def found(provider: HostedProvider, host: dict[str, Any]) -> str:
        if host['host'] == 'off':
            raise ConnectError('it is off')
        return find_host(provider, on)

    monkeypatch.setattr(HostedProvider, '_find_host', found)
    shell.said = json.dumps({  # type: ignore[attr-defined]
        'result': [{'id': 'podman:fogros2-volume-maps', 'user': 'planner'}]})
    warned: list[str] = []
    volumes = machines.gather(warned.append, [], lambda name: HostedProvider().volumes(
        ['off', '127.0.0.1']) if name == 'hosted' else ())
    assert [(one.name, one.region, one.user) for one in volumes] == [
        ('maps', '127.0.0.1', 'planner')]
    assert warned == ['hosted: it is off']


# -- the program on the host ---------------------------------------------------------------------

def test_machine_of_a_robot_is_reached_at_published_ports() -> None:
    ports = {'22/tcp': [{'HostPort': '41001'}], '51820/udp': [{'HostPort': '41002'}]}
    labels = {'fogros2-token': '0123-token', 'fogros2-login': 'fog', 'fogros2-vpn-port': '51820'}
    entry: dict[str, Any] = {
        'Id': '0123456789abcdef', 'Created': '2026-11-25T09:00:00Z',
        'State': {'Status': 'running'},
        'NetworkSettings': {'Ports': ports, 'Networks': {'n': {'IPAddress': '198.51.100.2'}}},
        'Config': {'Image': 'ros', 'Labels': {**labels, 'fogros2-hosted': '-1234abcd'}}}
    machine = container_machine.machine_of(container_engine.docker(), entry, 'ssh-ed25519 AA')
    assert machine.endpoint is not None
    assert (machine.endpoint.port, machine.vpn_port) == (41001, 41002)
    assert json.loads(to_json(machine))['state'] == 'running'
    assert machine.image == 'ros'
    entry['NetworkSettings']['Ports'] = {'22/tcp': None, '51820/udp': []}
    assert container_machine.published(entry) == (0, 0)
    # what a user publishes of another machine leads nowhere else
    entry['NetworkSettings']['Ports'] = ports
    entry['Config']['Labels'] = labels
    machine = container_machine.machine_of(container_engine.docker(), entry, 'ssh-ed25519 AA')
    assert machine.endpoint is not None and (machine.endpoint.port, machine.vpn_port) == (22, 0)


def test_program_holds_no_more_than_it_imports() -> None:
    data, _ = program()
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        names = tar.getnames()
    assert 'fogros2_features/hosts/served.py' in names
    assert not [name for name in names if '/aws' in name or '/deploy' in name]
    assert len(data) < 300_000


@pytest.fixture
def here(on: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Let this computer be each host, with a cache of its own."""
    monkeypatch.setattr(
        hosted, 'connect', lambda endpoint, name: LocalShell(Endpoint('local'), name=name))
    monkeypatch.setattr(hosted, '_SERVE', f'XDG_CACHE_HOME={tmp_path}\n{hosted._SERVE}')
    monkeypatch.setattr(hosted, '_KEEP', f'XDG_CACHE_HOME={tmp_path}\n{hosted._KEEP}')
    return tmp_path


def test_host_runs_the_program_with_its_own_python(on: dict[str, Any], here: Path) -> None:
    """Nothing of this environment is there: the modules have all that they import."""
    provider = HostedProvider()
    machine_id = f'hosted:nonsense@{provider._find_host(on)}'
    data, key = program()
    for _ in range(2):
        with pytest.raises(MachineNotFound, match="'nonsense' is no container machine"):
            provider.describe(machine_id)
        # as another robot that sends it at the same time
        LocalShell(Endpoint('local'), name='box').run(Command(
            ('sh', '-ec', hosted._KEEP, 'sh', key), input=data), timeout=30.0)
    kept, = (here / 'fogros2').iterdir()
    assert kept.name == f'host-{key}'
    assert {path.name for path in kept.iterdir()} == {'fogros2', 'fogros2_features'}

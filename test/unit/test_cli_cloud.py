# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog`` with a provider that has places, a firewall, images and prices."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
import contextlib
import dataclasses
from decimal import Decimal
import io
import json
import os
from pathlib import Path
import socket
import sys
import threading
import time
from typing import Any, Optional

import pytest
from ros2cli.cli import main

from fogros2.errors import (
    ConnectError,
    DeadlineExceeded,
    PrerequisiteError,
    ProviderError,
    Unsupported,
)
from fogros2.model import (
    Endpoint,
    Machine,
    MachineSpec,
    MachineState,
    Result,
    VpnInterface,
)
from fogros2.provider import (
    Capabilities,
    SETTLED,
    TAG_DEPENDENCIES,
    TAG_EXPIRES,
    TAG_LAUNCH,
    TAG_NAME,
    TAG_ON_EXIT,
    TAG_ROBOT,
)
from fogros2.provider.machine_types import Region
from fogros2.provider.vm.failures import Silent
from fogros2.provider.vm.images import Image
from fogros2.store import Record, robot_name, Store, this_process
from fogros2.waiting import wait_until
from fogros2_features.images import baking, pods
from fogros2_monitor import access
from fogros2_testing.fakes import FakeProvider, FakeShell
from fogros2_testing.plugins import instead
from ros2fog_cli.api import (
    doctor,
    endings,
    progress,
    reach,
    table,
)
from ros2fog_cli.api.machines import Entry

NOW = 1_800_000_000.0


class Cloud(FakeProvider):
    """A cloud in memory."""

    name = 'cloud'
    capabilities = Capabilities(firewall=True, regions=True)
    machines: dict[str, Machine] = {}
    baked: list[Image] = []
    asked: list[tuple[Any, ...]] = []
    up = True
    lingering = False
    states: list[str] = []

    @classmethod
    def configured(cls) -> bool:
        return cls.up

    def search_in(self, regions: Sequence[str]) -> None:
        self.asked.append(('regions', *regions))

    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        self.asked.append(('find',))
        return super().find(tags)

    def destroy(self, machine_id: str) -> None:
        if not self.lingering:
            super().destroy(machine_id)

    def robot_address(self) -> str:
        return '198.51.100.9/32'

    def allow(self, machine_id: str, port: int, sources: Sequence[str]) -> None:
        self.asked.append(('allow', machine_id, port, *sources))

    def bake(self, machine_id: str, name: str, dependencies: str) -> str:
        self.asked.append(('bake', machine_id, name, dependencies))
        self.baked.append(Image(f'img-{len(self.baked)}', name, 'cloud', 'here', time.time(), 30,
                                'pending', dependencies))
        return self.baked[-1].id

    def images(self) -> Iterable[Image]:
        if self.states:
            state = self.states.pop(0)
            if state == 'no answer':
                raise Silent('no answer', 'is there a network?', unsent=False)
            self.baked[-1] = dataclasses.replace(self.baked[-1], state=state)
        return list(self.baked)

    def delete_image(self, image_id: str) -> None:
        if not self.lingering:
            self.baked[:] = [image for image in self.baked if image.id != image_id]


class Plain(Cloud):
    """One that keeps no images and has no places."""

    name = 'plain'
    capabilities = Capabilities()

    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        return []

    def images(self) -> Iterable[Image]:
        raise Unsupported('no images')


@pytest.fixture(autouse=True)
def cloud(monkeypatch: pytest.MonkeyPatch) -> type[Cloud]:
    Cloud.machines, Cloud.baked, Cloud.asked, Cloud.states = {}, [], [], []
    Cloud.up, Cloud.lingering = True, False
    instead(monkeypatch, 'fogros2.provider', {'cloud': Cloud, 'plain': Plain})
    return Cloud


def machine(name: str, **changes: Any) -> Machine:
    tags = {TAG_NAME: name, TAG_ROBOT: robot_name(), TAG_DEPENDENCIES: '0123456789abcdef',
            TAG_EXPIRES: str(int(changes.pop('expires', time.time() + 3600)))}
    made = Machine(f'id-{name}', name, 'cloud', MachineState.RUNNING, time.time() - 3600,
                   Endpoint('ssh', '198.51.100.7', 22, 'ubuntu', 'ssh-ed25519 AAAA'),
                   region='eu-west-1', kind='t3.medium', tags=tags,
                   cost_per_hour=Decimal('0.0456'))
    Cloud.machines[made.id] = dataclasses.replace(made, **changes)
    return Cloud.machines[made.id]


def record(name: str, *, alive: bool = False, **changes: Any) -> Record:
    made = Record(name, 'cloud', MachineSpec(name, 'cloud'), machine_id=f'id-{name}',
                  created=time.time() - 600, launch='abc123' if alive else '',
                  **(this_process() if alive else {}),
                  endpoint=Endpoint('ssh', '198.51.100.7', 22, 'ubuntu', 'ssh-ed25519 BBBB',
                                 '/keys/id_ed25519'))
    return Store().save(dataclasses.replace(made, **changes))


def run(*words: str) -> Any:
    return main(argv=['fog', *words])


# -- which providers are asked ------------------------------------------------------------


def test_unconfigured_provider_is_not_asked(capsys: pytest.CaptureFixture[str]) -> None:
    Cloud.up = False
    machine('slam')
    assert run('list') == 0
    assert capsys.readouterr().out == 'no machines\n' and Cloud.asked == []
    # a record of this robot's, or a region, names it all the same
    assert run('list', '--region', 'eu-west-1') == 0
    assert Cloud.asked == [('regions', 'eu-west-1'), ('find',)]
    record('slam')
    assert run('list') == 0
    assert 'slam' in capsys.readouterr().out


def test_machine_is_deleted_while_another_region_is_silent(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    def find(self: Cloud, tags: Mapping[str, str]) -> Iterable[Machine]:
        raise Silent('us-east-1 does not answer', '', unsent=False)

    machine('slam')
    record('slam')
    monkeypatch.setattr(Cloud, 'find', find)
    assert run('delete', 'slam', '--yes') == 0
    assert not Cloud.machines and not Store().exists('slam')
    assert capsys.readouterr().err == 'cloud: us-east-1 does not answer\n'
    record('lost', machine_id=None)  # it may be in that region
    assert run('delete', 'lost', '--yes') == 1
    assert Store().exists('lost')


# -- what a user sees ---------------------------------------------------------------------


def test_narrow_terminal_omits_optional_columns_in_order(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine('a-machine-with-a-long-name')
    for width, missing in ((200, ()), (120, ('KIND',)), (110, ('KIND', 'PLACE')),
                           (80, ('KIND', 'PLACE', 'ADDRESS'))):
        monkeypatch.setattr(table, 'terminal_width', lambda width=width: width)
        assert run('list') == 0
        lines = capsys.readouterr().out.splitlines()
        assert max(map(len, lines)) <= width
        for name in ('NAME', 'STATE', 'TIME LEFT', 'KIND', 'PLACE', 'ADDRESS'):
            assert (name in lines[0]) == (name not in missing), (width, lines[0])


def test_empty_columns_are_omitted() -> None:
    rows = [('a', '-', 'x'), ('b', '', 'y')]
    assert table.table(('NAME', 'KIND', 'C'), rows, optional=('KIND',)).splitlines() == [
        'NAME  C', 'a     x', 'b     y']
    assert table.table(('NAME', 'KIND', 'C'), rows).splitlines()[0] == 'NAME  KIND  C'
    assert table.table(('NAME', 'C'), [('abcdef', 'x')], width=3,
                       optional=('C',)).splitlines() == ['NAME', 'abcdef']


def test_status_shows_place_and_cost(capsys: pytest.CaptureFixture[str]) -> None:
    machine('slam')
    assert run('status', 'slam') == 1
    said = capsys.readouterr().out
    assert 'eu-west-1' in said and 't3.medium' in said and '$0.0456 an hour, $0.05 so far' in said


def test_kept_machine_without_an_agent_has_no_problems(
    capsys: pytest.CaptureFixture[str],
) -> None:
    machine('slam')
    record('slam')  # of no launch: the last one has kept it
    assert run('status', 'slam') == 0
    said = capsys.readouterr()
    assert 'launch     none: it is kept for the next one' in said.out and said.err == ''
    said = run('logs', 'slam')
    assert 'the machine is kept for the next launch' in f'{said}{capsys.readouterr().err}'


# -- ending -------------------------------------------------------------------------------


def test_delete_fails_if_the_machine_still_exists(
    capsys: pytest.CaptureFixture[str],
) -> None:
    machine('slam')
    record('slam')
    Cloud.lingering = True
    assert run('delete', 'slam', '--yes') == 1
    assert "'slam' (id-slam) is still there: running" in capsys.readouterr().err
    assert Store().exists('slam')
    machine('slam', state=MachineState.DELETED)
    assert run('delete', 'slam', '--yes') == 0
    assert not Store().exists('slam')


def test_machines_are_deleted_in_parallel(monkeypatch: pytest.MonkeyPatch) -> None:
    together = threading.Barrier(8, timeout=20)
    destroy = Cloud.destroy

    def slow(self: Cloud, machine_id: str) -> None:
        together.wait()
        destroy(self, machine_id)

    monkeypatch.setattr(Cloud, 'destroy', slow)
    for number in range(8):
        machine(f'm{number}')
    assert run('delete', 'all', '--yes') == 0
    assert not Cloud.machines


@pytest.mark.parametrize(('stopped', 'ends'), [(NOW - 3600, False), (NOW - 30 * 86400, True),
                                                (None, True)])
def test_gc_uses_the_providers_time_of_the_stop(
    stopped: Optional[float], ends: bool,
) -> None:
    made = machine('slam', state=MachineState.STOPPED, created=NOW - 60 * 86400,
                   stopped=stopped, expires=NOW - 59 * 86400)
    entry = Entry('slam', 'cloud', made, None)
    since = endings.stopped_at(made, None, Store())
    assert bool(endings.why_end(entry, NOW, 7 * 86400.0, since)) is ends


def test_gc_tidies_up_providers(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    def tidy(self: Cloud, dead: Collection[str] = ()) -> list[str]:
        self.asked.append(('tidy',))
        return [f"security group of 'old' ({self.name})"] if type(self) is Cloud else []

    monkeypatch.setattr(Cloud, 'tidy', tidy)
    assert run('gc', '--dry-run') == 0
    assert ('tidy',) not in Cloud.asked
    capsys.readouterr()
    assert run('gc') == 0
    assert capsys.readouterr().out == \
        "cleared leftover security group of 'old' (cloud): its machine ended by itself\n"
    Cloud.up = False
    Cloud.asked.clear()
    assert run('gc') == 0
    assert not Cloud.asked


@pytest.mark.parametrize('verb', [('gc',), ('delete', 'slam', '--yes')])
def test_request_of_a_killed_launch_is_watched(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], verb: Sequence[str],
) -> None:
    """The launch died before it saved the machine's id: the machine may appear later."""
    def tidy(self: Cloud, dead: Collection[str] = ()) -> list[str]:
        self.asked.append(('tidy', *dead))
        return []

    monkeypatch.setattr(Cloud, 'tidy', tidy)
    record('slam', machine_id=None, token='t1', launch='abc123', last='abc123')
    run(*verb)
    assert ('tidy', 't1') in Cloud.asked
    assert not Store().machine('slam').exists(), 'another launch may use the name'
    assert "'slam' may still appear" in ''.join(capfd.readouterr())
    record('slam', alive=True, machine_id='id-2', launch='def456')
    late = machine('slam')
    Cloud.machines['id-slam'] = dataclasses.replace(
        late, tags={**late.tags, TAG_LAUNCH: 'abc123'})
    Cloud.machines['id-2'] = dataclasses.replace(
        late, id='id-2', tags={**late.tags, TAG_LAUNCH: 'def456'})
    assert run('gc', '--dry-run') == 0
    assert capfd.readouterr().out == (
        'would clear machine slam: its provider had not answered the request for it\n')
    assert run('gc') == 0
    assert [*Cloud.machines] == ['id-2'] and Store().exists('slam')
    assert run('gc') == 0
    assert capfd.readouterr().out.endswith('nothing to clear\n')


@pytest.mark.parametrize('known', ['id-slam', None])
def test_gc_keeps_the_machine_of_a_repeated_request(known: Optional[str]) -> None:
    """The first request of a launch got no answer; the second one created the machine."""
    Store().set_aside(record('slam', machine_id=None, token='t1', last='abc123'))
    record('slam', alive=True, machine_id=known, token='t2', last='abc123')
    late = machine('slam')
    Cloud.machines['id-slam'] = dataclasses.replace(
        late, tags={**late.tags, TAG_LAUNCH: 'abc123'})
    assert run('gc') == 1
    assert [*Cloud.machines] == ['id-slam']
    assert [request.token for request, _ in Store().requests()] == ['t1']


def test_old_request_creates_nothing_any_more() -> None:
    Store().set_aside(record('slam', machine_id=None, token='t1', last='abc123'))
    assert run('gc') == 1
    (path,) = (Store().root / 'requests').iterdir()
    os.utime(path, (0, time.time() - SETTLED - 1))
    assert run('gc') == 0
    assert not path.exists()


# -- the firewall -------------------------------------------------------------------------


@pytest.fixture
def shells(monkeypatch: pytest.MonkeyPatch) -> list[Endpoint]:
    """Return where shells were opened to; they lead nowhere."""
    opened: list[Endpoint] = []

    def connect(to: Endpoint, **_: Any) -> FakeShell:
        opened.append(to)
        Cloud.asked.append(('connect', to.host))
        return FakeShell()

    monkeypatch.setattr(reach.shells, 'connect', connect)
    return opened


def test_session_opens_and_closes_the_firewall(shells: list[Endpoint]) -> None:
    machine('slam')
    record('slam')
    assert run('connect', 'slam') == 0
    assert Cloud.asked == [('allow', 'id-slam', 22, '198.51.100.9/32'),
                           ('connect', '198.51.100.7'), ('allow', 'id-slam', 22)]
    # the key that the record has: the machine has made it after the provider's one-time key
    assert shells[0].host_key == 'ssh-ed25519 BBBB' and shells[0].key_file == '/keys/id_ed25519'
    assert run('connect', 'slam', '--user', 'root', '--', 'true') == 0
    assert shells[1].user == 'root'


def test_last_of_two_sessions_closes_the_port(shells: list[Endpoint]) -> None:
    machine('slam')
    record('slam')
    entry = reach.find('slam', pytest.fail)
    with reach.session(entry):
        with reach.session(entry):
            pass
        assert ('allow', 'id-slam', 22) not in Cloud.asked
    assert Cloud.asked[-1] == ('allow', 'id-slam', 22)


def test_port_that_opens_without_an_answer_is_closed(
    shells: list[Endpoint], monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine('slam')
    record('slam')
    ports = []

    def allow(self: Cloud, machine_id: str, port: int, sources: Sequence[str]) -> None:
        ports.append(list(sources))
        if sources:
            raise ProviderError('no answer')

    monkeypatch.setattr(Cloud, 'allow', allow)
    assert run('connect', 'slam') == 'no answer'
    assert ports == [['198.51.100.9/32'], []] and shells == []


def test_port_that_stays_open_is_reported(
    shells: list[Endpoint], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    machine('slam')
    record('slam')

    def allow(self: Cloud, machine_id: str, port: int, sources: Sequence[str]) -> None:
        if not sources:
            raise ProviderError('throttled')

    monkeypatch.setattr(Cloud, 'allow', allow)
    assert run('connect', 'slam') == 0
    assert 'slam: its TCP port 22 may still be open' in capsys.readouterr().err


@pytest.mark.parametrize(('robot', 'of_launch', 'firewall', 'calls'), [
    ('', False, True, ['allow', 'connect', 'allow']), ('another', False, True, ['connect']),
    ('', True, True, ['allow', 'connect']),  # the launch closes the port
    ('', False, False, ['connect'])])
def test_session_changes_the_firewall_of_its_robot(
    shells: list[Endpoint], monkeypatch: pytest.MonkeyPatch, robot: str, of_launch: bool,
    firewall: bool, calls: list[str],
) -> None:
    monkeypatch.setattr(Cloud, 'capabilities', Capabilities(firewall=firewall, regions=True))
    own = machine('slam')
    machine('slam', tags={**own.tags, TAG_ROBOT: robot or robot_name()})
    if of_launch:
        record('slam', alive=True)
    assert run('connect', 'slam') == 0
    assert [call[0] for call in Cloud.asked if call[0] != 'find'] == calls
    if not of_launch:
        assert shells[0].host_key == 'ssh-ed25519 AAAA' and shells[0].key_file is None


def test_session_without_a_record_keeps_a_fleets_networks(
    shells: list[Endpoint], capsys: pytest.CaptureFixture[str],
) -> None:
    """Only a record has them, and a machine of a fleet is kept."""
    own = machine('slam')
    machine('slam', tags={**own.tags, TAG_ON_EXIT: 'keep'})
    assert run('connect', 'slam') == 0
    assert Cloud.asked[-2:] == [
        ('allow', 'id-slam', 22, '198.51.100.9/32'), ('connect', '198.51.100.7')]
    assert 'slam: its TCP port 22 stays open to this computer' in capsys.readouterr().err


# -- logs ---------------------------------------------------------------------------------


class Log:
    """
    An agent's log, whose events come one after the other in a thread.

    :param events: what happens before each event.
    """

    def __init__(self, events: Sequence[Callable[[], object]]) -> None:
        self._events = events

    def status(self) -> dict[str, int]:
        return {'next': len(self._events) + 1}

    def subscribe(self, take: Callable[[Any], None], since: int) -> None:
        threading.Thread(target=self._send, args=(take,), daemon=True).start()

    def _send(self, take: Callable[[Any], None]) -> None:
        for number, before in enumerate(self._events, 1):
            before()
            take({'event': 'output', 'seq': number})


class Time:
    """A clock that another thread sets."""

    def __init__(self) -> None:
        self.now = 0.0
        self._read = threading.Semaphore(0)

    def monotonic(self) -> float:
        self._read.release()
        return self.now

    def pass_(self, seconds: float) -> None:
        """Let time pass, until it has been looked at twice."""
        self.now += seconds
        while self._read.acquire(blocking=False):
            pass
        for _ in range(2):
            assert self._read.acquire(timeout=60)


@pytest.mark.parametrize(('before', 'blocked', 'shown', 'whole'), [
    (20.0, 0.0, 5, True),   # 100 s together
    (0.0, 100.0, 5, True),  # the reader of the output takes its time
    (40.0, 0.0, 0, False)])
def test_log_is_whole_unless_its_agent_is_silent(
    monkeypatch: pytest.MonkeyPatch, before: float, blocked: float, shown: int, whole: bool,
) -> None:
    clock, lines = Time(), []
    monkeypatch.setattr(reach, 'LOOK', 0.001)
    monkeypatch.setattr(reach, 'time', clock)
    over = threading.Event()

    def show(event: Any) -> None:
        if blocked:
            clock.pass_(blocked)
        lines.append(event)

    def wait() -> None:
        if whole:
            clock.pass_(before)
        else:
            clock.now += before
            assert over.wait(60)

    try:
        assert reach.follow(Log([wait] * 5), show, forever=False) is whole  # type: ignore
        assert len(lines) == shown
    finally:
        over.set()


def test_session_prefers_the_vpn(shells: list[Endpoint]) -> None:
    with socket.create_server(('127.0.0.1', 0)) as server:
        port = server.getsockname()[1]
        machine('slam', endpoint=Endpoint('ssh', '198.51.100.7', port, 'ubuntu'))
        record('slam', alive=True, vpn=VpnInterface('fog', '127.0.0.1', '127.0.0.0/8', 1, ''),
               endpoint=Endpoint('ssh', '198.51.100.7', port, 'ubuntu', 'ssh-ed25519 BBBB'))
        assert run('connect', 'slam') == 0
    assert [call[0] for call in Cloud.asked] == ['connect']
    assert shells[0].host == '127.0.0.1' and shells[0].host_key == 'ssh-ed25519 BBBB'
    # it answers no more: the way round, through the firewall
    assert run('connect', 'slam') == 0
    assert shells[1].host == '198.51.100.7'


# -- images -------------------------------------------------------------------------------


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baking, 'LOOK', 0.01)


@pytest.fixture(autouse=True)
def disk(monkeypatch: pytest.MonkeyPatch) -> FakeShell:
    """Return the shell of every machine that no other fixture leads elsewhere."""
    shell = FakeShell(handlers={'sync': lambda c: Result(0, '', '')})
    monkeypatch.setattr(reach.shells, 'connect', lambda *_, **__: shell)
    return shell


def test_image_is_created_and_awaited(
    quick: None, disk: FakeShell, capsys: pytest.CaptureFixture[str],
) -> None:
    machine('slam')
    # a request without an answer does not end the wait
    Cloud.states = ['pending', 'no answer', 'pending', 'available']
    assert run('image', 'slam', '--dry-run') == 0
    assert 'would make an image of slam: cloud id-slam, running' in capsys.readouterr().err
    assert not Cloud.baked and not disk.commands
    assert run('image', 'slam') == 0
    # what is in memory alone would not be in the image
    assert [command.argv for command in disk.commands] == [('sync',)]
    (_, machine_id, name, dependencies), = [c for c in Cloud.asked if c[0] == 'bake']
    assert machine_id == 'id-slam' and dependencies == '0123456789abcdef'
    assert name.startswith('slam-image-20')
    assert capsys.readouterr().out == f'made {name} (img-0)\n'


def test_failed_image_is_reported(quick: None, capsys: pytest.CaptureFixture[str]) -> None:
    machine('slam')
    Cloud.states = ['pending', 'failed']
    assert run('image', 'slam', '--image-name', 'mine') == 1
    assert "the image 'mine' (img-0) is failed" in capsys.readouterr().err


def test_image_without_dependencies_warns(capsys: pytest.CaptureFixture[str]) -> None:
    machine('slam', tags={TAG_NAME: 'slam', TAG_ROBOT: robot_name()})
    Cloud.states = ['available']
    assert run('image', 'slam', '--json') == 0
    said = capsys.readouterr()
    assert 'no launch takes the image by itself' in said.err
    assert json.loads(said.out)['id'] == 'img-0'


def test_image_of_an_unreachable_machine_warns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    def lost(*_: Any, **__: Any) -> FakeShell:
        raise ConnectError('no route')

    monkeypatch.setattr(reach.shells, 'connect', lost)
    machine('slam')
    Cloud.states = ['available']
    assert run('image', 'slam') == 0
    assert 'may be missing in the image: no route' in capsys.readouterr().err


def test_image_needs_a_running_or_stopped_machine(capsys: pytest.CaptureFixture[str]) -> None:
    machine('slam', state=MachineState.PENDING)
    assert 'it is pending' in str(run('image', 'slam'))
    assert 'there is no machine' in str(run('image', 'nowhere'))
    assert not Cloud.baked


def test_wait_for_an_image_times_out(quick: None) -> None:
    machine('slam')
    image = baking.bake(Entry('slam', 'cloud', Cloud.machines['id-slam']), 'mine')
    with pytest.raises(DeadlineExceeded, match="the image 'mine'"):
        baking.wait(image, timeout=0.2)
    Cloud.baked.clear()
    with pytest.raises(DeadlineExceeded):
        baking.wait(image, timeout=0.2)


def test_images_are_listed_and_deleted(capsys: pytest.CaptureFixture[str]) -> None:
    assert run('image', 'list') == 0
    assert capsys.readouterr().out == 'no images\n'
    for name in ('one', 'two', 'two'):
        Cloud.baked.append(Image(f'img-{len(Cloud.baked)}', name, 'cloud', 'eu-west-1',
                                 time.time() - 7200, 30, 'available', 'abcd'))
    assert run('image', 'list') == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ['NAME', 'IMAGE', 'PROVIDER', 'PLACE', 'STATE', 'AGE', 'SIZE',
                                'DEPENDENCIES']
    assert lines[1].split() == ['one', 'img-0', 'cloud', 'eu-west-1', 'available', '2', 'h', '00',
                                'min', '30', 'GB', 'abcd']
    assert run('image', 'list', '--json') == 0
    assert [i['id'] for i in json.loads(capsys.readouterr().out)['images']] == [
        'img-0', 'img-1', 'img-2']
    assert run('image', 'delete', 'two', '--dry-run') == 0
    assert capsys.readouterr().out.count('would delete two') == 2
    assert run('image', 'delete', 'two') == 1
    assert 'no terminal to ask at' in capsys.readouterr().err
    assert run('image', 'delete', 'two', 'img-0', '--yes') == 0
    assert not Cloud.baked
    assert 'there is no image two' in str(run('image', 'delete', 'two', '--yes'))


@pytest.mark.parametrize('words', [
    '--yes delete one two', 'delete one -y two', 'delete one two --yes --region eu-west-1'])
def test_options_of_image_may_be_anywhere(words: str) -> None:
    for name in ('one', 'two', 'three'):
        Cloud.baked.append(Image(f'img-{name}', name, 'cloud', state='available'))
    assert run('image', *words.split()) == 0
    assert [image.name for image in Cloud.baked] == ['three']


def test_image_that_still_exists_is_an_error(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Cloud.baked.append(Image('img-0', 'one', 'cloud'))
    Cloud.lingering = True
    assert run('image', 'delete', 'one', '--yes') == 1
    assert 'img-0 is still there' in capsys.readouterr().err


@pytest.mark.parametrize('words', [('list', 'x'), ('delete',), ('a', 'b', '--image-name', 'c')])
def test_wrong_arguments_of_image_are_refused(words: tuple[str, ...]) -> None:
    assert run('image', *words) not in (0, None)


def test_pod_image_has_what_a_launch_installs(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    (tmp_path / 'ros2').touch(mode=0o755)
    monkeypatch.setenv('PATH', str(tmp_path))
    words = ('image', 'create', '--registry', 'registry.example/robots', '--workspace', '')
    assert run(*words, '--base', 'ubuntu:24.04', '--dry-run') == 0
    lines = capsys.readouterr().out.splitlines()
    assert 'FROM ubuntu:24.04' in lines
    assert any(' wireguard-tools ' in line for line in lines)
    assert "can't be a registry" in str(run(*words, '--registry', 'no registry', '--dry-run'))
    monkeypatch.setattr('fogros2.process.which', lambda program: None)
    assert 'podman, docker, buildah' in str(run(*words, '--folder', str(tmp_path / 'image')))
    with pytest.raises(PrerequisiteError, match='ros2 is not on PATH'):
        pods.recipe('registry.example', folder='', environment={'PATH': '/nowhere'})


# -- prices and regions -------------------------------------------------------------------


@pytest.mark.parametrize('measured', [True, False])
def test_regions(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], measured: bool,
) -> None:
    asked: list[Any] = []

    def regions(self: Cloud, names: Sequence[str] = (), *, every: bool = False) -> list[Region]:
        asked.append((list(names), every))
        return [Region('us-west-1', 'San Francisco', 12.34), Region('eu-west-1', 'Dublin')] \
            if measured else [Region('us-west-1', 'San Francisco', distance_km=9.0)]

    monkeypatch.setattr(Cloud, 'regions', regions)
    assert run('regions', '--provider', 'cloud') == 0
    assert capsys.readouterr().out.splitlines() == ([
        'REGION     PLACE          MEDIAN', 'us-west-1  San Francisco  12 ms',
        'eu-west-1  Dublin         no answer'] if measured else [
        'REGION     PLACE          DISTANCE', 'us-west-1  San Francisco  9 km',
        'no region answers: these are distances from where this computer seems to be'])
    assert run('regions', 'us-west-1', '--all', '--json') == 0
    assert json.loads(capsys.readouterr().out)['regions'][0]['place'] == 'San Francisco'
    assert asked == [([], False), (['us-west-1'], True)]


def test_no_provider_has_prices() -> None:
    assert 'no cloud with prices is set up here (pip list shows' in str(run('price'))
    assert "'plain' has no price list" in str(run('price', '--provider', 'plain'))


# -- doctor -------------------------------------------------------------------------------


def test_doctor_asks_configured_providers() -> None:
    machine('slam')
    assert doctor.provider('cloud') == doctor.Check(
        "provider 'cloud'", 'ok', 'answers, 1 machine')
    Cloud.up = False
    Cloud.asked.clear()
    assert doctor.provider('cloud').detail == 'not set up here' and not Cloud.asked
    assert doctor.provider('cloud', needed=True).detail == 'answers, 1 machine'


def test_doctor_shows_the_error_of_a_provider(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Cloud) -> str:
        raise ProviderError('the token has expired', 'log in again')

    monkeypatch.setattr(Cloud, 'answers', refuse)
    assert doctor.provider('cloud') == doctor.Check(
        "provider 'cloud'", 'warning', 'the token has expired', 'log in again')
    assert doctor.provider('cloud', needed=True).verdict == 'failed'


def test_doctor_gives_up_a_silent_provider(monkeypatch: pytest.MonkeyPatch) -> None:
    over = threading.Event()
    monkeypatch.setattr(Cloud, 'answers', lambda self: str(over.wait(60)))
    begin = time.monotonic()
    assert 'no answer within 0.1 s' in doctor.provider('cloud', timeout=0.1).detail
    assert time.monotonic() - begin < 30
    over.set()


@pytest.mark.parametrize('verb', [('gc',), ('delete', 'all', '--yes')])
def test_closed_pipe_ends_no_deletion(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, verb: Sequence[str],
) -> None:
    for name in ('one', 'two', 'three'):
        machine(name, expires=time.time() - 3600)
        record(name)
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, 'w') as closed:
        monkeypatch.setattr('sys.stdout', closed)
        assert run(*verb) == 0
    assert not Cloud.machines and not Store().machines()


# -- what takes its time ------------------------------------------------------------------


class Terminal(io.StringIO):

    def isatty(self) -> bool:
        return True


def slow_cloud(monkeypatch: pytest.MonkeyPatch, over: Callable[[], bool]) -> None:
    """Make the deletion of a machine wait; let the verbs look at the clock all the time."""
    destroy = Cloud.destroy

    def slow(self: Cloud, machine_id: str) -> None:
        wait_until(over, timeout=60.0, what=f'{machine_id} to be terminated')
        destroy(self, machine_id)

    monkeypatch.setattr(Cloud, 'destroy', slow)
    monkeypatch.setattr(progress, 'TICK', 0.01)


@pytest.mark.parametrize(('verb', 'still'), [
    (('delete', 'slam', '--yes'), 'still deleting after'), (('gc',), 'still clearing after')])
@pytest.mark.parametrize('stream', [io.StringIO, Terminal])
def test_slow_deletion_is_told_without_a_terminal(
    monkeypatch: pytest.MonkeyPatch, verb: Sequence[str], still: str, stream: type[io.StringIO],
) -> None:
    monkeypatch.setenv('TERM', 'dumb')
    machine('slam', expires=time.time() - 3600)
    said = stream()
    slow_cloud(monkeypatch, lambda: said.getvalue().count('still') >= 3)
    monkeypatch.setattr(progress, 'STILL', 0.05)
    monkeypatch.setattr(sys, 'stderr', said)
    assert run(*verb) == 0
    assert f'{still} 0 s (waiting for id-slam to be terminated)\n' in said.getvalue()
    assert '\r' not in said.getvalue()


def test_running_time_of_a_deletion_makes_room_for_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ('one', 'two'):
        machine(name)
    shown = Terminal()
    monkeypatch.setenv('TERM', 'xterm')
    slow_cloud(monkeypatch, lambda: 'waiting for' in shown.getvalue())
    monkeypatch.setattr(sys, 'stderr', shown)
    monkeypatch.setattr(sys, 'stdout', shown)
    assert run('delete', 'all', '--yes') == 0
    text = shown.getvalue()
    assert '\r\x1b[Kdeleting 0 s (waiting for id-' in text
    for name in ('one', 'two'):
        at = text.index(f'deleted {name}\n')
        assert text[:at].endswith('\n') or text[:at].endswith('\r\x1b[K')
    assert text.endswith('\n') or text.endswith('\r\x1b[K')


def test_list_writes_nothing(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As with a home that is read-only or full."""
    machine('slam')
    monkeypatch.setenv('XDG_CONFIG_HOME', '/dev/null')
    monkeypatch.setenv('FOGROS2_STATE_HOME', '/dev/null/state')
    assert run('list') == 0
    assert 'running (orphan)' in capfd.readouterr().out


# -- words that are wrong -----------------------------------------------------------------


@pytest.mark.parametrize('words', [
    ('status', 'slam', '--region', 'eu-west-1'),
    ('delete', '--region', 'eu-west-1', '--region', 'us-east-1', 'slam', '--dry-run')])
def test_region_swallows_no_name(words: Sequence[str], capfd: pytest.CaptureFixture[str]) -> None:
    machine('slam')
    run(*words)
    regions = [word for word in words if word.startswith(('eu', 'us'))]
    assert ('regions', *regions) in Cloud.asked
    assert 'arguments are required' not in capfd.readouterr().err


@pytest.mark.parametrize(('words', 'said'), [
    (('plan',), 'required: file\n'), (('volume',), 'required: list | delete'),
    (('volume', 'delete'), "'ros2 fog volume delete' takes names or ids"),
    (('volume', 'list', 'maps'), "'ros2 fog volume list' takes no names"),
    (('delete', 'first,second'), "'first,second' is no name for a machine")])
def test_missing_or_wrong_word_is_named(
    words: Sequence[str], said: str, capfd: pytest.CaptureFixture[str],
) -> None:
    try:
        result = str(run(*words))
    except SystemExit:
        result = ''
    assert said in result + capfd.readouterr().err


@pytest.mark.parametrize('verb', [('list',), ('status', 'slam')])
def test_unknown_region_gets_the_nearest(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], verb: Sequence[str],
) -> None:
    monkeypatch.setattr(Cloud, 'region_names', classmethod(lambda cls: ('eu-west-1', 'here')))
    for wrong, hint in (('eu-wset-1', "did you mean 'eu-west-1'?"),
                        ('moon-9', 'ros2 fog regions shows those there are')):
        with pytest.raises(SystemExit):
            run(*verb, '--region', wrong)
        assert f"no provider has a region '{wrong}' ({hint})" in capfd.readouterr().err
    for right in ('eu-west-1', 'all', '*'):
        assert run('list', '--region', right) == 0


def test_several_machines_are_deleted_by_name(capfd: pytest.CaptureFixture[str]) -> None:
    for name in ('one', 'two', 'three'):
        machine(name)
        record(name)
    assert run('delete', 'one', 'three', 'two', 'one', '--yes') == 0
    assert not Cloud.machines
    assert capfd.readouterr().out.count('deleted') == 3
    machine('one')
    record('other')
    assert run('delete', 'one', 'othr', '--yes') == 1
    said = capfd.readouterr()
    assert 'deleted one' in said.out
    assert "there is no machine 'othr' (did you mean 'other'?)" in said.err
    machine('one')
    assert run('delete', 'one', 'all', '--yes') == 0
    assert not Cloud.machines and not Store().machines()


@pytest.mark.parametrize(('words', 'hint'), [
    (('status', 'slma'), "there is no machine 'slma' (did you mean 'slam'?)"),
    (('connect', 'slma'), "there is no machine 'slma' (did you mean 'slam'?)"),
    (('env', 'slma'), "no record of a machine 'slma' (did you mean 'slam'?)"),
    (('env', 'xyz'), "no record of a machine 'xyz' (ros2 fog list shows")])
def test_misspelt_machine_gets_the_nearest(words: Sequence[str], hint: str) -> None:
    record('slam')
    assert hint in str(run(*words))


def test_misspelt_verb_gets_the_nearest(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run('lst')
    said = capfd.readouterr().err
    assert "'lst' is no command of ros2 fog (did you mean 'list'? there are: " in said
    with pytest.raises(SystemExit):
        run('list', '--nothing')
    assert 'unrecognized arguments: --nothing' in capfd.readouterr().err


@pytest.mark.parametrize('words', [('shell', 'slam', '-h'), ('connect', 'slam', '--help')])
def test_help_after_a_name_is_help(
    words: Sequence[str], capfd: pytest.CaptureFixture[str],
) -> None:
    with contextlib.suppress(SystemExit):
        assert run(*words) == 0
    assert 'usage: ' in capfd.readouterr().out


def test_token_that_takes_long_has_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    class Slow(FakeShell):
        def run(self, command: Any, **_: Any) -> Result:
            raise DeadlineExceeded("read the token took too long on 'slam'")

    entry = Entry('slam', 'cloud', machine('slam'), record('slam', launch='abc123', agent='/run'))
    with pytest.raises(DeadlineExceeded, match='ros2 fog status slam'):
        access.token_of(entry, Slow(), 8765)


def test_port_of_a_launch_that_begins_meanwhile_stays_open(shells: list[Endpoint]) -> None:
    machine('slam')
    record('slam')
    with reach.session(reach.find('slam', pytest.fail)):
        record('slam', alive=True)
    assert [call[0] for call in Cloud.asked if call[0] != 'find'] == ['allow', 'connect']

# SPDX-License-Identifier: Apache-2.0
"""A clock that is wrong, on this robot or on a neighbour, ends and deletes nothing."""

from __future__ import annotations

import os
from pathlib import Path
import socket
import threading
import time

import paramiko
import pytest

from fogros2.errors import ConnectError
from fogros2.model import Endpoint, Machine, MachineSpec, MachineState
from fogros2.provider import TAG_EXPIRES, TAG_ROBOT
from fogros2.shell import ssh_connection
from fogros2.store import boot_id, Record, robot_id, Store
from ros2fog_cli.api import endings
from ros2fog_cli.api.machines import Entry


@pytest.mark.parametrize('armed', [0.0, 60.0])
def test_gc_keeps_a_machine_that_was_made_in_1970(armed: float) -> None:
    """By the robot's clock, that is; the provider knows better."""
    spec = MachineSpec('slam', 'fake', on_exit='keep', lifetime=3600.0)
    machine = Machine('id', 'slam', 'fake', MachineState.RUNNING, time.time() - 600, tags={
        TAG_ROBOT: robot_id(), TAG_EXPIRES: '3660'})
    entry = Entry('slam', 'fake', machine, Record(
        'slam', 'fake', spec, machine_id='id', created=60.0, armed=armed))
    assert endings.why_end(entry, time.time(), 86400.0) == ''


@pytest.mark.parametrize('state', [MachineState.RUNNING, MachineState.STOPPED])
def test_gc_keeps_a_machine_when_the_clock_is_set_forward(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, state: MachineState,
) -> None:
    """The times are of this boot, ten minutes ago, when the clock was ten days behind."""
    then = time.time() - 10 * 86400
    monkeypatch.setattr('fogros2.store.boot_clock', lambda: 600.0, raising=False)
    store = Store(tmp_path)
    record = store.save(Record(
        'slam', 'container', MachineSpec('slam', 'container', on_exit='keep', lifetime=3600.0),
        machine_id='id', created=then, armed=then, boot=boot_id()))
    os.utime(store.machine('slam') / 'record.json', (then, then))
    machine = Machine('id', 'slam', 'container', state, then, tags={TAG_ROBOT: robot_id()})
    entry = Entry('slam', 'container', machine, record)
    since = endings.stopped_at(machine, record, store)
    assert endings.why_end(entry, time.time(), 86400.0, since) == ''


def test_request_is_as_young_as_its_launch(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    """Its machine may still appear, although the clock was set forward by ten days."""
    monkeypatch.setattr('fogros2.store.boot_clock', lambda: 86400.0, raising=False)
    store = Store(tmp_path)
    store.set_aside(Record('cam', 'gcp', MachineSpec('cam', 'gcp'), last='abcdef', boot=boot_id(),
                           pid_start=(86400 - 30) * os.sysconf('SC_CLK_TCK')))
    (path,) = (tmp_path / 'requests').iterdir()
    os.utime(path, (time.time() - 10 * 86400,) * 2)
    ((_, age),) = store.requests()
    assert age == pytest.approx(30.0, abs=5.0)


class Silent(paramiko.ServerInterface):
    """An SSH server that does not decide about a key."""

    def __init__(self) -> None:
        self.over = threading.Event()

    def get_allowed_auths(self, username: str) -> str:
        return 'publickey'

    def check_auth_publickey(self, username: str, key: paramiko.PKey) -> int:
        self.over.wait(60.0)
        return paramiko.common.AUTH_FAILED


def test_login_ends_in_time_when_the_clock_is_set_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    key, silent, servers = paramiko.ECDSAKey.generate(), Silent(), []
    key.write_private_key_file(str(tmp_path / 'key'))
    said: list[str] = []

    def serve() -> None:
        servers.append(paramiko.Transport(listener.accept()[0]))
        servers[0].add_server_key(key)
        servers[0].start_server(server=silent)

    def connect() -> None:
        with pytest.raises(ConnectError) as caught:
            ssh_connection.connect(endpoint, name='slam', timeout=3.0)
        said.append(str(caught.value))

    with socket.create_server(('127.0.0.1', 0)) as listener:
        endpoint = Endpoint('ssh', '127.0.0.1', listener.getsockname()[1], 'fog',
                            f'{key.get_name()} {key.get_base64()}', str(tmp_path / 'key'))
        threading.Thread(target=serve, daemon=True).start()
        begin, real = time.monotonic(), time.time
        monkeypatch.setattr(time, 'time', lambda: real() - 100 * (time.monotonic() - begin))
        login = threading.Thread(target=connect, daemon=True)
        login.start()
        login.join(60.0)
        silent.over.set()
    for server in servers:
        server.close()
    assert said and 'did not complete the login within 9 s' in said[0]

# SPDX-License-Identifier: Apache-2.0
"""The door of guests' nodes: it opens to the guest of an address alone, and says nothing else."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import hmac
import json
from pathlib import Path
import socket
import subprocess
import threading

import pytest

from fogros2.errors import AuthenticationError, ConnectError
from fogros2.model import Command, Endpoint
from fogros2.waiting import wait_until
from fogros2_features.guests import program as guests
from fogros2_features.guests.shell import admitted, GuestShell

SECRET, OTHER = '5a' * 32, 'b7' * 32
ME = '127.0.0.1'


class Door(guests.Door):
    """A door whose rooms are this test's own account."""

    begun = 0
    trouble = ''

    def begin(self, link: socket.socket, user: str) -> subprocess.Popen[bytes]:
        if self.trouble:
            raise OSError(self.trouble)
        self.begun += 1
        link.settimeout(None)
        link.sendall(b'\n')
        return subprocess.Popen(('python3', '-IS', '-c', self.request['shell']), stdin=link,
                                stdout=link, stderr=subprocess.DEVNULL)


def guest(address: str = ME, secret: str = SECRET) -> guests.Guest:
    return {'key': 'key=', 'address': address, 'secret': secret}


@pytest.fixture
def door(tmp_path: Path) -> Iterator[Door]:
    from fogros2.shell import multiplexer
    listed = guests.Guests('fogabc123m0', tmp_path)
    listed.state.write_text(json.dumps([guest(), guest('127.0.0.2', OTHER)]))
    (tmp_path / 'agent.py').write_text('')
    found = Door(listed, {
        'address': ME, 'port': 0, 'agent': str(tmp_path / 'agent.py'),
        'shell': Path(multiplexer.__file__).read_text()})
    thread = threading.Thread(target=found.serve_forever, kwargs={'poll_interval': 0.01})
    thread.start()
    yield found
    found.shutdown()
    thread.join()
    found.server_close()


def connect(door: Door, source: str = ME) -> socket.socket:
    link = socket.create_connection(door.server_address, 5.0, (source, 0))  # type: ignore
    link.settimeout(60.0)
    return link


def read(link: socket.socket, size: int = 99) -> bytes:
    data = b''
    with contextlib.suppress(ConnectionError):
        while len(data) < size and (more := link.recv(size - len(data))):
            data += more
    return data


def answer(secret: str, challenge: bytes) -> bytes:
    return hmac.digest(bytes.fromhex(secret), challenge, 'sha256')


@pytest.mark.parametrize('proof', [
    lambda challenge: answer(OTHER, challenge), lambda challenge: bytes(32),
    lambda challenge: answer(SECRET, bytes(32)), lambda challenge: challenge])
def test_wrong_proof_gets_no_answer(door: Door, proof) -> None:
    with connect(door) as link:
        link.sendall(proof(read(link, 32)))
        assert read(link) == b''
    assert door.begun == 0


def test_proof_of_another_connection_gets_no_answer(door: Door) -> None:
    with connect(door) as first, connect(door) as second:
        proof = answer(SECRET, read(first, 32))
        assert len(read(second, 32)) == 32
        second.sendall(proof)
        assert read(second) == b''
    assert door.begun == 0


def test_secret_opens_from_its_own_address_alone(door: Door) -> None:
    with connect(door, '127.0.0.2') as link:
        link.sendall(answer(SECRET, read(link, 32)))
        assert read(link) == b''
    with connect(door, '127.0.0.3') as link:
        assert read(link) == b'', 'a stranger gets not even a challenge'
    assert door.begun == 0


def test_guest_that_is_revoked_meanwhile_gets_no_answer(door: Door) -> None:
    with connect(door) as link:
        challenge = read(link, 32)
        door.guests.state.write_text('[]')
        link.sendall(answer(SECRET, challenge))
        assert read(link) == b''
    assert door.begun == 0


def test_silent_and_endless_guests_hold_no_connection(
    door: Door, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(guests, 'PROOF_TIMEOUT', 0.2)
    with connect(door) as link:
        assert len(read(link)) == 32, 'closed without a proof'
    with connect(door) as link:
        read(link, 32)
        with contextlib.suppress(ConnectionError):
            link.sendall(bytes(1 << 20))
        assert read(link) == b''
    wait_until(lambda: not door.open[ME], timeout=60.0, what='the connections to end')


def test_guest_has_a_bounded_number_of_connections(door: Door) -> None:
    with contextlib.ExitStack() as undo:
        for _ in range(guests.CONNECTIONS):
            assert len(read(undo.enter_context(connect(door)), 32)) == 32
        assert read(undo.enter_context(connect(door))) == b''
        assert len(read(undo.enter_context(connect(door, '127.0.0.2')), 32)) == 32


def endpoint(door: Door, tmp_path: Path, secret: str = SECRET) -> Endpoint:
    (tmp_path / 'secret').write_text(secret)
    return Endpoint('guest', ME, door.server_address[1], 'root', key_file=str(
        tmp_path / 'secret'))


def test_shell_of_a_guest_runs_commands(door: Door, tmp_path: Path) -> None:
    import os
    import pwd
    user = pwd.getpwuid(os.geteuid()).pw_name
    place = endpoint(door, tmp_path)
    shell = GuestShell(Endpoint(place.kind, place.host, place.port, user,
                                key_file=place.key_file), name='theirs')
    try:
        assert shell.run(Command(('echo', 'a')), timeout=60.0).stdout == 'a\n'
        assert shell.run(Command(('cat',), input=b'b'), timeout=60.0).stdout == 'b'
        assert 'FOGROS2_ROOT' not in shell.run(Command(('env',)), timeout=60.0).stdout
        assert door.begun == 1
    finally:
        shell.close()


def test_refused_shell_is_one_clear_error(door: Door, tmp_path: Path) -> None:
    with pytest.raises(AuthenticationError, match="'theirs' refuses this invitation"):
        GuestShell(endpoint(door, tmp_path, OTHER), name='theirs').run(
            Command(('true',)), timeout=60.0)
    door.trouble = 'no room\x1b[2J'
    with pytest.raises(ConnectError, match="'theirs' has no room for this computer: no room") \
            as raised:
        GuestShell(endpoint(door, tmp_path), name='theirs').run(Command(('true',)), timeout=60.0)
    assert '\x1b' not in str(raised.value)


def test_door_that_does_not_answer_refuses_no_invitation(tmp_path: Path) -> None:
    (tmp_path / 'secret').write_text(SECRET)
    with socket.create_server((ME, 0)) as silent:
        place = Endpoint('guest', ME, silent.getsockname()[1], 'root', key_file=str(
            tmp_path / 'secret'))
        with pytest.raises(ConnectError, match="'theirs' does not answer: timed out"):
            admitted(place, 'theirs', 0.05)

# SPDX-License-Identifier: Apache-2.0
"""Output that nobody reads, and odd frames, take no memory and leave no caller waiting."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
from pathlib import Path
import socket
import struct
import threading

import paramiko
import pytest

from fogros2.errors import ConnectError, DeadlineExceeded
from fogros2.model import Command, Endpoint
from fogros2.shell import multiplexed, proxy, ssh_connection
from fogros2.shell import multiplexer as mux
from fogros2.shell.remote import MultiplexedShell
from fogros2.shell.ssh import SSHShell
from fogros2.waiting import in_thread
from rigs.memory import measure

LIMIT = 100e6
#: A hijacked machine sends so much in pieces of so many bytes.
AMOUNT, PIECE = 200 << 20, 1 << 15

#: Reads lines of an agent's stream that never come; prints whether the stream has ended.
READS = """\
import threading
from fogros2.model import Command, Endpoint
{connect}
# attack
stream = shell.open(Command(('agent',), input=b'x'))
print(stream.readline().endswith(b'\\n'))
"""
BY_LINK = """\
import socket
from fogros2.shell.multiplexed import Link
from fogros2.shell.remote import MultiplexedShell
class Shell(MultiplexedShell):
    def _connect(self, timeout, cancel):
        return Link(socket.create_connection(('127.0.0.1', {port})), self.name, self.user)
shell = Shell(Endpoint('guest'), name='planner')
"""
BY_SSH = """\
from fogros2.shell.ssh import SSHShell
shell = SSHShell(Endpoint('ssh', '127.0.0.1', {port}, 'fog', {host_key!r}, {key!r}),
                 name='planner')
"""


@contextlib.contextmanager
def serving(answer: Callable[[socket.socket], None]) -> Iterator[int]:
    """Answer one connection to a loopback port in a thread; yield the port."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        def serve() -> None:
            link, _ = server.accept()
            with link, contextlib.suppress(OSError, EOFError, paramiko.SSHException):
                answer(link)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield server.getsockname()[1]
    thread.join(30)


@pytest.mark.parametrize('kind', [mux.OUT, mux.ERR])
def test_pod_that_ignores_its_window_fills_no_memory(kind: int, tmp_path: Path) -> None:
    def flood(link: socket.socket) -> None:
        link.recv(1 << 16)
        piece = mux.frame(kind, 1, bytes(PIECE))
        for _ in range(AMOUNT // PIECE):
            link.sendall(piece)

    with serving(flood) as port:
        taken, said = measure(READS.format(connect=BY_LINK.format(port=port)), tmp_path)
    assert said == ['False'] and taken < LIMIT


class Server(paramiko.ServerInterface):
    """An SSH server that runs every command."""

    def check_auth_publickey(self, username: str, key: paramiko.PKey) -> int:
        return paramiko.AUTH_SUCCESSFUL

    def get_allowed_auths(self, username: str) -> str:
        return 'publickey'

    def check_channel_request(self, kind: str, chanid: int) -> int:
        return paramiko.OPEN_SUCCEEDED

    def check_channel_exec_request(self, channel: paramiko.Channel, command: bytes) -> bool:
        return True


def pieces(channel: paramiko.Channel, kind: int) -> paramiko.Message:
    message = paramiko.Message()
    message.add_byte(bytes([kind]))
    message.add_int(channel.remote_chanid)  # type: ignore[attr-defined]
    if kind == 95:  # extended data
        message.add_int(1)
    message.add_string(bytes(PIECE))
    return message


@pytest.mark.parametrize('kind', [94, 95])
def test_ssh_server_that_ignores_its_window_fills_no_memory(kind: int, tmp_path: Path) -> None:
    key = paramiko.ECDSAKey.generate()
    key.write_private_key_file(str(tmp_path / 'key'))

    def flood(link: socket.socket) -> None:
        transport = paramiko.Transport(link)
        try:
            transport.add_server_key(key)
            transport.start_server(server=Server())
            channel = transport.accept(30)
            assert channel is not None and channel.recv(1), 'the command has started'
            for _ in range(AMOUNT // PIECE):
                transport._send_user_message(pieces(channel, kind))  # type: ignore[attr-defined]
        finally:
            transport.close()

    with serving(flood) as port:
        taken, said = measure(READS.format(connect=BY_SSH.format(
            port=port, key=str(tmp_path / 'key'),
            host_key=f'{key.get_name()} {key.get_base64()}')), tmp_path)
    assert said == ['False'] and taken < LIMIT


def test_packet_that_an_ssh_server_announces_takes_no_memory(tmp_path: Path) -> None:
    def announce(link: socket.socket) -> None:
        link.sendall(b'SSH-2.0-x\r\n' + struct.pack('>I', 0xfffffff4))
        for _ in range(AMOUNT // PIECE):
            link.sendall(bytes(PIECE))

    with serving(announce) as port:
        code = READS.format(connect=BY_SSH.format(port=port, key=None, host_key='ssh-ed25519 AA'))
        taken, said = measure(code.replace('stream = shell.open', """\
shell._timeout = 5.0
try:
    shell.open(Command(('agent',)))
except Exception as error:
    print(type(error).__name__)
raise SystemExit(print(peak() - before))
shell.open"""), tmp_path)
    assert said == ['ConnectError'] and taken < LIMIT


def test_packet_that_comes_through_a_proxy_takes_no_memory() -> None:
    program = r"printf 'SSH-2.0-x\r\n\377\377\377\364'; exec cat /dev/zero"
    with contextlib.closing(proxy.dial(Command(('sh', '-c', program)), 5.0)) as link, \
            contextlib.closing(ssh_connection.transport_over(link)) as transport, \
            pytest.raises(EOFError, match='a packet of'):
        transport.start_client(timeout=10.0)


#: Copies a folder to a machine whose rsync writes errors without end.
COPIES = f"""\
import os
from pathlib import Path
from fogros2.errors import FogError
from fogros2.shell import relay, sync
from fogros2.model import Endpoint
Path('source').mkdir()
class Shell(sync.RsyncShell):
    endpoint, where = Endpoint('guest'), "'planner'"
    def run(self, command, **options):
        return type('Done', (), {{'stdout': ''}})
    open = interactive = close = None
    def _remote_shell(self):
        def flood(line, stdin, stdout, stderr):
            for _ in range({AMOUNT} // {PIECE}):
                os.write(stderr, {'bytes(%d)' % PIECE})
            return 1
        return relay.remote_shell(flood)
# attack
try:
    Shell().sync(Path('source'), '/target', excludes=(), timeout=60.0)
except FogError as error:
    print(type(error).__name__)
"""


def test_rsync_that_only_complains_fills_no_memory(tmp_path: Path) -> None:
    taken, said = measure(COPIES, tmp_path)
    assert said == ['ConnectError'] and taken < LIMIT


@pytest.fixture
def linked() -> Iterator[tuple[multiplexed.Link, socket.socket]]:
    ours, theirs = socket.socketpair()
    link = multiplexed.Link(ours, 'planner', 'fog')
    with theirs:
        yield link, theirs
        link.close()


@pytest.mark.parametrize('frame', [
    mux.frame(99, 1, b'x'), mux.frame(mux.OPEN, 1, b'x'), mux.frame(mux.EXIT, 1, b'x'),
    mux.frame(mux.WINDOW, 1, b''), mux.HEADER.pack(mux.OUT, 1, mux.LARGEST + 1)])
def test_odd_frame_ends_the_connection_with_one_error(
    linked: tuple[multiplexed.Link, socket.socket], frame: bytes,
) -> None:
    link, machine = linked
    channel = link.open(Command(('true',)))
    channel.settimeout(60.0)
    machine.sendall(frame)
    assert channel.recv(1) == b'' and channel.recv_exit_status() == -1
    with pytest.raises(ConnectError, match="the connection to 'planner' was lost: "):
        link.open(Command(('true',)))
    assert not link.is_alive()


def test_machine_that_takes_no_input_holds_no_command(
    linked: tuple[multiplexed.Link, socket.socket], monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mux, 'CREDIT', 100)
    link, _ = linked

    class Shell(MultiplexedShell):
        def _connect(self, *args: object) -> multiplexed.Link:
            return link

    shell = Shell(Endpoint('guest'), name='planner')
    begun = in_thread(lambda: shell.run(Command(('cat',), input=bytes(200)), timeout=0.1))
    with pytest.raises(DeadlineExceeded, match="cat took too long on 'planner'"):
        begun.result(5.0)


def test_ssh_server_that_never_answers_holds_no_command(tmp_path: Path) -> None:
    key = paramiko.ECDSAKey.generate()
    key.write_private_key_file(str(tmp_path / 'key'))
    over = threading.Event()

    class Silent(Server):
        def check_channel_exec_request(self, channel: paramiko.Channel, command: bytes) -> bool:
            return over.wait(60)

    def answer(link: socket.socket) -> None:
        transport = paramiko.Transport(link)
        transport.add_server_key(key)
        transport.start_server(server=Silent())
        over.wait(60)
        transport.close()

    with serving(answer) as port:
        shell = SSHShell(Endpoint(
            'ssh', '127.0.0.1', port, 'fog', f'{key.get_name()} {key.get_base64()}',
            str(tmp_path / 'key')), name='planner')
        with pytest.raises(DeadlineExceeded, match="'planner' has not begun a command within 1 s"):
            in_thread(lambda: shell.run(Command(('true',)), timeout=1.0)).result(10.0)
        over.set()
        shell.close()


def test_proxy_that_takes_nothing_ends_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hijacked machine reads nothing; paramiko repeats a write that timed out for good."""
    monkeypatch.setattr(proxy, 'STUCK', 0.1)
    with contextlib.closing(proxy.dial(Command(('sleep', '60')), 0.02)) as link:
        def fill() -> None:
            while True:
                with contextlib.suppress(TimeoutError):
                    link.send(bytes(1 << 16))

        with pytest.raises(ConnectionAbortedError, match='takes nothing'):
            in_thread(fill).result(10.0)

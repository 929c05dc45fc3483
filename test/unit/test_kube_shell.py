# SPDX-License-Identifier: Apache-2.0
"""The multiplexer that runs in pods, and the robot's end of it, over pipes of this computer."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path
import resource
import socket
import subprocess
import sys
import threading
import time

import pytest

from fogros2 import kubernetes_client
from fogros2.errors import Cancelled, ConnectError, ShellError
from fogros2.kubernetes_client import ApiError, Unreachable
from fogros2.model import Command, Endpoint
from fogros2.shell import kubernetes_link, relay
from fogros2.shell.kubernetes import KubernetesShell
from fogros2.waiting import in_thread, ON_ITS_WAY, wait_until
from fogros2_testing.shell_contract import raised

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0, reason='needs root: the multiplexer changes to other users')


class Pipe:
    """What ``exec`` and a WebSocket do: a program's streams, in numbered messages."""

    def __init__(self, argv: list[str]) -> None:
        self.sock, self._far = socket.socketpair()
        self.child = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        threading.Thread(target=self._pump, daemon=True).start()

    def _pump(self) -> None:
        with contextlib.suppress(OSError), self._far:
            while data := os.read(self.child.stdout.fileno(), 1 << 15):
                self._far.sendall(len(data).to_bytes(4, 'big') + data)

    def settimeout(self, timeout: float | None) -> None:
        self.sock.settimeout(timeout)

    def send_binary(self, data: bytes) -> None:
        assert data[0] == 0
        self.child.stdin.write(data[1:])
        self.child.stdin.flush()

    def recv(self) -> bytes:
        head = self._exactly(4)
        return b'\1' + self._exactly(int.from_bytes(head, 'big')) if head else b''

    def _exactly(self, size: int) -> bytes:
        data = b''
        while len(data) < size:
            more = self.sock.recv(size - len(data))
            if not more:
                return b''
            data += more
        return data

    def stand_still(self) -> None:
        """Have the beginning of a message arrive, and nothing after it."""
        self._far.sendall(b'\0')

    def cut(self) -> None:
        """Lose both ends' streams, whatever was under way."""
        with contextlib.suppress(OSError):
            self.sock.shutdown(socket.SHUT_RDWR)
        with contextlib.suppress(OSError):
            self.child.stdin.close()

    def close(self, timeout: float | None = None) -> None:
        self.cut()
        self.sock.close()
        try:
            self.child.wait(5.0)  # it ends what it has started
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()


class FakeApi(kubernetes_client.Api):
    """An API server that runs commands here, or refuses."""

    def __init__(self) -> None:
        self._lost = -kubernetes_client.DOUBT
        self.links: list[Pipe] = []
        self.refusals: list[Exception] = []
        self.forbidden = False

    def request(self, method: str, path: str, *rest, **more) -> dict:
        assert (method, path) == ('GET', '/api/v1/namespaces/robots/pods/a-pod')
        if self.forbidden:
            raise ApiError('cannot get resource "pods"', status=403)
        return {}

    def websocket(self, path: str, query: dict, *, timeout: float) -> Pipe:
        assert path == '/api/v1/namespaces/robots/pods/a-pod/exec'
        if self.refusals:
            raise self.refusals.pop(0)
        self.links.append(Pipe([sys.executable, *query['command'][1:]]))
        return self.links[-1]

    def cut(self) -> None:
        """Break the connection, as an API server does that restarts."""
        self.links[-1].cut()


@pytest.fixture
def api(monkeypatch):
    fake = FakeApi()
    monkeypatch.setattr(kubernetes_client, 'connect', lambda context='': fake)
    yield fake
    for link in fake.links:
        link.close()


@pytest.fixture
def shell(api):
    found = KubernetesShell(
        Endpoint('kubernetes', 'robots/a-pod@a context', user='root'), name='talker')
    yield found
    found.close()


def ended(number: int) -> None:
    """Wait for a process to end."""
    def over() -> bool:
        try:
            return 'Z' in Path(f'/proc/{number}/stat').read_text().split()[2]
        except (FileNotFoundError, ProcessLookupError):
            return True

    wait_until(over, timeout=60.0, what='the command to end')


def test_commands_share_one_exec(api, shell):
    for number in range(20):
        assert shell.run(Command(('echo', str(number))), timeout=60.0).stdout == f'{number}\n'
    assert len(api.links) == 1


def test_broken_connection_fails_the_command_alone(api, shell):
    """As over SSH; the agent's sequence numbers carry its events over the loss."""
    error = raised(ConnectError, lambda: shell.run(
        Command(('sh', '-c', 'echo begun; exec sleep 30'), what='a step'),
        timeout=30.0, on_output=lambda _: api.cut()))
    assert 'lost while a step ran there' in str(error)
    assert shell.run(Command(('echo', 'x')), timeout=60.0).stdout == 'x\n'
    assert len(api.links) == 2


@pytest.mark.parametrize('end', [lambda api, shell: api.cut(), lambda api, shell: shell.close()])
def test_end_of_a_connection_ends_its_commands(api, shell, tmp_path, end):
    pid = tmp_path / 'pid'
    stream = shell.open(Command(('sh', '-c', f'echo $$ >{pid}; echo up; exec sleep 60')))
    assert stream.readline() == b'up\n'
    end(api, shell)
    ended(int(pid.read_text()))
    assert stream.readline() == b''


def test_incomplete_message_does_not_block_others(api, shell, monkeypatch):
    monkeypatch.setattr(kubernetes_link, 'STALL', 0.3)
    assert shell.run(Command(('echo', 'one')), timeout=60.0).stdout == 'one\n'
    api.links[-1].stand_still()
    with contextlib.suppress(ConnectError):  # the message may stop before or after it begins
        shell.run(Command(('echo', 'two')), timeout=60.0)
    assert shell.run(Command(('echo', 'three')), timeout=60.0).stdout == 'three\n'
    assert len(api.links) == 2
    api.links[-1].stand_still()
    in_thread(shell.close).result(60.0)


def test_restart_of_the_api_server_is_waited_for(api, shell):
    api.refusals = [Unreachable('refused'), ApiError('no', status=503), Unreachable('refused')]
    assert shell.run(Command(('echo', 'x')), timeout=20.0).stdout == 'x\n'


def test_ctrl_c_ends_the_wait_for_a_silent_cluster(api, shell):
    api.refusals += [Unreachable('refused')] * 1000
    cancel, before = threading.Event(), threading.active_count()
    asking = in_thread(lambda: shell.run(Command(('true',)), timeout=30.0, cancel=cancel))
    wait_until(lambda: len(api.refusals) < 1000, timeout=60.0, what='an attempt')
    with pytest.raises(ConnectError):
        shell.run(Command(('true',)), timeout=0.2)  # one attempt at a time; its own patience
    in_thread(shell.close).result(60.0)
    assert not asking.done()
    cancel.set()
    assert isinstance(asking.exception(60.0), Cancelled)
    wait_until(lambda: threading.active_count() <= before, timeout=60.0,
               what='the thread that connects to end')


def test_ctrl_c_ends_an_exec_that_never_begins(api, shell, monkeypatch):
    cancel, let_go, made = threading.Event(), threading.Event(), api.websocket

    def slow(*words: object, **options: object) -> Pipe:
        cancel.set()
        let_go.wait(60.0)
        return made(*words, **options)

    monkeypatch.setattr(api, 'websocket', slow)
    begin = time.monotonic()
    raised(Cancelled, lambda: shell.run(Command(('true',)), timeout=30.0, cancel=cancel))
    assert time.monotonic() - begin < ON_ITS_WAY
    let_go.set()
    # a connection that stands after all is nobody's: it is closed
    wait_until(lambda: api.links and api.links[0].child.poll() is not None, timeout=60.0,
               what='its exec to end')


@pytest.mark.parametrize('noticed', [True, False])
def test_refusal_after_a_restart_is_retried(api, shell, noticed):
    """Its list of who may what is empty at first."""
    if noticed:
        api.lost()
    api.forbidden = not noticed
    api.refusals = [ApiError('cannot create resource "pods/exec"', status=403)] * 2
    assert shell.run(Command(('echo', 'x')), timeout=20.0).stdout == 'x\n'


@pytest.mark.parametrize(('refusal', 'words'), [
    (ApiError('cannot create resource "pods/exec"', status=403), 'pods/exec'),
    (ApiError('pods "a-pod" not found', status=404, reason='NotFound'), 'is gone')])
def test_lasting_refusal_is_reported_at_once(api, shell, refusal, words):
    api.refusals = [refusal]
    error = raised(ShellError, lambda: shell.run(Command(('true',)), timeout=20.0))
    assert words in f'{error} {error.hint}'


def test_commands_run_as_login_user_or_on_request_as_root(api):
    shell = KubernetesShell(Endpoint('kubernetes', 'robots/a-pod@', user='nobody'), name='talker')
    with contextlib.closing(shell):
        assert shell.run(Command(('id', '-un')), timeout=60.0).stdout == 'nobody\n'
        assert shell.run(Command(('id', '-un'), sudo=True), timeout=60.0).stdout == 'root\n'
        told = shell.run(Command(('sh', '-c', 'echo $USER $FOGROS2_ROOT')), timeout=60.0)
        assert told.stdout == 'nobody yes\n'


def test_login_shell_that_cannot_start_ends_no_other_command(api):
    shell = KubernetesShell(Endpoint('kubernetes', 'robots/a-pod@', user='stranger'), name='m')
    with contextlib.closing(shell):
        link = shell._connected(10.0)
        channel = link.open(None)
        assert b'login shell: ' in channel.recv_stderr(1000) and channel.recv(1000) == b''
        assert channel.recv_exit_status() == 126 and link.is_alive()
        assert shell.run(Command(('true',), sudo=True), timeout=60.0).returncode == 0


def test_unread_output_stops_only_its_program(api, shell):
    stream = shell.open(Command(('yes',)))
    assert stream.readline() == b'y\n'
    for _ in range(50):
        assert shell.run(Command(('echo', 'x')), timeout=60.0).stdout == 'x\n'
    stream.close()
    # all that came before it was stopped fits into what a channel may have under way
    assert shell.run(Command(('true',)), timeout=60.0).returncode == 0


def test_terminal_follows_the_users_size(api, shell):
    link = shell._connected(10.0)
    channel = link.open(Command(('sh',)), (24, 80, 'xterm'))

    def answer(text: bytes, word: bytes) -> bytes:
        channel.sendall(text)
        got = b''
        channel.settimeout(60.0)
        while word not in got:
            out = channel.recv(1000)
            assert out, got
            got += out
        return got

    assert b'24 80' in answer(b'stty size; echo do""ne\n', b'done')
    channel.resize_pty(132, 43)
    assert b'43 132' in answer(b'stty size; echo a""gain\n', b'again')
    assert b'xterm' in answer(b'echo $TERM; echo la""st\n', b'last')
    answer(b'exit 7\n', b'exit 7')
    while channel.recv(1000):
        pass
    assert channel.recv_exit_status() == 7
    channel.close()


def relayed(shell, script: str, given: bytes | None, least: int = 0) -> tuple[int, bytes]:
    """Relay to a script; None keeps the input open. Return its exit status and output."""
    begin, *streams = [*os.pipe(), *os.pipe()]
    streams.insert(0, fcntl.fcntl(begin, fcntl.F_DUPFD, least))
    os.close(begin)
    try:
        channel = shell._connected(10.0).open(Command(('sh', '-c', script)))
        if given is not None:
            os.write(streams[1], given)
            os.close(streams.pop(1))
        status = relay.relay(channel, streams[0], streams[-1], streams[-1])
        os.set_blocking(streams[-2], False)
        with contextlib.suppress(BlockingIOError):
            return status, os.read(streams[-2], 1000)
        return status, b''
    finally:
        for stream in streams:
            os.close(stream)


def test_input_and_output_are_relayed_until_the_command_ends(api, shell):
    assert relayed(shell, 'cat; exit 5', b'keys') == (5, b'keys')
    assert relayed(shell, 'echo done', None) == (0, b'done\n')


def test_input_is_relayed_in_a_process_with_many_files(api, shell):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    try:
        assert relayed(shell, 'cat', b'keys', least=1100) == (0, b'keys')
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_host_of_an_endpoint_names_a_pod():
    assert kubernetes_link.parse_host('robots/pod@') == ('', 'robots', 'pod')
    context = 'arn:aws:eks:x:1:cluster/a@b'
    assert kubernetes_link.parse_host(f'robots/pod@{context}') == (context, 'robots', 'pod')
    raised(ConnectError, lambda: kubernetes_link.parse_host('198.51.100.7'))

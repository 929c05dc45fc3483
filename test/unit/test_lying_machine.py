# SPDX-License-Identifier: Apache-2.0
"""What a hijacked machine may say, and the robot's launch goes on."""

from __future__ import annotations

import os
import socket
import threading
from types import SimpleNamespace

import pytest

pytest.importorskip('launch.actions', reason='launch is not installed')

from fogros2.errors import AgentError, ConnectError
from fogros2.model import Command, Endpoint, MachineSpec
from fogros2.shell import lines, relay, ssh_connection
from fogros2.shell.ssh import SSHShell
from fogros2_testing.fakes import FakeProvider
from rigs import deploying


class Endless:
    """A channel on which no line ever ends."""

    closed = False

    def recv(self, size):
        return b'x' * size

    def recv_stderr_ready(self):
        return False

    def sendall(self, data):
        raise AssertionError(data)

    def close(self):
        self.closed = True


def test_a_line_without_an_end_fills_no_memory(monkeypatch):
    monkeypatch.setattr(lines, 'MAX_LINE', 1 << 20)
    channel = Endless()
    assert lines.LineStream(channel, 'planner').readline() == b''
    assert channel.closed


def test_first_line_of_a_command_is_a_number_or_nothing():
    output = lines.Output(None, announced=True)
    for _ in range(100):
        output.add(b'9' * (1 << 16))
    kept = vars(output)['_head']
    output.add(b'\nwords\n')
    assert (output.pid, output.text()[0], len(kept) < 100) == (0, 'words\n', True)


class Told:
    """An agent that says what a test tells it to."""

    silent_for = 0.0

    def subscribe(self, callback, since):
        self.callback, self.since = callback, since


@pytest.mark.parametrize(('error', 'why'), [
    (ConnectionResetError(), 'it ended'), (OSError('Socket is closed'), 'Socket is closed')])
def test_a_connection_that_ends_while_a_line_is_written_is_gone(error, why):
    def sendall(data):
        raise error

    stream = lines.LineStream(SimpleNamespace(sendall=sendall), 'planner')
    with pytest.raises(ConnectError, match=f"the connection to 'planner' is gone: {why}"):
        stream.write(b'line')


@pytest.mark.parametrize('receives', [True, False])
def test_channel_of_a_lost_connection_closes(monkeypatch, receives):
    """Paramiko sends a message for it; the thread that watches the agent went on no longer."""
    def fail(*words):
        raise ConnectionResetError

    channel = SimpleNamespace(
        close=fail, sendall=fail, send=fail, shutdown_write=fail,
        settimeout=lambda seconds: None, recv=fail if receives else lambda size: b'',
        recv_stderr=fail if receives else lambda size: b'', recv_stderr_ready=lambda: False,
        exit_status_ready=lambda: False, recv_exit_status=lambda: -1, eof_received=False,
        status_event=threading.Event(), get_transport=lambda: SimpleNamespace(
            is_alive=lambda: False))
    lines.LineStream(channel, 'planner').close()
    with open(os.devnull, 'r+b') as null:
        assert relay.relay(channel, *[null.fileno()] * 3) == 255
    shell = SSHShell(Endpoint('ssh', '198.51.100.1'), name='planner')
    monkeypatch.setattr(shell, 'start', lambda *words: channel)
    with pytest.raises(ConnectError, match='was lost while'):
        shell.run(Command(('true',)), timeout=5.0)


def test_key_exchange_without_an_end_is_a_lost_connection():
    """The server may ask for new keys at any time, and then be silent."""
    paramiko = pytest.importorskip('paramiko')
    ours, theirs = socket.socketpair()
    with ours, theirs:
        transport = ssh_connection.transport_over(ours)
        transport.active, transport.clear_to_send_timeout = True, 0.0
        channel = paramiko.Channel(0)
        channel._set_transport(transport)
        channel._set_window(1 << 16, 1 << 15)
        channel._set_remote_channel(0, 1 << 16, 1 << 15)
        stream = lines.LineStream(channel, 'planner')
        with pytest.raises(ConnectError, match='is gone: Key-exchange timed out'):
            stream.write(b'line')
        stream.close()
        transport.close()


@pytest.mark.parametrize(('cut', 'timeout'), [(False, 1.0), (True, 60.0)])
def test_login_that_the_network_interrupts_refuses_no_key(tmp_path, cut, timeout):
    """The server is silent about the key, or its connection ends."""
    paramiko = pytest.importorskip('paramiko')
    key, over, servers = paramiko.ECDSAKey.generate(), threading.Event(), []
    key.write_private_key_file(str(tmp_path / 'key'))

    class Server(paramiko.ServerInterface):
        def get_allowed_auths(self, username):
            return 'publickey'

        def check_auth_publickey(self, username, key):
            if cut:
                servers[0].sock.close()
            over.wait(60.0)
            return paramiko.common.AUTH_FAILED

    def serve():
        servers.append(paramiko.Transport(listener.accept()[0]))
        servers[0].add_server_key(key)
        servers[0].start_server(server=Server())

    with socket.create_server(('127.0.0.1', 0)) as listener:
        threading.Thread(target=serve, daemon=True).start()
        endpoint = Endpoint('ssh', '127.0.0.1', listener.getsockname()[1], 'fog',
                            f'{key.get_name()} {key.get_base64()}', str(tmp_path / 'key'))
        with pytest.raises(ConnectError):
            ssh_connection.connect(endpoint, name='planner', timeout=timeout)
    over.set()
    servers[0].close()


def test_gone_connection_is_an_oserror_of_its_channels():
    """Reading, too, sends a message, which makes room for more."""
    paramiko = pytest.importorskip('paramiko')
    ours, theirs = socket.socketpair()
    with ours:
        theirs.close()
        transport = ssh_connection.transport_over(ours)
        transport.active = True
        transport.clear_to_send.set()
        with pytest.raises(ConnectionResetError):
            transport._send_user_message(paramiko.Message(b'1'))
        transport.close()


def test_command_starts_anew_after_its_connection_was_closed(monkeypatch):
    """By another thread, say; is_alive() still says yes then."""
    transport = SimpleNamespace(is_alive=lambda: True, close=lambda: None)
    started = []

    def channel(fails):
        def exec_command(line):
            if fails:
                raise EOFError
            started.append(line)
        return SimpleNamespace(exec_command=exec_command)

    shell = SSHShell(Endpoint('ssh', '127.0.0.1', 22, 'fog'), name='planner')
    channels = iter([channel(True), channel(False), channel(True), channel(True)])
    monkeypatch.setattr(shell, '_connect', lambda *_: transport)
    monkeypatch.setattr(shell, '_session', lambda *_: next(channels))
    shell.start('true')
    assert len(started) == 1 and 'exec true' in started[0]
    with pytest.raises(ConnectError, match='can not start a command'):
        shell.start('true')


def test_machine_lost_at_subscription_affects_no_other(
        tmp_path, monkeypatch):
    heard = []
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(owned=False))

    class Closing(Told):
        def subscribe(self, callback, since):
            machine._is_over('deleted', 'it was deleted')
            raise AgentError('the connection to the agent was closed')

        def close(self):
            pass

    _, machine = deploying.job(tmp_path, MachineSpec('planner', 'fake'))
    machine.agent = Closing()
    machine.subscribe(heard.append)
    assert heard == [{'event': 'lost', 'reason': 'it was deleted'}]

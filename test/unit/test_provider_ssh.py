# SPDX-License-Identifier: Apache-2.0
"""Tests of the provider for computers that exist already."""

from __future__ import annotations

import contextlib
from pathlib import Path
import socket
import time
from types import SimpleNamespace

import pytest

from fogros2.errors import ConfigurationError, ConnectError, MachineNotFound, ProviderError
from fogros2.model import MachineSpec, MachineState
from fogros2.provider.ssh import Options, reach, SSHProvider
from fogros2.shell import ssh_config, ssh_connection
from fogros2_testing import ProviderContract, request_for


@pytest.fixture
def listener():
    with socket.create_server(('127.0.0.1', 0)) as server:
        yield server


class TestSSHProvider(ProviderContract):

    @pytest.fixture(autouse=True)
    def server(self, listener):
        self.port = listener.getsockname()[1]

    def make(self):
        return SSHProvider(), {'host': '127.0.0.1', 'port': self.port}


def test_everything_is_in_the_id(listener, tmp_path):
    (tmp_path / 'a key').write_text('')
    port = listener.getsockname()[1]
    spec = MachineSpec('planner', 'ssh', {
        'host': '127.0.0.1', 'port': port, 'user': 'me', 'key': str(tmp_path / 'a key'),
        'host_key': 'ssh-ed25519 AA+/A= comment'})
    machine = SSHProvider().describe(SSHProvider().create(spec, request_for(spec)))
    assert machine.name == 'planner'
    assert machine.state is MachineState.RUNNING
    assert machine.vpn_host == '127.0.0.1'
    assert not machine.owned
    assert machine.end_command == ()
    endpoint = machine.endpoint
    assert (endpoint.kind, endpoint.host, endpoint.port, endpoint.user) == (
        'ssh', '127.0.0.1', port, 'me')
    assert endpoint.host_key == 'ssh-ed25519 AA+/A= comment'
    assert endpoint.key_file == str(tmp_path / 'a key')


def test_without_a_key_and_a_host_key_the_user_s_own_decide(listener):
    spec = MachineSpec('planner', 'ssh', {
        'host': '127.0.0.1', 'port': listener.getsockname()[1], 'key': None, 'host_key': None})
    endpoint = SSHProvider().describe(SSHProvider().create(spec, request_for(spec))).endpoint
    assert endpoint.host_key is None
    assert endpoint.key_file is None
    assert endpoint.user


def test_a_computer_that_is_off_is_stopped(listener):
    spec = MachineSpec('planner', 'ssh', {'host': '127.0.0.1',
                                          'port': listener.getsockname()[1]})
    machine_id = SSHProvider().create(spec, request_for(spec))
    listener.close()
    machine = SSHProvider().describe(machine_id)
    assert machine.state is MachineState.STOPPED
    assert machine.endpoint is None


@pytest.mark.parametrize('reason, words', [
    (None, 'refuses connections'), (socket.EAI_NONAME, 'no host called'),
    (socket.EAI_AGAIN, 'no DNS server answers'),
])
def test_a_computer_that_can_t_be_reached_is_refused_at_once(
    monkeypatch, listener, reason, words,
):
    def look_up(*_, **__):
        raise socket.gaierror(reason, 'no address')

    port = listener.getsockname()[1]
    listener.close()
    if reason is not None:
        monkeypatch.setattr(socket, 'getaddrinfo', look_up)
    spec = MachineSpec('planner', 'ssh', {'host': '127.0.0.1', 'port': port})
    if reason is not None:
        with pytest.raises(ConnectError, match=words):
            ssh_connection._dial(ssh_config.Settings('planner'), 'planner', 5.0)
    with pytest.raises(ProviderError, match=words):
        SSHProvider().create(spec, request_for(spec))
    with pytest.raises(ProviderError, match=words):
        SSHProvider().check_here(spec)
    SSHProvider().check(spec)


def test_address_that_leads_nowhere_takes_half_of_the_time(monkeypatch, listener):
    """As that of IPv6 in a network without; SSH connects to the other one."""
    families = []
    with contextlib.ExitStack() as opened:
        # takes one connection, and does not answer others
        dead = opened.enter_context(socket.create_server(('127.0.0.1', 0), backlog=0))
        opened.enter_context(socket.create_connection(dead.getsockname()))

        def look_up(host, port, family=0, *_, **__):
            families.append(family)
            return [(socket.AF_INET, socket.SOCK_STREAM, 0, '', server.getsockname())
                    for server in (dead, listener)]

        monkeypatch.setattr(socket, 'getaddrinfo', look_up)
        begin = time.monotonic()
        sock = ssh_connection._dial(
            ssh_config.Settings('lab', family=socket.AF_INET), 'lab', 2.0)
        with sock:
            assert sock.getpeername() == listener.getsockname() and sock.gettimeout() == 2.0
    assert families == [socket.AF_INET]
    assert 0.5 < time.monotonic() - begin < 2.0


@pytest.mark.parametrize('proxy', ['', 'jump'])
@pytest.mark.parametrize(('peer', 'expected'), [
    (('fe80::1', 22, 0, 1), 'fe80::1%lo'), (('2001:db8::1', 22, 0, 0), '2001:db8::1'),
    (('192.0.2.7', 22), '192.0.2.7')])
def test_link_local_address_names_its_interface(monkeypatch, proxy, peer, expected):
    class Connection(contextlib.nullcontext):
        def __enter__(self):
            return SimpleNamespace(getpeername=lambda: peer)

    monkeypatch.setattr(ssh_connection, 'open_socket', lambda *_: Connection())
    monkeypatch.setattr(socket, 'getaddrinfo', lambda *_: [(None, None, None, '', peer)])
    monkeypatch.setattr(socket, 'if_indextoname', {1: 'lo'}.__getitem__)
    assert reach(ssh_config.Settings('host', proxy=proxy)) == expected


@pytest.mark.parametrize('given, words', [
    ({}, "'' can't be the host"),
    ({'host': 'a b'}, "'a b' can't be the host"),
    ({'host': '-oProxyCommand=x'}, "can't be the host"),
    ({'host': 'planner..local'}, "can't be the host"),
    ({'host': 'h', 'port': 65536}, 'from 1 to 65535'),
    ({'host': 'h', 'port': 'ssh'}, 'from 1 to 65535'),
    ({'host': 'h', 'hostkey': 'x'}, "did you mean 'host_key'"),
    ({'host': 'h', 'host_key': 'AAAA'}, "takes 'ssh-ed25519 AAAA...'"),
    ({'host': 'h', 'key': '/no/such/key'}, "can't be read"),
])
def test_options_that_make_no_sense_are_refused(given, words):
    with pytest.raises(ConfigurationError, match=words):
        Options.parse(given)


@pytest.mark.parametrize('machine_id', ['podman:1', 'ssh:', 'ssh:host=x', 'ssh:host=x&port=y'])
def test_ids_that_aren_t_ours_are_unknown(machine_id):
    with pytest.raises(MachineNotFound):
        SSHProvider().describe(machine_id)


@pytest.mark.parametrize('content', ['', 'cut', '-----BEGIN PRIVATE KEY-----\ncut'])
def test_damaged_key_is_named_without_an_argument(content: str, tmp_path: Path) -> None:
    """A launch makes the keys of its own machines: they have no argument for a key."""
    from fogros2.errors import AuthenticationError
    from fogros2.shell import ssh_connection
    key = tmp_path / 'key'
    key.write_text(content)
    for path in (key, tmp_path / 'missing'):
        with pytest.raises(AuthenticationError) as failed:
            ssh_connection.load_key(path, 'planner')
        assert str(path) in str(failed.value) and 'key=' not in failed.value.hint

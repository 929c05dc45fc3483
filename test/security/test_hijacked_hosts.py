# SPDX-License-Identifier: Apache-2.0
"""A hijacked host of container machines ends no launch, and runs no command on the robot."""

from __future__ import annotations

from collections.abc import Iterator
import json
import socket
from typing import Any

import pytest

from fogros2.errors import ProviderError
from fogros2.model import MachineSpec, Result
from fogros2_features.hosts import hosted
from fogros2_features.hosts.hosted import HostedProvider
from fogros2_testing import FakeShell, request_for

ID = 'podman:0123456789ab:0123-token'
LOGIN = {'port': 40001, 'user': 'fog', 'host_key': 'ssh-ed25519 AA'}
REPORT = {'id': ID, 'state': 'running', 'created': 17e8, 'vpn_host': '198.51.100.2', 'image': '',
          'endpoint': LOGIN, 'vpn_port': 40002, 'tags': {'fogros2-hosted': '-1234abcd'}}
#: Words of OpenSSH, of rsync's option ``-e``, and of ids of machines.
NAMES = ["x' -o ProxyCommand='touch /tmp/pwned", '-oProxyCommand=true', 'a b', 'fog\n', '', None]


class Host:
    """A host whose program answers every call with the same line."""

    def __init__(self, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.line = ''
        shell = FakeShell(handlers={'sh': lambda command: Result(0, self.line, '')})
        monkeypatch.setattr(hosted, 'connect', lambda endpoint, name: shell)
        self.spec = MachineSpec('planner', 'hosted', {
            'on': {'host': '127.0.0.1', 'port': port, 'user': 'lab'}})
        self.provider = HostedProvider()

    def answers(self, result: object) -> None:
        self.line = json.dumps({'result': result})

    def create(self) -> str:
        return self.provider.create(self.spec, request_for(self.spec))


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Iterator[Host]:
    with socket.create_server(('127.0.0.1', 0)) as server:
        yield Host(server.getsockname()[1], monkeypatch)


def described(host: Host, report: object) -> None:
    host.answers(ID)
    machine_id = host.create()
    host.answers(report)
    host.provider.describe(machine_id)


@pytest.mark.parametrize('wrong', [
    *({'endpoint': {**LOGIN, 'user': name}} for name in NAMES),
    *({'endpoint': {**LOGIN, 'host_key': key}} for key in (
        '', 'ssh-ed25519', 'ssh-ed25519 AA\n* ssh-ed25519 BB', '@cert-authority AA')),
    *({'endpoint': {**LOGIN, 'port': port}} for port in (-1, 1 << 16, '22', 1.5, True)),
    {'id': f'{ID}@ssh:host=203.0.113.1'}, {'id': 'x'}, {'vpn_host': '203.0.113.1 -x'},
    {'vpn_host': 'fe80::1%$(reboot)'}, {'vpn_host': 1}, {'id': ID + 64 * 'x'},
    {'created': float('-inf')}, {'created': '-Infinity'}, {'vpn_port': 1 << 16}, {'state': 'odd'},
    {'tags': {'fogros2-name': 7}}, {'tags': []}, {'image': ['x']}])
def test_wrong_report_of_a_host_is_one_clear_error(host: Host, wrong: dict[str, Any]) -> None:
    described(host, REPORT)
    with pytest.raises(ProviderError, match="the host '127.0.0.1' (reports|sent no answer)"):
        described(host, {**REPORT, **wrong})


@pytest.mark.parametrize('line', [
    '[' * 200_000, '{"result": %s}' % ('[' * 60 + ']' * 60), '{"result": {"created": -Infinity}}',
    '{"result": %s}' % ('9' * 5000), '{"error": 7, "message": "", "hint": ""}', '7', '',
    '{"error": "NameTaken"}', '{"result": "%s"}' % ('x' * (1 << 20))], ids=lambda line: line[:20])
def test_odd_answer_of_a_host_is_one_clear_error(host: Host, line: str) -> None:
    host.answers(ID)
    machine_id = host.create()
    host.line = line
    with pytest.raises(ProviderError, match="the host '127.0.0.1' "):
        host.provider.describe(machine_id)
    with pytest.raises(ProviderError, match="the host '127.0.0.1' "):
        list(host.provider.find({}))


@pytest.mark.parametrize('name', [
    f'{ID}@ssh:host=203.0.113.1&port=22&user=lab', 'x', 7, None, f'{ID}\n', ID + 64 * 'x', [ID],
    {'id': ID}, ID.replace('podman', 'sh')])
def test_host_cannot_name_another_host_as_a_machines(host: Host, name: object) -> None:
    host.answers(name)
    with pytest.raises(ProviderError, match="the host '127.0.0.1' reports a machine wrongly"):
        host.create()


@pytest.mark.parametrize('report', [
    {'id': 'podman:data', 'user': ''}, {'id': 'podman:fogros2-volume-a@ssh:x', 'user': ''},
    {'id': 'podman:fogros2-volume-a\n', 'user': ''}, {'id': 'podman:fogros2-volume-a'}, 7])
def test_host_reports_its_own_volumes_alone(
    host: Host, monkeypatch: pytest.MonkeyPatch, report: object,
) -> None:
    find = host.provider._find_host
    monkeypatch.setattr(host.provider, '_find_host', lambda on: find(host.spec.options['on']))
    host.answers([{'id': 'podman:fogros2-volume-a', 'user': 'x'}])
    volume, = host.provider.volumes(['lab'])
    assert (volume.name, volume.region, volume.user) == ('a', '127.0.0.1', 'x')
    host.answers([report])
    with pytest.raises(ProviderError, match="the host '127.0.0.1' reports a machine wrongly"):
        list(host.provider.volumes(['lab']))

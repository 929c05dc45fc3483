# SPDX-License-Identifier: Apache-2.0
"""
No answer of a host or provider ends ``ssh`` to other hosts, or chooses more than its own words.

The user's configuration includes the files that ``ros2 fog ssh-config`` writes.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
import subprocess

import pytest

from fogros2 import process
from fogros2.errors import ShellError
from fogros2.model import Endpoint
from fogros2.store import Store
from ros2fog_cli.api import ssh_settings

pytestmark = pytest.mark.skipif(process.which('ssh') is None, reason='OpenSSH is not installed')

ODD = ['198.51.100.7"', "'x", '#', '=', '=x', 'a b', 'a"b c"', '-oProxyCommand=id', '%h',
       '${HOME}', '$(id)', '\\', 'a\tb', 'a\rb', '\u2028', 'é', '\u3000']


def settings(file: Path, name: str) -> dict[str, str]:
    said = subprocess.run(['ssh', '-F', file, '-G', '--', name], capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    return dict(line.partition(' ')[::2] for line in said.stdout.splitlines())


@pytest.mark.parametrize('field', ['host', 'user'])
@pytest.mark.parametrize('value', ODD)
def test_odd_name_is_refused_or_stays_one_word(tmp_path: Path, field: str, value: str) -> None:
    plain = Endpoint('ssh', '198.51.100.7', 2200, 'fog', 'ssh-ed25519 AAAA', '/k')
    file = tmp_path / 'config'
    try:
        file.write_text(ssh_settings.settings(
            'a', dataclasses.replace(plain, **{field: value}), tmp_path))
    except ShellError as refused:
        assert 'ssh would misread' in str(refused)
        return
    assert settings(file, 'b')['hostname'] == 'b'
    found = settings(file, 'a')
    name = {'host': 'hostname', 'user': 'user'}[field]
    assert found[name].lower() == value.lower()
    assert found['port'] == '2200' and 'proxycommand' not in found
    assert found['stricthostkeychecking'] in ('yes', 'true')


@pytest.mark.parametrize(
    'name', ["it's", '#1', 'a=b', 'a b', 'a"b', '${HOME}', 'a\\b', 'a\u3000b'])
def test_odd_path_of_a_key_is_refused_or_read(tmp_path: Path, name: str) -> None:
    file, key = tmp_path / 'config', f'/keys/{name}'
    endpoint = Endpoint('ssh', '198.51.100.7', 22, 'fog', 'ssh-ed25519 AAAA', key)
    try:
        file.write_text(ssh_settings.settings('a', endpoint, tmp_path / name))
    except ShellError as refused:
        assert name in ('a"b', '${HOME}') and 'ssh would misread' in str(refused)
        return
    found = settings(file, 'a')
    assert found['identityfile'] == key
    assert found['userknownhostsfile'] == str(tmp_path / name / ssh_settings.KNOWN_HOSTS)


@pytest.mark.parametrize('name', ["it's", '#1', 'a b', 'a[b]', 'a*', 'a?', 'a\\b', '$a', 'é'])
def test_odd_state_folder_is_included_alone(tmp_path: Path, name: str) -> None:
    for folder, host in ((name, '198.51.100.7'), ('aa', '203.0.113.9')):
        machine = tmp_path / folder / 'machines/planner'
        machine.mkdir(parents=True)
        endpoint = Endpoint('ssh', host, 22, 'fog', 'ssh-ed25519 AAAA', '/k')
        (machine / ssh_settings.FILE).write_text(
            ssh_settings.settings('planner', endpoint, machine))
    file = tmp_path / 'config'
    file.write_text(ssh_settings.include(Store(tmp_path / name)))
    assert settings(file, 'planner')['hostname'] == '198.51.100.7'


def test_settings_of_all_hosts_lead_to_no_other_machine(tmp_path: Path) -> None:
    endpoint = Endpoint('ssh', '198.51.100.7', 22, 'fog', 'ssh-ed25519 AAAA', '/k')
    file = tmp_path / 'config'
    file.write_text(ssh_settings.settings('a', endpoint, tmp_path) + (
        'Host *\n    ProxyJump bastion\n    Port 7\n    User me\n    IdentityFile /mine\n'
        '    HostKeyAlias x\n    UserKnownHostsFile /x\n    StrictHostKeyChecking no\n'))
    found, others = settings(file, 'a'), settings(file, 'b')
    assert others['proxyjump'] == 'bastion' and 'proxyjump' not in found
    assert (found['port'], found['user'], found['hostkeyalias'], found['userknownhostsfile']) == (
        '22', 'fog', 'fogros2-a', str(tmp_path / ssh_settings.KNOWN_HOSTS))
    assert found['stricthostkeychecking'] in ('yes', 'true')

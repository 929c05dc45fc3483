# SPDX-License-Identifier: Apache-2.0
"""What is taken from OpenSSH's configuration; the real ``ssh -G`` evaluates it."""

from __future__ import annotations

import getpass
import socket

import pytest

from fogros2 import process
from fogros2.errors import ConfigurationError
from fogros2.model import Endpoint
from fogros2.shell import ssh_config

pytestmark = pytest.mark.skipif(process.which('ssh') is None, reason='OpenSSH is not installed')


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path))
    (tmp_path / '.ssh').mkdir()
    return tmp_path


def configured(home, text):
    (home / '.ssh/config').write_text(text)


def test_settings_of_a_host_are_those_of_ssh(home):
    (home / 'more').write_text('Host lab\n  Port 2299\n')
    configured(home, f"""
Include {home}/more
Host lab lab2
  HostName 198.51.100.7
  User fog
  IdentityFile ~/keys/%h_%r%%
  IdentityFile "~/keys/a key"
  IdentitiesOnly yes
  IdentityAgent /run/agent.sock
  UserKnownHostsFile ~/.ssh/of_lab /etc/of_lab
  HostKeyAlias gpu
  AddressFamily inet
Match originalhost lab2 exec "test -e {home}/more"
  Port 2300
""")
    assert ssh_config.read('lab') == ssh_config.Settings(
        '198.51.100.7', 2299, 'fog', ('~/keys/198.51.100.7_fog%', '~/keys/a key'),
        only_keys=True, agent='/run/agent.sock', label='gpu', family=socket.AF_INET, known_hosts=(
            f'{home}/.ssh/of_lab', '/etc/of_lab', '/etc/ssh/ssh_known_hosts',
            '/etc/ssh/ssh_known_hosts2'))
    assert ssh_config.read('lab2').port == 2300
    assert ssh_config.read('other').user == getpass.getuser()
    chosen = ssh_config.read('lab', 'me', 22)
    assert (chosen.host, chosen.user, chosen.port) == ('198.51.100.7', 'me', 22)


def test_home_is_that_of_the_environment(home):
    """OpenSSH takes the account's."""
    plain = ssh_config.read('Plain')
    assert (plain.host, plain.port, plain.user) == ('plain', 22, getpass.getuser())
    assert plain.known_hosts[0] == f'{home}/.ssh/known_hosts'
    assert '~/.ssh/id_ed25519' in plain.keys


def test_paths_have_spaces_and_variables(home, monkeypatch):
    monkeypatch.setenv('FOGT_KEYS', '/keys')
    configured(home, 'UserKnownHostsFile "/my hosts" /b\nGlobalKnownHostsFile none\n'
               'IdentityFile ${FOGT_KEYS}/a\n')
    found = ssh_config.read('lab')
    assert found.known_hosts == ('/my hosts', '/b', 'none') and found.keys == ('/keys/a',)


@pytest.mark.parametrize(('lines', 'words'), [
    ('ProxyJump bastion', ['-W', '[h.example]:2200', '--', 'ssh://bastion']),
    ('ProxyJump me@a:2201,ssh://b:22', ['-W', '[h.example]:2200', '-J', 'me@a:2201', '--',
                                        'ssh://b:22']),
    ('ProxyJump none', []),
    ('ProxyCommand nc -x proxy %h %p %%a %r', ['exec nc -x proxy h.example 2200 %a fog']),
    ('ProxyCommand none', []),
    ('', [])])
def test_proxy_is_a_command(home, lines, words):
    configured(home, f'Host lab\n HostName h.example\n Port 2200\n User fog\n {lines}\n')
    found = list(ssh_config.read('lab').proxy)
    assert found[len(found) - len(words):] == words
    if 'bastion' in lines:
        assert found[:3] == ['ssh', '-F', f'{home}/.ssh/config'] and 'BatchMode=yes' in found


def test_damaged_configuration_is_reported_with_its_line(home):
    configured(home, 'Host lab\n  HostNam x\n')
    with pytest.raises(ConfigurationError, match=r'config.* line 2: Bad .*: hostnam') as refused:
        ssh_config.read('lab')
    assert refused.value.hint == "try: ssh -G 'lab'"


def test_name_with_shell_characters_is_refused(home):
    """A ProxyCommand gets the name in a line for a shell."""
    configured(home, 'Host *\n  ProxyCommand nc %h %p\n')
    with pytest.raises(ConfigurationError):
        ssh_config.read('a;touch${IFS}b')


def test_endpoint_without_an_alias_takes_no_settings(home):
    configured(home, 'Host *\n  Port 2200\n  ProxyCommand false\n  User other\n')
    plain = Endpoint('ssh', '198.51.100.7', 22, 'fog', key_file='/k')
    assert ssh_config.of(plain) == ssh_config.Settings(
        '198.51.100.7', 22, 'fog', ('/k',), only_keys=True)


def test_without_openssh_the_name_is_the_host(home, monkeypatch):
    configured(home, 'Host *\n  Port 2200\n')
    monkeypatch.setattr(process, 'which', lambda program: None)
    assert ssh_config.read('Lab', port=23) == ssh_config.Settings('lab', 23)

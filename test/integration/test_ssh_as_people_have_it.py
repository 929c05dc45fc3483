# SPDX-License-Identifier: Apache-2.0
"""~/.ssh/config, known_hosts, agents and talking login shells, beside OpenSSH's own client."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import dataclasses
from functools import partial
import getpass
import os
from pathlib import Path
import subprocess
import threading

import pytest

from fogros2 import process
from fogros2.errors import (
    AuthenticationError,
    Cancelled,
    ConnectError,
    FogError,
    HostKeyError,
    ShellError,
)
from fogros2.model import Command, Endpoint, MachineSpec
from fogros2.provider.ssh import SSHProvider
from fogros2.shell import command_line
from fogros2.shell.ssh import SSHShell
from fogros2.store import Record, Store
from fogros2.waiting import Periodic, wait_until
from fogros2_testing import request_for
from rigs.sshd import private_sshd, PrivateSshd
from ros2fog_cli.api import ssh_settings
from ros2fog_cli.api.machines import Entry

pytestmark = pytest.mark.skipif(
    not all(map(process.which, ('ssh', 'sshd', 'ssh-agent'))), reason='OpenSSH is not installed')


@pytest.fixture(scope='module')
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PrivateSshd]:
    """Run a server that runs the words of ``talk`` before each command."""
    folder = tmp_path_factory.mktemp('server')
    (folder / 'there').mkdir()
    settings = f'ForceCommand . {folder}/talk\nSetEnv HOME={folder}/there SHLVL=2\n'
    with private_sshd(folder / 'sshd', settings) as server:
        yield server


def talk(server: PrivateSshd, words: str) -> SSHShell:
    """Let the server's login shell run words; return a shell to it."""
    (server.folder.parent / 'talk').write_text(f'{words}\nexec sh -c "$SSH_ORIGINAL_COMMAND"\n')
    return SSHShell(server.endpoint, name='planner')


@pytest.fixture
def server(running: PrivateSshd) -> PrivateSshd:
    talk(running, 'true')
    return running


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a home without settings, keys or known hosts, and no agent."""
    folder = tmp_path / 'home'
    monkeypatch.setenv('HOME', str(folder))
    monkeypatch.delenv('SSH_AUTH_SOCK', raising=False)
    (folder / '.ssh').mkdir(parents=True, mode=0o700)
    return folder


def keygen(path: Path, *words: object) -> Path:
    subprocess.run(['ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-C', '', '-f', path,
                    *map(str, words)], check=True)
    return path


def says(shell: SSHShell, word: str = 'hello') -> str:
    with contextlib.closing(shell):
        return shell.run(Command(('echo', word)), timeout=60.0).stdout


def computer(host: str, **options: object) -> Endpoint:
    """Return the endpoint of a machine as the provider makes it."""
    spec = MachineSpec('planner', 'ssh', {'host': host, **options})
    provider = SSHProvider()
    found = provider.describe(provider.create(spec, request_for(spec))).endpoint
    assert found is not None
    return found


def openssh(home: Path) -> str:
    """Return the complaint of OpenSSH's client about the host 'lab', '' for none."""
    done = subprocess.run(
        ['ssh', '-F', home / '.ssh/config', '-o', 'BatchMode=yes', '-o',
         'StrictHostKeyChecking=yes', '-o', 'GlobalKnownHostsFile=none', 'lab', 'true'],
        stdin=subprocess.DEVNULL, capture_output=True, text=True)
    return '' if done.returncode == 0 else done.stderr or f'status {done.returncode}'


def configured(home: Path, server: PrivateSshd, lines: str = '') -> None:
    (home / '.ssh/known_hosts').write_text(
        f'[127.0.0.1]:{server.port},[localhost]:{server.port} {server.host_key}\n')
    (home / '.ssh/config').write_text(
        f'Host lab\n  HostName 127.0.0.1\n  Port {server.port}\n  User {getpass.getuser()}\n'
        f'  IdentityFile {server.folder}/id\n{lines}\n'
        f'Host *\n  UserKnownHostsFile {home}/.ssh/known_hosts\n')


# -- ~/.ssh/config --------------------------------------------------------------------------------

def test_name_of_ssh_config_is_a_machine(server, home):
    configured(home, server)
    assert openssh(home) == ''
    endpoint = computer('lab')
    assert (endpoint.host, endpoint.port, endpoint.alias) == ('127.0.0.1', server.port, 'lab')
    assert says(SSHShell(endpoint, name='planner')) == 'hello\n'


def test_given_settings_win_over_ssh_config(server, home, tmp_path):
    configured(home, server, '  User nobody-here\n')
    (home / '.ssh/config').write_text((home / '.ssh/config').read_text().replace(
        f'Port {server.port}', 'Port 1').replace('IdentityFile ', 'IdentityFile /none'))
    given = {'port': server.port, 'user': getpass.getuser(), 'key': str(server.folder / 'id')}
    assert says(SSHShell(computer('lab', **given), name='planner')) == 'hello\n'


@pytest.mark.parametrize('lines', [
    '  ProxyJump one,two:{port}\nHost two\n  HostName localhost\nHost one\n'
    '  HostName 127.0.0.1\nHost one two\n  Port {port}\n  IdentityFile {id}\n',
    '  ProxyCommand ssh -F {config} -W %h:%p jump\nHost jump\n  HostName 127.0.0.1\n'
    '  Port {port}\n  IdentityFile {id}\n'])
def test_host_behind_another_is_reached(server, home, lines):
    configured(home, server, lines.format(
        port=server.port, id=server.folder / 'id', config=home / '.ssh/config'))
    ends = partial(wait_until, lambda: not server.sessions(), timeout=60.0, what='the end of all')
    ends()
    with contextlib.closing(SSHShell(computer('lab'), name='planner')) as shell:
        assert shell.run(Command(('echo', 'a')), timeout=60.0).stdout == 'a\n'
        assert len(server.sessions()) >= 2
    ends()


@pytest.mark.parametrize(('proxy', 'said'), [
    ('sh -c "echo the bastion is closed >&2; exit 1"', 'the bastion is closed'),
    ('nothing-of-this-name', 'nothing-of-this-name: not found')])
def test_failing_proxy_says_why(server, home, proxy, said):
    configured(home, server, f'  ProxyCommand {proxy}\n')
    with pytest.raises(ConnectError, match=f'the way to .*: .*{said}'):
        says(SSHShell(computer('lab'), name='planner'))


# -- known_hosts ----------------------------------------------------------------------------------

KEY = 'ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAINhr1xZ0GZJ4Mqbso1vdFbxmsNCtINbcVrdTGUPNy8U9'
HERE = '[127.0.0.1]:{port} {key}\n'


@pytest.mark.parametrize('text', [
    f'@cert-authority *.example {KEY}\n@revoked * {KEY}\n127.0.0.1 {KEY}\n'
    f'[127.0.0.1]:{{port}} {KEY}\n\\\\ nonsense\n{HERE}',
    '[127.0.0.*]:{port},other {key}\n',
    # what OpenSSH refuses
    f'{HERE}@revoked * {{key}}\n',
    f'[127.0.0.1]:{{port}} {KEY}\n',
    '@cert-authority * {key}\n'])
def test_known_hosts_means_what_it_means_to_openssh(server, home, text):
    configured(home, server)
    (home / '.ssh/known_hosts').write_text(text.format(port=server.port, key=server.host_key))
    accepted = not openssh(home)
    try:
        assert says(SSHShell(computer('lab'), name='planner')) == 'hello\n'
        assert accepted
    except HostKeyError as refused:
        assert not accepted, refused


@pytest.mark.parametrize(('words', 'error'), [
    (('-h', '-n', '127.0.0.1'), ''),
    (('-h', '-n', 'other'), 'the certificate of .* is for other')])
def test_certificate_of_a_host_is_what_it_is_to_openssh(tmp_path, home, words, error):
    authority, key = keygen(tmp_path / 'ca'), keygen(tmp_path / 'certified')
    subprocess.run(['ssh-keygen', '-q', '-s', authority, '-I', 'id', *words, f'{key}.pub'],
                   check=True)
    extra = f'HostKey {key}\nHostCertificate {key}-cert.pub\n'
    with private_sshd(tmp_path / 'sshd', extra) as server:
        configured(home, server)
        (home / '.ssh/known_hosts').write_text(
            f'@cert-authority * {(tmp_path / "ca.pub").read_text()}')
        said = openssh(home)
        assert bool(said) == bool(error), said
        with pytest.raises(HostKeyError, match=error) if error else contextlib.nullcontext():
            assert says(SSHShell(computer('lab'), name='planner')) == 'hello\n'


# -- keys and agents ------------------------------------------------------------------------------

@pytest.fixture
def agent(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    path = tmp_path / 'agent'
    child = subprocess.Popen(['ssh-agent', '-D', '-a', path], stdout=subprocess.DEVNULL)
    try:
        wait_until(path.exists, timeout=60.0, what='ssh-agent')
        monkeypatch.setenv('SSH_AUTH_SOCK', str(path))
        yield path
    finally:
        child.terminate()
        child.wait()


def add(*keys: Path) -> None:
    subprocess.run(['ssh-add', '-q', *keys], check=True)


def locked(path: Path, server: PrivateSshd) -> Path:
    """Make a key with a passphrase that the server accepts, of the key that it accepts."""
    path.write_text((server.folder / 'id').read_text())
    path.chmod(0o600)
    path.with_name(f'{path.name}.pub').write_text((server.folder / 'id.pub').read_text())
    subprocess.run(['ssh-keygen', '-q', '-p', '-P', '', '-N', 'secret', '-f', path], check=True,
                   stdout=subprocess.DEVNULL)
    return path


def own(server: PrivateSshd) -> Endpoint:
    return dataclasses.replace(server.endpoint, key_file=None)


def test_key_with_a_passphrase_needs_ssh_add(server, home):
    path = locked(home / '.ssh/id_ed25519', server)
    with pytest.raises(AuthenticationError, match='has a passphrase') as refused:
        says(SSHShell(own(server), name='planner'))
    assert refused.value.hint == f'eval "$(ssh-agent)"; ssh-add {path}'


def test_key_with_a_passphrase_is_named_beside_others(server, home, agent):
    path, other = locked(home / '.ssh/id_ed25519', server), keygen(home / 'other')
    add(other)
    with pytest.raises(AuthenticationError, match="does not accept the user's own") as refused:
        says(SSHShell(own(server), name='planner'))
    assert refused.value.hint.startswith(f'ssh-add {path}, which has a passphrase; or add ')


def test_key_with_a_passphrase_comes_from_the_agent(server, home, agent):
    add(server.folder / 'id')
    path = locked(home / 'key', server)
    assert says(SSHShell(dataclasses.replace(
        server.endpoint, key_file=str(path)), name='planner')) == 'hello\n'


@pytest.mark.parametrize('named', ['key', 'key.pub'])
@pytest.mark.parametrize('more', ['', '  IdentitiesOnly yes\n'])
def test_key_that_only_the_agent_has_is_named_by_its_public_half(
        server, home, agent, named, more):
    """As documents of password managers, hardware keys and forwarded agents tell users."""
    add(*(keygen(home / f'other{number}') for number in range(7)), server.folder / 'id')
    (home / 'key.pub').write_text((server.folder / 'id.pub').read_text())
    configured(home, server, more)
    (home / '.ssh/config').write_text((home / '.ssh/config').read_text().replace(
        f'IdentityFile {server.folder}/id', f'IdentityFile {home}/{named}'))
    assert openssh(home) == ''
    assert says(SSHShell(computer('lab'), name='planner')) == 'hello\n'


def test_too_many_keys_of_the_agent_are_named(server, home, agent):
    add(*(keygen(home / f'other{number}') for number in range(7)))
    (home / '.ssh/id_ed25519').write_text((server.folder / 'id').read_text())
    (home / '.ssh/id_ed25519').chmod(0o600)
    with pytest.raises(AuthenticationError, match='offered too many keys, 6') as refused:
        says(SSHShell(own(server), name='planner'))
    assert 'key=' in refused.value.hint and 'IdentitiesOnly' in refused.value.hint


def test_named_keys_of_the_agent_are_offered_first(server, home, agent):
    """As OpenSSH does."""
    add(*(keygen(home / f'other{number}') for number in range(7)), server.folder / 'id')
    configured(home, server)
    assert openssh(home) == ''
    assert says(SSHShell(computer('lab'), name='planner')) == 'hello\n'


def test_agent_of_ssh_config_is_asked(server, home, agent, monkeypatch):
    add(server.folder / 'id')
    monkeypatch.delenv('SSH_AUTH_SOCK')
    configured(home, server, f'  IdentityAgent {agent}\n')
    (home / '.ssh/config').write_text((home / '.ssh/config').read_text().replace(
        f'IdentityFile {server.folder}', 'IdentityFile /none'))
    assert openssh(home) == ''
    assert says(SSHShell(computer('lab'), name='planner')) == 'hello\n'


# -- login shells that print ----------------------------------------------------------------------

@pytest.mark.parametrize('words', [
    'echo 1234; printf "ready> "; cd /tmp; echo warning >&2', 'seq 100000'])
def test_what_a_login_shell_prints_is_no_output(server, tmp_path, home, words):
    there = server.folder.parent / 'there'
    with contextlib.closing(talk(server, words)) as shell:
        assert shell.run(Command(('echo', 'one')), timeout=60.0).stdout == 'one\n'
        lines: list[str] = []
        shell.run(Command(('printf', 'a\\nb')), timeout=60.0, on_output=lines.append)
        assert lines == ['a', 'b']
        with pytest.raises(FogError, match='exit status 3|status 3|3'):
            shell.run(Command(('sh', '-c', 'exit 3')), timeout=60.0)
        shell.put(b'data', f'{there}/file', mode=0o600)
        assert (there / 'file').read_bytes() == b'data'
        source = tmp_path / 'source'
        source.mkdir()
        (source / 'a').write_text('a')
        shell.sync(source, '~/copy', excludes=(), timeout=60.0)
        assert (there / 'copy/a').read_text() == 'a'
        shell.fetch(f'{there}/copy', tmp_path / 'back', known=None, limit=1 << 20,
                    timeout=60.0)
        assert (tmp_path / 'back/a').read_text() == 'a'
        stream = shell.open(Command(('cat',)))
        stream.write(b'line\n')
        assert stream.readline() == b'line\n'
        stream.close()


def test_cancelled_command_ends_behind_a_talking_shell(server, tmp_path, home):
    with contextlib.closing(talk(server, 'echo 4711')) as shell:
        path, cancel = tmp_path / 'pid', threading.Event()
        Periodic('a cancel', 0.02, lambda: cancel.set() if path.exists() else None, stop=cancel)
        with pytest.raises(Cancelled):
            shell.run(Command(('sh', '-c', f'echo $$ >{path}.new; mv {path}.new {path}; '
                               'exec sleep 600')), timeout=60.0, cancel=cancel)
        pid = int(path.read_text())
        wait_until(lambda: not os.path.exists(f'/proc/{pid}'), timeout=60.0, what='its end')


def test_command_that_is_cancelled_at_once_ends(server, home, monkeypatch):
    """Before its process is known here."""
    ended, cancel = [], threading.Event()
    monkeypatch.setattr(command_line, 'end_script', lambda pid, make=command_line.end_script: (
        ended.append(pid) or make(pid)))
    with contextlib.closing(talk(server, 'echo 4711')) as shell:
        start = shell.start
        monkeypatch.setattr(shell, 'start', lambda *words: (start(*words), cancel.set())[0])
        with pytest.raises(Cancelled):
            shell.run(Command(('sleep', '600')), timeout=60.0, cancel=cancel)
    (pid,) = ended
    wait_until(lambda: not os.path.exists(f'/proc/{pid}'), timeout=60.0, what='its end')


@pytest.mark.parametrize(('words', 'error'), [
    ('echo; echo This account is closed.; exit 1', "'planner' runs no command, it prints: This"),
    ('exit 0', r'runs no command \(see'),
    ('echo closed >&2; exit 1', r'runs no command, it prints: closed \(see')])
def test_login_shell_that_runs_no_command_is_named(server, home, words, error):
    with contextlib.closing(talk(server, words)) as shell, pytest.raises(ShellError, match=error):
        shell.put(b'data', '~/file', mode=0o600)


def test_commands_that_bash_prints_are_no_output(tmp_path, home):
    there = tmp_path / 'there'
    there.mkdir()
    (there / '.bashrc').write_text("trap 'echo $BASH_COMMAND' DEBUG\n")
    with private_sshd(tmp_path / 'sshd', f'SetEnv HOME={there} SHLVL=0\n') as server:
        assert says(SSHShell(server.endpoint, name='planner')) == 'hello\n'


def test_talk_without_end_ends_by_the_time_out(server, home):
    with contextlib.closing(talk(server, 'true')) as shell:
        shell.run(Command(('true',)), timeout=60.0)
        talk(server, 'yes')
        with pytest.raises(FogError, match='took too long'):
            shell.run(Command(('true',)), timeout=0.3)


def test_other_programs_reach_a_machine_by_its_name(
    server: PrivateSshd, home: Path, tmp_path: Path,
) -> None:
    """As ``ros2 fog ssh-config`` writes it, for ssh and what uses it."""
    store = Store()
    record = Record('planner', 'ssh', MachineSpec('planner', 'ssh'), endpoint=server.endpoint)
    store.save(record)
    ssh_settings.write(Entry('planner', 'ssh', None, record), store)
    config = home / '.ssh/config'
    config.write_text(f'{ssh_settings.include(store)}\n')

    def ssh(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(['ssh', '-F', config, '-o', 'BatchMode=yes', *words],
                              capture_output=True, text=True, timeout=30)

    assert ssh('planner', 'echo hello').stdout == 'hello\n'
    copied = subprocess.run(['rsync', '-e', f'ssh -F {config}', 'planner:' + str(
        server.folder / 'host_key.pub'), tmp_path / 'copy'], timeout=30)
    assert copied.returncode == 0 and (tmp_path / 'copy').read_text().startswith('ssh-ed25519')
    # another computer at its address is refused
    keygen(tmp_path / 'other')
    (store.machine('planner') / 'known_hosts').write_text(
        f'fogros2-planner {(tmp_path / "other.pub").read_text()}')
    assert 'Host key verification failed' in ssh('planner', 'echo hello').stderr

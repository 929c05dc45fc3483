# SPDX-License-Identifier: Apache-2.0
"""Tests of what container machines see, are asked for, and run; by value."""

from __future__ import annotations

import dataclasses
import io
import json
import os
from pathlib import Path
import secrets
import stat
import subprocess
import tarfile
import threading

import pytest

from fogros2.errors import (
    Cancelled,
    CommandError,
    ConfigurationError,
    MachineNotFound,
    NameTaken,
    PrerequisiteError,
    ProviderError,
)
from fogros2.model import Command, CreateRequest, MachineSpec, Result
from fogros2.provider import container
from fogros2.provider.container import debian_root
from fogros2.provider.container import engine as container_engine
from fogros2.provider.container import entry as container_entry
from fogros2.provider.container import machine as container_machine
from fogros2.provider.container import options as container_options
from fogros2.provider.container import root as container_root
from fogros2.provider.container.engine import Engine
from fogros2.provider.container.options import Options

REQUEST = CreateRequest('0123-token', 'ssh-ed25519 AAAA me', {'fogros2-name': 'm'}, 51820)


def content(data: bytes) -> dict[str, tarfile.TarInfo]:
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        return {member.name: member for member in tar.getmembers()}


def text(data: bytes, name: str) -> str:
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        file = tar.extractfile(name)
        assert file is not None
        return file.read().decode()


@pytest.fixture
def etc(tmp_path: Path) -> Path:
    """Return settings with secrets in every corner."""
    folder = tmp_path / 'etc'
    for name, mode in {
        'passwd': 0o644, 'group': 0o644, 'nsswitch.conf': 0o644, 'ssl/certs/ca.crt': 0o644,
        'skel/.bashrc': 0o644, 'shadow': 0o640, 'gshadow': 0o640,
        'ssh/ssh_host_ed25519_key': 0o600, 'ssh/sshd_config': 0o644,
        'wireguard/wg0.conf': 0o600, 'kubernetes/admin.conf': 0o644, 'fstab': 0o644,
        'environment': 0o644, 'pip.conf': 0o644, 'ssl/private/server.key': 0o640,
        'ssl/certs/own.key': 0o644, 'apt/sources.list.d/a.list': 0o644,
        'apt/sources.list.d/private.list': 0o644, 'apt/auth.conf.d/x.conf': 0o644,
        'apt/auth.conf': 0o644, 'security/opasswd': 0o600, 'profile.d/token.sh': 0o600,
        'profile.d/ros.sh': 0o644, 'pam.d/common-password': 0o644, 'passwd-': 0o644,
        'ca-certificates/hidden/open': 0o644, 'profile': 0o755,
    }.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f'content of {name}')
        path.chmod(mode)
    (folder / 'ca-certificates/hidden').chmod(0o700)
    (folder / 'localtime').symlink_to('/usr/share/zoneinfo/UTC')
    (folder / 'apt/sources.list.d/private.list').write_text(
        'deb https://me:secret@example.org/ stable main')
    (folder / 'passwd').write_text(
        'root:x:0:0:root:/root:/bin/bash\n'
        'alice:x:1000:1000:Alice Doe:/home/alice:/bin/zsh\n'
        'sshd:x:102:65534::/run/sshd:/usr/sbin/nologin\n'
        'nobody:x:65534:65534:nobody:/nonexistent:/usr/sbin/nologin\n')
    (folder / 'group').write_text('root:x:0:\nsudo:x:27:alice\nalice:x:1000:\n')
    return folder


def test_settings_hold_what_is_allowed_and_nothing_else(etc):
    archive = container_root.Archive()
    container_root.settings(archive, str(etc))
    members = content(archive.data())
    assert {name for name, member in members.items() if not member.isdir()} == {
        'etc/nsswitch.conf', 'etc/ssl/certs/ca.crt', 'etc/skel/.bashrc',
        'etc/apt/sources.list.d/a.list', 'etc/profile.d/ros.sh', 'etc/profile',
        'etc/pam.d/common-password', 'etc/localtime',
    }
    assert members['etc/localtime'].linkname == '/usr/share/zoneinfo/UTC'
    assert (members['etc/profile'].mode, members['etc/nsswitch.conf'].mode) == (0o755, 0o644)


def test_large_folder_is_mounted_only_if_all_of_it_is_public(etc):
    for number in range(container_root.MANY):
        (etc / f'ssl/certs/{number}').symlink_to('ca.crt')
        (etc / f'profile.d/{number}.sh').write_text('')
    (etc / 'ssl/certs/own.key').unlink()
    assert container_root.many_settings(str(etc)) == (f'{etc}/ssl/certs',)
    archive = container_root.Archive()
    container_root.settings(archive, str(etc))
    found = content(archive.data())
    assert 'etc/ssl/certs' in found
    assert 'etc/ssl/certs/ca.crt' not in found
    assert 'etc/profile.d/0.sh' in found
    assert 'etc/profile.d/token.sh' not in found


def test_accounts_are_the_system_s_and_the_login_user_s(etc):
    archive = container_root.Archive()
    container_root.accounts(archive, 'fog', 2013265999, etc)
    data = archive.data()
    assert text(data, 'etc/passwd').splitlines() == [
        'root:x:0:0:root:/root:/bin/bash',
        'sshd:x:102:65534::/run/sshd:/usr/sbin/nologin',
        'nobody:x:65534:65534:nobody:/nonexistent:/usr/sbin/nologin',
        'fog:x:2013265999:2013265999::/home/fog:/bin/bash']
    assert 'alice' not in text(data, 'etc/group')
    assert text(data, 'etc/shadow').splitlines()[0] == 'root:*:::::::'
    found = content(data)
    assert found['etc/shadow'].mode == 0o600
    assert found['etc/sudoers'].mode == 0o440
    assert (found['home/fog'].uid, found['home/fog'].mode) == (2013265999, 0o750)
    assert found['home/fog/.bashrc'].uid == 2013265999


def test_account_of_another_encoding_keeps_its_bytes(etc):
    line = 'audio:x:29:29:Jürgen:/:/bin/false\n'.encode('latin-1')
    with open(etc / 'passwd', 'ab') as file:
        file.write(line)
    archive = container_root.Archive()
    container_root.accounts(archive, 'fog', 2013265999, etc)
    assert b'\n' + line in archive.data()


def test_the_skeleton_of_this_computer_holds_no_home_and_no_key():
    data = container_root.skeleton() + container_root.Archive().data()
    found = content(data)
    for name in ('home', 'root', 'srv', 'opt', 'mnt', 'media', 'var/lib', 'run', 'tmp'):
        assert found[name].isdir()
    files = [name for name, member in found.items() if not member.isdir()]
    allowed = ('etc/', 'var/run', 'var/lock')
    assert all(name.startswith(allowed) or '/' not in name for name in files)
    secret = ('etc/ssh/', 'etc/wireguard', 'etc/kubernetes')
    assert not any(name.startswith(secret) for name in files)
    assert found['tmp'].mode == 0o1777


def test_outermost_folders_are_mounted_once():
    assert container_root.outermost(
        ['/a/b/c', '/a/b', '/a/bc', '/usr/lib/x', '/lib/y', '/', '/a/b/']) == ['/a/b', '/a/bc']


def test_mounts_cover_prefix_underlays_and_editable_packages(tmp_path, monkeypatch):
    site = tmp_path / 'venv/lib/python3.11/site-packages'
    site.mkdir(parents=True)
    for name in ('ros/share', 'work/install/pkg', 'work/.git', 'source/one', 'source/test'):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / 'source/one/__init__.py').write_text('')
    (tmp_path / 'source/setup.py').write_text('')
    (site / 'one.pth').write_text(f'{tmp_path}/source\nimport sys\n')
    (tmp_path / 'two').mkdir()
    (site / '__editable___two_finder.py').write_text(
        f"MAPPING: dict[str, str] = {{'two': '{tmp_path}/two', 'gone': '/nowhere'}}\n")
    monkeypatch.setattr('sys.prefix', str(tmp_path / 'venv'))
    monkeypatch.setattr('sys.base_prefix', '/usr')
    monkeypatch.setenv('AMENT_PREFIX_PATH', os.pathsep.join(
        [f'{tmp_path}/work/install/pkg', f'{tmp_path}/ros', f'{tmp_path}/absent']))
    assert container_root.environment_mounts(f'{tmp_path}/work') == [
        f'{tmp_path}/ros', f'{tmp_path}/source/one', f'{tmp_path}/two', f'{tmp_path}/venv']


def test_the_file_system_of_a_path_is_the_innermost_mount(tmp_path):
    table = tmp_path / 'mountinfo'
    table.write_bytes(
        b'4 1 8:2 / /media/M\xfcller rw - vfat /dev/c rw\n'
        b'5 1 8:3 / /media/a\xe3\x80\x80b rw - xfs /dev/d rw\n'
        b'1 0 8:1 / / rw - ext4 /dev/a rw\n'
        b'2 1 0:5 / /var/lib/cont\\040ainers rw,relatime shared:3 - overlay none rw\n'
        b'3 1 0:6 / /var rw - xfs /dev/b rw\n')
    assert container_root.file_system(Path('/etc'), table) == 'ext4'
    assert container_root.file_system(Path('/media/a\u3000b/c'), table) == 'xfs'
    assert container_root.file_system(Path('/var/log'), table) == 'xfs'
    assert container_root.file_system(Path('/var/lib/cont ainers/x'), table) == 'overlay'


def test_a_root_that_can_t_be_overlaid_is_refused(monkeypatch):
    monkeypatch.setattr(container_root, 'file_system', lambda path: 'overlay')
    with pytest.raises(PrerequisiteError, match="can't be overlaid: .* is on overlay .*image="):
        container.check_root()


@pytest.mark.parametrize('given, words', [
    ({'imag': 'x'}, "no option 'imag' .*did you mean 'image'"),
    ({'engine': 'lxc'}, "no container engine 'lxc'"),
    ({'engine': 'docker'}, "can't use this computer's own root"),
    ({'user': 'Me; rm'}, "can't be a user name"),
    ({'mounts': ['relative']}, "it takes '/path'"),
    ({'mounts': ['/a/../b']}, "it takes '/path'"),
    ({'mounts': ['/tmp:data']}, "it takes '/path'"),
    ({'mounts': ['/no/such/folder']}, "doesn't exist"),
    ({'image': '--privileged'}, "option 'image' can't be '--privileged'"),
    ({'gpus': 'nvidia'}, "it takes 'all' or a number"),
    ({'memory': 4}, "'4' is no amount of memory .memory= takes '2g'"),
    ({'memory': 'lots'}, "'lots' is no amount of memory .memory= takes '2g'"),
    ({'ports': ['80:http']}, "ports= can't hold '80:http' .it takes '8080:80'"),
    ({'ports': ['99999:80']}, "ports= can't hold '99999:80'"),
    ({'devices': ['/dev/no-such']}, "no device '/dev/no-such'"),
])
def test_options_that_make_no_sense_are_refused(given, words):
    with pytest.raises(ConfigurationError, match=words):
        Options.parse(given)


def test_options_are_taken_as_they_are_meant(tmp_path):
    options = Options.parse({
        'image': 'ros:jazzy', 'cpus': 2, 'memory': '1g', 'ports': ['80:80'], 'gpus': 'all',
        'mounts': [str(tmp_path)], 'network': 'n', 'devices': None,
    })
    words = list(container_options.common_flags(
        Engine('docker'), MachineSpec('m', 'container', on_exit='stop'), REQUEST, options))
    for pair in (('--cpus', '2'), ('--memory', '1g'), ('-p', '80:80'), ('--gpus', 'all'),
                 ('--network', 'n'), ('--hostname', 'm'),
                 ('--name', 'fogros2-m'), ('--device', '/dev/net/tun'),
                 ('--label', 'fogros2-name=m'),
                 ('--cap-add', 'NET_ADMIN')):
        assert any(words[i:i + 2] == list(pair) for i in range(len(words))), pair
    # not the 64 MB of the engines
    size = int(words[words.index('--shm-size') + 1])
    assert 0.49 < size / (os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE')) <= 0.5
    # not the 2048 of podman
    threads = int(words[words.index('--pids-limit') + 1])
    assert 2048 < threads <= int(Path('/proc/sys/kernel/pid_max').read_text()) // 2
    # flags of podman alone, which docker refuses
    assert '--privileged' not in words and '--no-hosts' not in words
    assert not any(secret in ' '.join(words) for secret in ('AAAA', '0123-token'))


@pytest.mark.parametrize(('engine', 'gpus', 'flags'), [
    ('docker', 'all', '--gpus all -e NVIDIA_DRIVER_CAPABILITIES=all'),
    ('docker', '2', '--gpus 2 -e NVIDIA_DRIVER_CAPABILITIES=all'),
    ('podman', 'all', '--device nvidia.com/gpu=all'),
    ('podman', '1', '--device nvidia.com/gpu=0'),
    ('podman', '2', '--device nvidia.com/gpu=0 --device nvidia.com/gpu=1')])
def test_number_of_gpus_is_a_count_for_both_engines(engine, gpus, flags):
    words = [*container_options.common_flags(Engine(engine), MachineSpec('m', 'container'),
                                             REQUEST, Options.parse({'gpus': gpus}))]
    text = ' '.join(words)
    assert flags in text and text.count('gpu') == flags.count('gpu')


@pytest.mark.parametrize('spec', [
    MachineSpec('m', 'container', {'containers': True}), MachineSpec('m', 'container')])
@pytest.mark.parametrize('apparmor', [True, False])
@pytest.mark.parametrize('engine', ['podman', 'docker'])
def test_nested_containers_get_their_right_on_request(
        spec, apparmor, engine, tmp_path, monkeypatch):
    monkeypatch.setattr(container_options, 'APPARMOR', tmp_path / ('' if apparmor else 'no'))
    options = Options.parse(spec.options)
    words = list(container_options.common_flags(Engine(engine), spec, REQUEST, options))
    asked = bool(spec.options)
    assert ('SYS_ADMIN' in words, '/var/lib/containers' in words) == (asked, asked)
    assert ('apparmor=unconfined' in words) == (asked and apparmor)
    assert ('seccomp=unconfined' in words) == (asked and engine == 'docker')
    assert '--privileged' not in words and not any('unmask' in word for word in words)


@pytest.mark.skipif(os.geteuid() != 0, reason='root alone sees the folders')
def test_relays_of_one_user_meet_in_folders_of_their_own(monkeypatch, tmp_path):
    monkeypatch.setattr(container_machine, 'SHARED', tmp_path / 'shared')
    spec, request = MachineSpec('m', 'container'), dataclasses.replace(REQUEST, common=['/map'])
    words = list(container_options.common_flags(Engine('podman'), spec, request, Options()))
    folder = container_machine.share_folder('0123-token')
    # a machine writes into its own folder alone
    assert f'{folder}/own:/opt/fogros2/share' in words
    assert f'{folder.parent}:/opt/fogros2/shared:ro,nosuid,nodev,noexec' in words
    # docker's flag -v takes ro alone
    assert ('type=volume,volume-nocopy,volume-opt=type=none,volume-opt=device='
            f'{folder.parent},"volume-opt=o=bind,ro,nosuid,nodev,noexec",dst=/opt/fogros2/shared'
            ) in container_options.common_flags(Engine('docker'), spec, request, Options())
    assert not any('fogros2/share' in word for word in container_options.common_flags(
        Engine('podman'), spec, REQUEST, Options()))
    with pytest.raises(ProviderError), container._sharing(request):
        raise ProviderError('no image')
    assert list(tmp_path.iterdir()) == []
    with container._sharing(request):
        assert [stat.S_IMODE(path.stat().st_mode) for path in (
            folder / 'own', folder, folder.parent, folder.parent.parent,
            folder / 'topics')] == [0o1777, 0o755, 0o755, 0o700, 0o644]
        assert (folder / 'topics').read_text() == '/map\n'
    other, third = (dataclasses.replace(request, token=f'{name}-token')
                    for name in ('other', 'third'))
    with container._sharing(other), pytest.raises(ProviderError):
        with container._sharing(third):
            raise ProviderError('no more memory')
    names = {container_machine.directory(token).name for token in ('0123-token', 'other-token')}
    assert {path.name for path in folder.parent.iterdir()} == names
    monkeypatch.setattr(container.packet_filter, 'unset', lambda name: 'true')
    for name in names:
        subprocess.run(['sh', '-c', container.clean(tmp_path / 'roots' / name)], check=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(('options', 'missing', 'words'), [
    ({}, ['podman'], 'podman not found'), ({}, ['sshd'], 'sshd'),
    ({'image': 'x'}, ['sshd', 'podman'], None),
    ({'image': 'x', 'engine': 'podman'}, ['podman'], 'podman not found'),
    ({'image': 'x'}, ['docker', 'podman'], 'no container engine found'),
    ({'isolated': True}, ['debootstrap'], 'debootstrap'),
])
def test_programs_are_missed_before_sudo_asks(monkeypatch, tmp_path, options, missing, words):
    monkeypatch.setattr(container.process, 'which',
                        lambda program: None if program in missing else f'/usr/bin/{program}')
    monkeypatch.setattr(debian_root, 'cache_folder', lambda: tmp_path)
    monkeypatch.setattr(container.process, 'sudo_trouble', lambda: pytest.fail('asked sudo'))
    monkeypatch.setattr(container.os.path, 'exists', lambda path: True)
    provider, spec = container.ContainerProvider(), MachineSpec('m', 'container', options)
    if words is not None:
        with pytest.raises(PrerequisiteError, match=words):
            provider.check_here(spec)
    else:
        provider.check_here(spec)


def test_member_of_dockers_group_needs_sudo_for_the_filter(monkeypatch):
    monkeypatch.setattr(container_engine, 'select', lambda *_: Engine('docker', sudo=False))
    monkeypatch.setattr(container.ContainerProvider, 'check_here', lambda *_: None)
    monkeypatch.setattr(container.process, 'sudo_trouble', lambda: container.process.NO_RIGHTS)
    with pytest.raises(PrerequisiteError, match='needs root on this computer, and this user may'):
        container.ContainerProvider().check(MachineSpec('m', 'container', {'image': 'any'}))


def test_control_groups_decide_podman_s_flags():
    flags = container_engine.flags_for
    assert flags(unified=True, systemd=True, runc=True) == ()
    assert flags(unified=True, systemd=False, runc=True) == ('--cgroup-manager', 'cgroupfs')
    assert flags(unified=False, systemd=False, runc=True) == (
        '--runtime', 'runc', '--cgroup-manager', 'cgroupfs')
    assert flags(unified=False, systemd=True, runc=False) == ()


def test_other_flags_are_tried_where_control_groups_mislead(monkeypatch):
    monkeypatch.setattr(container_engine, '_WORKED', {})
    monkeypatch.setattr(container_engine.process, 'which', lambda p: p if p == 'runc' else None)
    guess = Engine('podman', ('--cgroup-manager', 'cgroupfs'))
    ways = [engine.flags for engine in container_engine.candidates(guess)]
    assert ways == [
        ('--cgroup-manager', 'cgroupfs'), (), ('--runtime', 'runc'),
        ('--runtime', 'runc', '--cgroup-manager', 'cgroupfs')]
    worked = Engine('podman', ('--runtime', 'runc'))

    def create(engine: Engine) -> str:
        if engine != worked:
            raise ProviderError('crun: invalid file system type on `/sys/fs/cgroup`')
        return 'created'

    assert container_engine.tried(guess, create) == 'created'
    assert next(container_engine.candidates(guess)) == worked
    assert container_engine.named('podman') == worked
    assert list(container_engine.candidates(Engine('docker'))) == [Engine('docker')]


@pytest.mark.parametrize('reason', [
    'the name is already in use', 'OCI runtime error: error running hook #0'])
def test_failure_of_any_runtime_is_final(reason):
    ways = []

    def create(engine):
        ways.append(engine)
        raise ProviderError(reason)

    with pytest.raises(ProviderError, match=reason):
        container_engine.tried(Engine('podman'), create)
    assert len(ways) == 1


def test_limits_never_ask_for_more_than_there_is():
    words = container_engine.limits()
    for word in words[1::2]:
        soft, hard = word.partition('=')[2].split(':')
        assert soft == hard
        assert int(hard) <= 1 << 22


@pytest.mark.parametrize(('version', 'fits'), [
    ('Server: Docker Engine - Community\n Engine:\n  Version: 28.2.2\n runc:\n', True),
    ('Server: Docker Desktop 4.26.1 (131620)\n Engine:\n  Version: 24.0.7\n', False),
    ('Server: Docker Engine - Community\n Engine:\n runc:\n rootlesskit:\n', False)])
def test_docker_whose_network_is_elsewhere_is_refused(monkeypatch, version, fits):
    monkeypatch.setattr(container_engine.process, 'run', lambda *_, **__: Result(0, version, ''))
    if fits:
        container_engine.answers(Engine('docker'))
    else:
        with pytest.raises(PrerequisiteError, match='no network that this computer reaches'):
            container_engine.answers(Engine('docker'))


@pytest.mark.parametrize('options', [
    {'memory': '2g'}, {'memory': '1.5GB'}, {'memory': '1048576'}, {'ports': ['8080:80/udp']},
    {'ports': ['80', '127.0.0.1:8080:80', '9000-9005:9000-9005']}])
def test_options_of_the_engine_are_passed_on(options):
    Options.parse(options)


@pytest.mark.parametrize('stderr, hint', [
    ('Error: mounting overlay failed: invalid argument', 'image='),
    ('Error: write /x: no space left on device', 'disk is full'),
    ('sudo: a password is required', 'sudo -v'),
    ('Error: stat /dev/net/tun: no such file or directory', 'modprobe tun'),
    ('Error: port 8080 is already allocated', 'choose another'),
    ('the packet filter takes no rules for bridges', 'nf_tables'),
])
def test_an_engine_s_failure_has_a_remedy(stderr, hint):
    error = container_engine.translate(CommandError(
        Command(('podman',), what='creating it'), Result(125, '', f'warning\n{stderr}\n'), 'here'))
    assert hint in error.hint
    assert stderr in str(error)


@pytest.mark.parametrize('machine_id', [
    '', 'x', 'podman:123:abcd-1', 'lxc:0123456789ab:abcd-1', 'podman:0123456789ab:../../etc',
    'podman:0123456789ab:', 'podman:0123456789ab:-rf',
])
def test_only_our_own_ids_are_taken(machine_id):
    with pytest.raises(MachineNotFound):
        engine, identity, token = container_machine.parse_id(machine_id)
        container_machine.directory(token)


def test_times_of_both_engines_are_read():
    read = container_machine.timestamp
    assert read('2025-11-21T06:59:00.123456789Z') == pytest.approx(1763708340.123456)
    assert read('2025-11-21T08:59:00.1+02:00') == pytest.approx(1763708340.1)
    assert read('yesterday') == 0.0


def entry_files(**changes) -> bytes:
    return container_entry.archive(**{
        'user': 'fog', 'number': 2013265999, 'authorized_key': 'ssh-ed25519 AAAA me',
        'agent_config': {'machine': 'm', 'end_command': []}, **changes}).data()


def test_first_process_gets_key_and_agent():
    data = entry_files()
    config = json.loads(text(data, 'opt/fogros2/agent.json'))
    assert config['end_command'] == ['kill', '-TERM', '1']
    assert config['user'] == 'fog'
    found = content(data)
    assert stat.S_IMODE(found['opt/fogros2/agent.json'].mode) == 0o600
    assert 'opt/fogros2/agent.py' in found
    assert 'agent.py' not in text(entry_files(agent_config={}), 'opt/fogros2/entry.sh')
    settings = text(data, 'opt/fogros2/sshd_config').splitlines()
    assert {'PasswordAuthentication no', 'KbdInteractiveAuthentication no', 'AllowUsers fog',
            'PermitRootLogin no'} <= set(settings)
    assert text(data, 'opt/fogros2/authorized_keys') == 'ssh-ed25519 AAAA me\n'
    assert not any(name.startswith('etc/containers') for name in found)


def test_host_key_cannot_redirect_the_robot(tmp_path, monkeypatch):
    monkeypatch.setattr(container_machine, 'ROOTS', tmp_path)
    monkeypatch.setattr(os, 'geteuid', lambda: 0)
    entry = {'Id': 'c' * 64, 'Config': {'Labels': {
        container_machine.ATTEMPT: 'token'}}}
    path = container_machine.host_key_file('token')
    path.parent.mkdir(parents=True)
    provider, engine = container.ContainerProvider(), container_engine.named('podman')
    secret = tmp_path / 'secret'
    secret.write_text('ssh-ed25519 c2VjcmV0')
    path.symlink_to(secret)
    assert provider._host_key(engine, entry) is None
    path.unlink()
    os.mkfifo(path)
    assert provider._host_key(engine, entry) is None
    path.unlink()
    path.write_text('root:*:19000: daemon:*:19000:')
    assert provider._host_key(engine, entry) is None
    path.write_text('ssh-ed25519 AAAA+/= fogros2\n')
    assert provider._host_key(engine, entry) == 'ssh-ed25519 AAAA+/='


def test_a_download_of_an_image_can_be_cancelled(monkeypatch):
    def run(command, *, cancel=None, **more):
        if 'create' in command.argv:
            assert cancel is not None and cancel.is_set()
            raise Cancelled('the download')
        return Result(0, '', '')

    monkeypatch.setattr(container_engine.process, 'run', run)
    monkeypatch.setattr(container_engine, 'select', lambda *_: container_engine.named('podman'))
    provider = container.ContainerProvider()
    provider.cancel = threading.Event()
    provider.cancel.set()
    with pytest.raises(Cancelled):
        provider.create(MachineSpec('m', 'container', {'image': 'large'}), REQUEST)


@pytest.mark.parametrize('options', [{'image': 'large'}, {'isolated': True}])
def test_downloads_by_sudo_get_the_users_proxies(monkeypatch, tmp_path, options):
    downloads = []

    def run(command, **more):
        if {'create', 'unshare'} & {*command.argv}:
            downloads.append(command)
            raise Cancelled('the download')
        return Result(0, '', '')

    monkeypatch.setattr(container_engine.process, 'run', run)
    monkeypatch.setattr(container_engine.process, '_ENVIRONMENT', {
        'HOME': '/home/me', 'HTTPS_PROXY': 'http://proxy:3128', 'no_proxy': 'localhost',
        'http_proxy': 'http://me:secret@proxy:3128'})
    monkeypatch.setattr(container_engine, 'select', lambda *_: container_engine.named('podman'))
    monkeypatch.setattr(debian_root, 'cache_folder', lambda: tmp_path)
    monkeypatch.setattr(debian_root, 'release', lambda: debian_root.parse_release(
        'ubuntu', 'noble', TARGETS))
    with pytest.raises(Cancelled):
        container.ContainerProvider().create(MachineSpec('m', 'container', options), REQUEST)
    assert [command.argv[:4] for command in downloads] == [(
        'env', 'HTTPS_PROXY=http://proxy:3128', 'no_proxy=localhost',
        'podman' if 'image' in options else 'unshare')]
    assert downloads[0].sudo


@pytest.mark.parametrize(('owner', 'words', 'remedy'), [
    ('bob-1001', "'m' of the robot bob-1001 already", 'another name='),
    (None, "'m' already", 'another name='),
    ('me-1000', "'m' already", 'ros2 fog delete m')])
def test_machine_of_another_robot_is_not_the_one_to_delete(monkeypatch, owner, words, remedy):
    def run(command, **more):
        if 'create' in command.argv:
            raise CommandError(command, Result(125, '', 'the name is in use'), 'here')
        labels = {container_machine.ATTEMPT: 'theirs', 'fogros2-robot': owner}
        return Result(0, json.dumps([{'Config': {'Labels': labels}}]), '')

    monkeypatch.setattr(container_engine.process, 'run', run)
    monkeypatch.setattr(container_engine, 'select', lambda *_: container_engine.named('docker'))
    request = dataclasses.replace(REQUEST, tags={'fogros2-robot': 'me-1000'})
    with pytest.raises(NameTaken) as taken:
        container.ContainerProvider().create(
            MachineSpec('m', 'container', {'image': 'any'}), request)
    assert words in taken.value.args[0] and taken.value.hint.endswith(remedy)


@pytest.mark.parametrize('script', ['_CREATE', '_SHARE'])
def test_folder_that_root_cannot_make_has_a_reason(tmp_path, script):
    (tmp_path / 'disk').touch()
    done = subprocess.run(
        ['sh', '-ec', getattr(container, script), 'sh', f'{tmp_path}/disk/fogros2/top', *'biencs'],
        capture_output=True, text=True, timeout=60)
    assert done.returncode not in (0, container._TOKEN_USED)
    assert 'Not a directory' in done.stderr.splitlines()[-1]


def test_docker_machine_gets_its_packet_filter_at_once(monkeypatch):
    commands = []

    def run(command, **more):
        commands.append(command)
        labels = {container_machine.ATTEMPT: '0123-token'}
        return Result(0, json.dumps([{'State': {'Pid': 77}, 'Config': {'Labels': labels}}]), '')

    monkeypatch.setattr(container_engine.process, 'run', run)
    container.ContainerProvider().start('docker:0123456789ab:0123-token')
    assert [command.argv[1] for command in commands] == [
        'container', 'start', 'container', '-c']
    name = container_machine.directory('0123-token').name
    assert commands[-1].argv[-1] == f'fogros2-{name}' and commands[-1].sudo
    assert json.loads(commands[-1].input) == {'pid': 77}


@pytest.mark.parametrize('group', [True, False])
def test_end_of_docker_machine_removes_its_filter_as_root(monkeypatch, group):
    commands = []

    def run(command, **more):
        commands.append(command)
        return Result(0, '', '')

    monkeypatch.setattr(container_engine.process, 'run', run)
    monkeypatch.setattr(container_engine, '_WORKED', {'docker': Engine('docker', sudo=not group)})
    container.ContainerProvider().destroy('docker:0123456789ab:0123-token')
    assert [command.sudo for command in commands if 'docker' in command.argv] == [not group]
    assert [command.sudo for command in commands
            if any('delete table' in word for word in command.argv)] == [True]


def test_filter_that_stays_is_reported(monkeypatch):
    def run(command, **more):
        result = Result(int(command.sudo), '', 'sudo: a password is required' * command.sudo)
        if result.returncode and more.get('check', True):
            raise CommandError(command, result, 'here')
        return result

    monkeypatch.setattr(container_engine.process, 'run', run)
    monkeypatch.setattr(container_engine, '_WORKED', {'docker': Engine('docker', sudo=False)})
    with pytest.raises(ProviderError, match='removing the packet filter .*sudo -v'):
        container.ContainerProvider().destroy('docker:0123456789ab:0123-token')


@pytest.mark.parametrize(('said', 'stopped'), [
    ('Cannot connect to the Docker daemon at unix:///var/run/docker.sock. Is the docker daemon '
     'running?', True),
    ('failed to connect to the docker API at unix:///var/run/docker.sock; check if the path is '
     'correct and if the daemon is running: dial unix /var/run/docker.sock: connect: connection '
     'refused', True),
    ('permission denied while trying to connect to the Docker daemon socket at '
     'unix:///var/run/docker.sock', False),
    ('permission denied while trying to connect to the docker API at '
     'unix:///var/run/docker.sock', False)])
def test_docker_whose_service_is_stopped_has_no_machines(monkeypatch, said, stopped):
    monkeypatch.setattr(container_engine, 'installed', lambda: [Engine('docker')])
    monkeypatch.setattr(container_engine.process, 'run', lambda *_, **more: Result(1, '', said))
    provider = container.ContainerProvider()
    if stopped:
        assert list(provider.find({})) == []
    else:
        with pytest.raises(ProviderError, match='permission denied'):
            list(provider.find({}))


def test_isolated_machine_sees_nothing_of_this_computers_system(tmp_path):
    for name in ('usr/bin', 'etc/pam.d', 'var/lib/dpkg'):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / 'bin').symlink_to('usr/bin')
    (tmp_path / 'etc/passwd').write_text('root:x:0:0:root:/root:/bin/bash\n')
    (tmp_path / 'etc/group').write_text('root:x:0:\n')
    (tmp_path / 'etc/os-release').write_text('ID=other\n')
    assert container_root.system_mounts(str(tmp_path)) == ('/usr', '/var/lib')
    found = content(
        container_root.skeleton(str(tmp_path)) + container_root.Archive().data())
    assert found['bin'].linkname == 'usr/bin'
    assert 'etc/os-release' in found and 'etc/ssl/certs' not in found


TARGETS = """\
Extra noble main http://x.example/ros
Ubuntu noble main http://m.example/ubuntu/
Ubuntu noble universe http://m.example/ubuntu/
Ubuntu noble-security main http://s.example/ubuntu/
Ubuntu jammy main http://m.example/ubuntu/
"""


def test_isolated_root_comes_from_the_releases_own_sources():
    own = debian_root.parse_release('ubuntu', 'noble', TARGETS)
    assert (own.address, own.components) == ('http://m.example/ubuntu/', ('main', 'universe'))
    assert own.sources == (
        'deb http://m.example/ubuntu/ noble main', 'deb http://m.example/ubuntu/ noble universe',
        'deb http://s.example/ubuntu/ noble-security main')
    folder = Path('/cache')
    assert len({debian_root.path(folder, release, packages) for release, packages in (
        (own, ('a', 'b')), (own, ('b', 'a')), (own, ('a',)),
        (dataclasses.replace(own, codename='jammy'), ('a',)))}) == 3


@pytest.mark.parametrize('system, targets', [
    ('ubuntu', ''), ('fedora', TARGETS),
    ('ubuntu', 'Ubuntu noble main http://me:secret@m.example/ubuntu/\n')])
def test_computer_without_own_sources_gets_a_hint(system, targets):
    with pytest.raises(PrerequisiteError, match='knows no packages') as error:
        debian_root.parse_release(system, 'noble', targets)
    assert 'image=' in error.value.hint


@pytest.mark.parametrize(('options', 'own'), [({}, False), ({'image': 'theirs'}, True)])
def test_packages_of_a_container_image_are_its_own(options, own):
    spec = MachineSpec('m', 'container', options)
    assert container.ContainerProvider().has_own_packages(spec) is own


def test_request_may_create_while_a_program_works_at_it(monkeypatch, tmp_path):
    monkeypatch.setattr(container_machine, 'ROOTS', tmp_path)
    monkeypatch.setattr(os, 'geteuid', lambda: 0)
    provider, token = container.ContainerProvider(), secrets.token_hex(8)
    # the engine's command, which has no token
    words = list(container_options.common_flags(
        Engine('podman'), MachineSpec('m', 'container'),
        dataclasses.replace(REQUEST, token=token), Options()))
    assert not provider.may_create(token, 0.0)
    engine = subprocess.Popen(['sh', '-c', 'echo; read line', 'podman', 'run', *words],
                              stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert engine.stdout is not None and engine.stdout.readline()
        assert provider.may_create(token, 1e9)
        assert provider.tidy([token]) == []
    finally:
        engine.communicate(b'')
    assert not provider.may_create(token, 0.0)


def test_folder_of_a_killed_creation_goes(monkeypatch, tmp_path):
    monkeypatch.setattr(container_machine, 'ROOTS', tmp_path / 'roots')
    monkeypatch.setattr(container.packet_filter, 'unset', lambda name: 'true')
    monkeypatch.setattr(os, 'geteuid', lambda: 0)
    provider = container.ContainerProvider()
    monkeypatch.setattr(provider, '_containers', lambda tags: [
        (Engine('podman'), {'Config': {'Labels': {container_machine.ATTEMPT: 'with-container'}}})])
    tops = {token: container_machine.directory(token) for token in (
        'with-container', 'killed', 'fresh')}
    for token, top in tops.items():
        (top / 'root').mkdir(parents=True)
        os.utime(top, None if token == 'fresh' else (0, 0))
    assert provider.tidy() == [f"the folder {tops['killed']}"]
    # of a launch that is known to have died
    assert provider.tidy(['fresh', 'with-container']) == [f"the folder {tops['fresh']}"]
    assert [top.exists() for top in tops.values()] == [True, False, False]


def test_folder_of_mounts_is_read_only(tmp_path):
    options = Options.parse({'mounts': [str(tmp_path), f'{tmp_path}:/data']})
    words = [*container_options.common_flags(
        Engine('podman'), MachineSpec('m', 'container'), REQUEST, options)]
    assert [word for word in words if word.startswith(str(tmp_path))] == [
        f'{tmp_path}:{tmp_path}:ro', f'{tmp_path}:/data:ro']

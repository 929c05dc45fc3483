# SPDX-License-Identifier: Apache-2.0
"""Tests of container machines with a real engine."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import dataclasses
import json
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import uuid

import pytest

from fogros2 import process
from fogros2.errors import (
    HostKeyError,
    MachineNotFound,
    ProviderError,
    ShellError,
    Unsupported,
)
from fogros2.model import Command, Machine, MachineState
from fogros2.provider.container import ContainerProvider, filter_name, login_ids
from fogros2.provider.container import machine as container_machine
from fogros2.provider.container import root as container_root
from fogros2.shell.ssh import SSHShell
from fogros2.waiting import wait_until
from fogros2_testing import ProviderContract
from rigs.container_machines import Cloud, cloud, clouds, key

__all__ = ['cloud', 'clouds', 'key']

pytestmark = [
    pytest.mark.usefixtures('engine'),
    pytest.mark.skipif(process.which('sshd') is None, reason='needs sshd (openssh-server)'),
]


class TestContainerProvider(ProviderContract):

    @pytest.fixture(autouse=True)
    def network(self, cloud_network):
        self.options = {'network': cloud_network}

    def make(self):
        return ContainerProvider(), self.options

    def test_stopped_machine_starts_again(self, cloud):
        """With its disk and its key."""
        spec = cloud.spec(on_exit='stop')
        first = cloud.reached(cloud.create(spec))
        with cloud.shell(first) as shell:
            shell.put(b'kept', '~/file', mode=0o600)
            said(shell, 'touch', '/usr/local/bin/kept', '/var/lib/kept', '/etc/kept', sudo=True)
        cloud.provider.stop(first.id)
        stopped = cloud.provider.describe(first.id)
        assert stopped.state is MachineState.STOPPED
        assert stopped.endpoint is None
        assert [m.state for m in cloud.provider.find({'fogros2-name': spec.name})] == [
            MachineState.STOPPED]
        cloud.provider.start(first.id)
        again = cloud.reached(first.id)
        assert again.id == first.id
        assert again.endpoint.host_key == first.endpoint.host_key
        with cloud.shell(again) as shell:
            assert said(shell, 'cat', 'file') == 'kept'
            said(shell, 'ls', '/usr/local/bin/kept', '/var/lib/kept', '/etc/kept')
            # by itself too it ends as stopped
            with contextlib.suppress(ShellError):
                shell.run(Command(again.end_command, sudo=True), timeout=60.0)
        wait_until(lambda: cloud.provider.describe(first.id).state is MachineState.STOPPED,
                   timeout=60.0, what='the machine to stop')


def said(shell: SSHShell, *words: str, sudo: bool = False) -> str:
    return shell.run(Command(words, sudo=sudo), timeout=60.0).stdout.strip()


@pytest.fixture(scope='module')
def one(clouds: Cloud) -> Iterator[tuple[Machine, SSHShell]]:
    """Return a machine that several tests look at."""
    with clouds.machine() as made:
        yield made


def test_a_machine_has_its_own_name_address_users_and_processes(one):
    machine, shell = one
    assert said(shell, 'hostname') == machine.name
    assert machine.vpn_host in said(shell, 'hostname', '-I').split()
    assert said(shell, 'id', '-un') == 'fog'
    assert said(shell, 'id', '-u', sudo=True) == '0'
    assert said(shell, 'pwd') == '/home/fog'
    assert len(said(shell, 'ps', '-e', '-o', 'pid=').splitlines()) < 12
    assert said(shell, 'printenv', 'LANG') == 'C.UTF-8'
    # half of the memory, as on other computers, not 64 MB
    shared = int(said(shell, 'df', '--output=size', '/dev/shm').split()[-1]) << 10
    assert shared > 0.4 * os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE')


def test_nothing_of_this_computer_s_own_is_seen(one, tmp_path):
    _, shell = one
    secret = tmp_path / 'secret'
    secret.write_text('secret')
    # a home that has Python's environment in it shows that folder and nothing beside it
    homes = {'fog', *Path(sys.prefix).parts[2:3]} if sys.prefix.startswith('/home/') else {'fog'}
    assert set(said(shell, 'ls', '-A', '/home').split()) == homes
    for folder in ('/srv', '/mnt', '/media', '/root/.ssh'):
        assert not said(shell, 'sh', '-c', f'ls -A {folder} 2>/dev/null || :', sudo=True)
    # where Python's environment is mounted, its folder and nothing beside it
    hidden = said(shell, 'sh', '-c', (
        f'ls -d {secret} /etc/ssh/ssh_host* /etc/wireguard /etc/kubernetes /etc/fstab '
        '/var/lib/containers /etc/ssl/private 2>/dev/null || :'), sudo=True)
    assert hidden == ''
    shadow = said(shell, 'cat', '/etc/shadow', sudo=True)
    assert all(line.split(':')[1] == '*' for line in shadow.splitlines())
    people = [line for line in said(shell, 'cat', '/etc/passwd').splitlines()
              if int(line.split(':')[2]) >= 1000 and 'nobody' not in line]
    assert [line.split(':')[0] for line in people] == ['fog']
    assert os.uname().nodename not in said(shell, 'cat', '/etc/hosts').split()


def test_a_machine_writes_and_mounts_nothing_here(one):
    _, shell = one
    mark = f'/usr/local/bin/fogros2-{uuid.uuid4().hex}'
    said(shell, 'touch', mark, '/etc/fogros2-mark', sudo=True)
    assert said(shell, 'ls', mark) == mark
    assert not os.path.exists(mark)
    if shutil.which('dpkg'):
        assert 'installed' in said(shell, 'dpkg-query', '-W', '-f', '${Status}', 'bash')
        # a package can be configured: scripts, database, alternatives, all there
        said(shell, 'sh', '-c', 'dpkg --configure -a && update-alternatives --get-selections',
             sudo=True)
    said(shell, 'ip', 'tuntap', 'add', 'fogtest', 'mode', 'tun', sudo=True)
    assert 'fogtest' in said(shell, 'ip', 'link', 'show', 'fogtest')
    assert said(shell, sys.executable, '-c', 'import paramiko, sys; print(sys.prefix)') \
        == sys.prefix
    for refused in (('mount', '-t', 'tmpfs', 'none', '/mnt'),
                    *([] if sys.prefix.startswith('/usr') else [('touch', f'{sys.prefix}/x')])):
        assert shell.run(Command(refused, sudo=True), timeout=60.0, check=False).returncode != 0


def test_the_host_key_is_the_machine_s_own_and_pinned(clouds, one):
    machine, shell = one
    own = said(shell, 'cat', '/etc/ssh/fogros2_host_ed25519_key.pub').split()[:2]
    assert machine.endpoint.host_key.split() == own
    pinned = dataclasses.replace(
        machine, endpoint=dataclasses.replace(machine.endpoint, host_key=(
            'ssh-ed25519 '
            'AAAAC3NzaC1lZDI1NTE5AAAAINhr1xZ0GZJ4Mqbso1vdFbxmsNCtINbcVrdTGUPNy8U9')))
    with clouds.shell(pinned, user='fog') as other, pytest.raises(HostKeyError):
        other.run(Command(('true',)), timeout=60.0)
    with clouds.shell(machine, user='root') as other, pytest.raises(ShellError):
        other.run(Command(('true',)), timeout=60.0)


def test_full_disk_of_a_machine_is_named(one, tmp_path):
    machine, shell = one
    source = tmp_path / 'source'
    source.mkdir()
    with open(source / 'big', 'wb') as file:
        file.truncate(80 << 20)
    # the engine's /dev has 64 MB
    shell.run(Command(('install', '-d', '-m', '1777', '/dev/small'), sudo=True), timeout=60.0)
    with pytest.raises(ShellError, match=f"disk of '{machine.name}' is full"):
        shell.sync(source, '/dev/small/x', excludes=[], timeout=60.0)


def agent_config(*, robot_timeout, boot_timeout):
    return {
        'machine': 'm', 'launch': 'abc',
        'directory': ContainerProvider.capabilities.agent_directory,
        'on_exit': 'delete', 'lifetime': 600, 'robot_timeout': robot_timeout,
        'boot_timeout': boot_timeout, 'end_command': []}


def test_options_and_agent_reach_a_machine_until_it_ends(cloud, tmp_path):
    (tmp_path / 'data').mkdir()
    (tmp_path / 'data/file').write_text('here')
    (tmp_path / 'data').chmod(0o755)
    machine = cloud.reached(cloud.create(cloud.spec(options={
        'user': 'rosuser', 'mounts': [f'{tmp_path}/data:/data'], 'memory': '200m', 'cpus': 0.5,
    }), agent_config=agent_config(robot_timeout=60, boot_timeout=600)))
    with cloud.shell(machine) as shell:
        assert machine.endpoint.user == 'rosuser'
        assert said(shell, 'pwd') == '/home/rosuser'
        assert said(shell, 'id', '-u', sudo=True) == '0'
        assert said(shell, 'cat', '/data/file') == 'here'
        assert shell.run(Command(('touch', '/data/x'), sudo=True), timeout=60.0,
                         check=False).returncode != 0
        told = process.run(Command(('podman', 'inspect', f'fogros2-{machine.name}'), sudo=True),
                           timeout=60.0).stdout
        host = json.loads(told)[0]['HostConfig']
        assert host['Memory'] == 200 << 20
        assert host['NanoCpus'] == 500_000_000
        assert host['Privileged'] is False
        # it is made to be deleted at its end
        with pytest.raises(Unsupported, match="on_exit='stop'"):
            cloud.provider.stop(machine.id)

        def running() -> str:
            return shell.run(Command(('pgrep', '-f', 'agent.py serve')), timeout=60.0,
                             check=False).stdout.strip()

        wait_until(lambda: shell.run(
            Command(('test', '-S', '/run/fogros2/agent.sock')), timeout=60.0,
            check=False).returncode == 0, timeout=60.0, what="the agent's socket")
        first = running()
        said(shell, 'kill', '-KILL', first, sudo=True)
        # the one that is killed may be there a moment longer
        wait_until(lambda: running() not in ('', first), timeout=60.0, what='the agent to return')
        with contextlib.suppress(ShellError):
            shell.run(Command(machine.end_command, sudo=True), timeout=60.0)

    def gone() -> bool:
        try:
            cloud.provider.describe(machine.id)
        except MachineNotFound:
            return True
        return False

    wait_until(gone, timeout=60.0, what='the machine to end')
    wait_until(lambda: not cloud.traces(), timeout=60.0, what='its root and filter to go')
    cloud.provider.destroy(machine.id)


def test_failed_creation_leaves_nothing(cloud):
    with pytest.raises(ProviderError, match='no-such-network'):
        cloud.create(cloud.spec(options={'network': 'no-such-network'}))
    with pytest.raises(ProviderError, match='no network of its own.*takes a bridge network'):
        cloud.create(cloud.spec(options={'network': 'host'}))


_KILLED = """
from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider.container import ContainerProvider
spec = MachineSpec({name!r}, 'container', {options!r})
ContainerProvider().create(spec, CreateRequest(
    {token!r}, 'ssh-ed25519 AAAA', {{'fogros2-name': {name!r}}}, 51820))
"""


def interrupted(cloud, number, when, path=''):
    """
    End a launch while it creates, and delete what ``find`` knows then; return what is left.

    :param when: whether it is time, given the machine's token.
    :param path: folder whose programs hide others.
    """
    spec, token = cloud.spec(), str(uuid.uuid4())
    child = subprocess.Popen(
        [sys.executable, '-c', _KILLED.format(name=spec.name, options=spec.options, token=token)],
        stderr=subprocess.DEVNULL,
        env={**os.environ, 'PATH': os.pathsep.join([path, os.environ['PATH']])},
        # a job in a shell's background ignores it, and so would its Python
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    wait_until(lambda: when(token), timeout=60.0, what='the request')
    child.send_signal(number)
    child.wait(60.0)
    wait_until(lambda: not cloud.provider.may_create(token, 0.0), timeout=60.0,
               what='the engine to finish')
    for machine in cloud.provider.find({'fogros2-name': spec.name}):
        cloud.provider.destroy(machine.id)
    return process.run(Command(('ls', str(container_machine.directory(token))), sudo=True),
                       timeout=60.0, check=False).stdout


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGINT])
def test_launch_that_ends_while_it_creates_leaves_all_or_nothing(cloud, number):
    assert not interrupted(cloud, number, lambda token: cloud.provider.may_create(token, 0.0))


#: Podman on a busy computer, which creates a container, starts it late, and removes slowly.
_BUSY = """\
#!/bin/sh
case " $* " in
*" run -d "*)
    for word; do
        shift
        case $word in run) word=create ;; -d) continue ;; esac
        set -- "$@" "$word"
    done
    {0} "$@"
    sleep 3
    : >"${{0%/*}}/finished"
    exit 1 ;;
*" rm -f "*)
    {0} "$@"
    exec sleep 4 ;;
esac
exec {0} "$@"
"""


@pytest.mark.skipif(os.getuid() != 0, reason='sudo looks for podman in folders of its own')
def test_interrupted_creation_on_a_busy_computer_leaves_nothing(cloud, tmp_path):
    podman = tmp_path / 'podman'
    podman.write_text(_BUSY.format(shutil.which('podman')))
    podman.chmod(0o755)
    assert not interrupted(
        cloud, signal.SIGINT, lambda token: (container_machine.directory(token) / 'cid').exists(),
        str(tmp_path))
    # an engine that is killed while it creates leaves a network namespace
    assert (tmp_path / 'finished').exists()


@pytest.fixture(scope='module')
def image(engine: str) -> Iterator[str]:
    """Return an image with one user and no key; its programs are this computer's, by mounts."""
    name = f'localhost/fogt{uuid.uuid4().hex[:8]}'
    archive = container_root.Archive()
    for folder in ('proc', 'sys', 'dev', 'tmp', 'etc/ssh', 'usr', 'root', 'home', 'var/mail'):
        archive.folder(folder)
    for link in ('bin', 'sbin', 'lib', 'lib64', 'lib32'):
        if os.path.islink(f'/{link}'):
            archive.link(link, os.readlink(f'/{link}'))
    for path in ('/etc/ld.so.cache', '/etc/nsswitch.conf', '/etc/login.defs', '/etc/shells'):
        if os.path.exists(path):
            archive.file(path[1:], Path(path).read_bytes())
    archive.file('etc/passwd', b'root:x:0:0:root:/root:/bin/sh\n'
                 b'sshd:x:102:65534::/run/sshd:/usr/sbin/nologin\n'
                 b'worker:x:1000:1000::/home/worker:/bin/sh\n')
    archive.file('etc/group', b'root:x:0:\nnogroup:x:65534:\nworker:x:1000:\n')
    archive.file('etc/shadow', b'root:*:::::::\nworker:!:::::::\n', 0o600)
    archive.folder('home/worker', 0o700, 1000)
    archive.file('home/worker/own', b'', 0o600, 1000)
    archive.file('etc/sudoers', b'root ALL=(ALL:ALL) ALL\n', 0o440)
    for service in ('sudo', 'other', 'useradd', 'usermod', 'chpasswd'):
        archive.file(f'etc/pam.d/{service}', b''.join(
            b'%s sufficient pam_permit.so\n' % kind
            for kind in (b'auth', b'account', b'session', b'password')))
    process.run(Command((engine, 'import', '-', name), sudo=True, input=archive.data()),
                timeout=60.0)
    yield name
    process.run(Command((engine, 'rmi', name), sudo=True), timeout=60.0)


@pytest.mark.skipif(not os.path.islink('/bin'), reason='needs a system with a merged /usr')
def test_an_image_gets_user_key_and_server_at_boot(image, cloud):
    spec = cloud.spec(on_exit='stop', options={'image': image, 'mounts': ['/usr']})
    before = set(os.listdir('/var/tmp'))
    machine = cloud.reached(cloud.create(spec))
    # podman's name of a copy has digits alone; those of tests beside this one go by themselves
    wait_until(lambda: not [name for name in set(os.listdir('/var/tmp')) - before
                            if name.isdigit()], timeout=60.0, what='no copy in /var/tmp')
    with cloud.shell(machine) as shell:
        assert said(shell, 'hostname') == spec.name
        assert said(shell, 'pwd') == '/home/fog'
        assert int(said(shell, 'id', '-u')) in login_ids.IDS
        assert said(shell, 'id', '-u', sudo=True) == '0'
        shell.put(b'kept', '~/file', mode=0o600)
    assert cloud.create(spec, token=machine.id.split(':')[2]) == machine.id
    packet_filter = filter_name(container_machine.directory(machine.id.split(':')[2]))
    assert cloud.traces().count(packet_filter) == 2
    cloud.provider.stop(machine.id)
    assert packet_filter not in cloud.traces()
    cloud.provider.start(machine.id)
    assert cloud.traces().count(packet_filter) == 2
    again = cloud.reached(machine.id)
    assert again.endpoint.host_key == machine.endpoint.host_key
    with cloud.shell(again) as shell:
        assert said(shell, 'cat', 'file') == 'kept'


@pytest.mark.skipif(not os.path.islink('/bin'), reason='needs a system with a merged /usr')
def test_user_of_an_image_gets_an_id_that_nobody_has(image, cloud):
    with cloud.machine(options={'image': image, 'mounts': ['/usr'], 'user': 'worker'}) as (
            _, shell):
        number = said(shell, 'id', '-u')
        assert int(number) in login_ids.IDS
        assert said(shell, 'stat', '-c', '%u', 'own') == number


def test_incomplete_image_is_reported(image, cloud):
    mounts = [path for path in ('/usr/lib', '/usr/lib64', '/usr/lib32') if os.path.isdir(path)]
    machine_id = cloud.create(cloud.spec(on_exit='stop', options={
        'image': image, 'mounts': [f"{os.path.realpath('/bin/sh')}:/bin/sh", *mounts]}))

    def fails() -> str:
        try:
            cloud.provider.describe(machine_id)
        except ProviderError as error:
            return str(error)
        return ''

    assert 'the image lacks sshd sudo rsync python3' in wait_until(
        lambda: fails() or None, timeout=60.0, what='the machine to complain')

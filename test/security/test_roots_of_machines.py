# SPDX-License-Identifier: Apache-2.0
"""
The files of a container machine, and accounts of the computer that runs it.

Root on the machine makes any file in the machine's root, with any owner and mode: the machine may
be hijacked. The account on this computer may have any id that an account here can have.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import dataclasses
import json
import os
from pathlib import Path
import pwd
import stat
import subprocess
import uuid

import pytest

from fogros2 import process
from fogros2.errors import PrerequisiteError
from fogros2.model import Command, Machine
from fogros2.provider.container import login_ids
from fogros2.provider.container import machine as container_machine
from fogros2.provider.container import root as container_root
from fogros2.shell.ssh import SSHShell
from rigs.container_machines import Cloud, cloud_network, clouds, engine
from rigs.stranger import NOBODY

__all__ = ['cloud_network', 'clouds', 'engine']

#: The first account of most computers has it.
FIRST_ACCOUNT = 1000
#: Becomes another account, and prints the paths that it can look into.
LOOK = """\
import os, sys
os.setgroups([]), os.setgid(int(sys.argv[1])), os.setuid(int(sys.argv[1]))
for path in sys.argv[2:]:
    try:
        os.stat(path + '/etc')
        print(path)
    except OSError:
        pass
"""
#: Runs a program of a folder that root has opened, as another account.
RUN = """\
import os, sys
folder = os.open(sys.argv[1], os.O_RDONLY)
os.set_inheritable(folder, True)
os.setgroups([]), os.setgid(65534), os.setuid(65534)
os.execv(f'/proc/self/fd/{folder}/{sys.argv[2]}', ['id', '-u'])
"""
#: Opens a device of a folder that root has opened, as another account.
OPEN = """\
import os, sys
folder = os.open(sys.argv[1], os.O_RDONLY)
os.setgroups([]), os.setgid(65534), os.setuid(65534)
os.open(sys.argv[2], os.O_RDONLY, dir_fd=folder)
"""
#: Notes the command lines of all processes, and goes on as the engine.
SPY = """\
#!/bin/sh
cat /proc/[0-9]*/cmdline >>"{log}" 2>/dev/null
exec {engine} "$@"
"""


def sudo(script: str, *words: str) -> None:
    process.run(Command(('sh', '-ec', script, 'sh', *words), sudo=True), timeout=60.0)


def python(code: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run code as root, without the folders of this environment."""
    return subprocess.run(
        process.argv(Command(('/usr/bin/python3', '-IS', '-c', code, *words), sudo=True)),
        capture_output=True, text=True, timeout=60)


def folder_of(machine_id: str) -> Path:
    return container_machine.directory(machine_id.split(':')[2])


def processes(machine_id: str) -> list[str]:
    """Return the ids of a machine's processes."""
    said = process.run(Command(('podman', 'top', machine_id.split(':')[1], 'hpid'), sudo=True),
                       timeout=60.0).stdout
    return said.split()[1:]


@dataclasses.dataclass(frozen=True)
class Attacked:
    """
    A machine whose root is hijacked.

    :param own: folder in /usr/local, ``underlay`` one of ROS 2; both have public and secret files.
    :param log: command lines of this computer at each call of the engine.
    """

    machine: Machine
    shell: SSHShell
    own: str
    underlay: str
    module: str
    log: Path


def plant(folder: str, name: str) -> None:
    """Add a secret file and a folder to a folder of root's."""
    sudo('umask 077; cd "$1"; echo secret >"a secret $2"; mkdir "closed $2"; '
         'echo secret >"closed $2/file"', folder, name)


@pytest.fixture(scope='module', params=['created', 'started again'])
def attacked(
    request: pytest.FixtureRequest, clouds: Cloud, tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Attacked]:
    """Return a machine; one that is started again has no mount from before, as after a boot."""
    folder = tmp_path_factory.mktemp('attacked')
    own = f'/usr/local/share/fogros2-test-{uuid.uuid4().hex}'
    log, module, underlay = folder / 'log', folder / 'module.py', folder / 'underlay'
    log.touch()
    spy = folder / 'bin/podman'
    spy.parent.mkdir()
    spy.write_text(SPY.format(log=log, engine=process.which('podman')))
    spy.chmod(0o755)
    module.write_text('public too\n')
    underlay.mkdir()
    folder.chmod(0o755)
    underlay.chmod(0o755)
    try:
        for path in own, str(underlay):
            sudo('umask 022; mkdir -p "$1"; echo public >"$1/public"', path)
            plant(path, 'before')
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(container_root, 'editable', lambda site: [str(module)])
            patch.setenv('AMENT_PREFIX_PATH', str(underlay), os.pathsep)
            if os.geteuid() == 0:  # sudo looks for programs in folders of its own
                patch.setitem(
                    process._ENVIRONMENT, 'PATH', f'{spy.parent}:{os.environ["PATH"]}')
            machine_id = clouds.create(clouds.spec(on_exit='stop'), common=['/map'])
            if request.param == 'started again':
                clouds.reached(machine_id)
                clouds.provider.stop(machine_id)
                # what comes after the search that its creation needed
                plant(own, 'after')
                process.run(Command(('umount', str(folder_of(machine_id))), sudo=True),
                            timeout=60.0, check=False)
                clouds.provider.start(machine_id)
            machine = clouds.reached(machine_id)
            with clouds.shell(machine) as shell:
                yield Attacked(machine, shell, own, str(underlay), str(module), log)
            clouds.provider.destroy(machine_id)
            assert machine_id.split(':')[2].encode() not in log.read_bytes()
    finally:
        sudo('rm -rf "$@"', own, str(underlay))


def test_no_account_looks_into_a_machine_s_root(attacked: Attacked) -> None:
    machine, shell = attacked.machine, attacked.shell
    # the machine's user has a process, as the nodes are
    shell.run(Command(('sh', '-c', 'sleep 600 >/dev/null 2>&1 &')), timeout=60.0)
    number = int(shell.run(Command(('id', '-u')), timeout=60.0).stdout)
    assert number in login_ids.IDS
    with contextlib.suppress(KeyError):
        pytest.fail(f'{pwd.getpwuid(number)} has it')
    roots = [f'/proc/{pid}/root' for pid in processes(machine.id)]
    top = folder_of(machine.id)
    own = str(top / 'root')
    assert python(LOOK, '0', own, *roots).stdout.splitlines() == [own, *roots]
    for account in (FIRST_ACCOUNT, NOBODY):
        # what the id of the account itself may look into is its own: /proc/PID/root is not
        assert python(LOOK, str(account), own, *roots).stdout == ''
    modes = [stat.S_IMODE(int(said, 16)) for said in process.run(
        Command(('stat', '-c', '%f', str(top), str(top.parent)), sudo=True),
        timeout=60.0).stdout.split()]
    assert modes == [0o700, 0o700]


def test_setuid_file_and_device_of_a_machine_are_none_here(attacked: Attacked) -> None:
    opt = folder_of(attacked.machine.id) / 'root/opt'
    attacked.shell.run(Command(('sh', '-ec', 'cp -L /usr/bin/id /opt/id; chmod 4755 /opt/id; '
                                'mknod -m 666 /opt/null c 1 3'), sudo=True), timeout=60.0)
    # programs of the system get their rights there
    assert attacked.shell.run(
        Command(('sudo', '-n', 'id', '-u')), timeout=60.0).stdout == '0\n'
    assert python(RUN, str(opt), 'id').stdout == f'{NOBODY}\n'
    assert 'PermissionError' in python(OPEN, str(opt), 'null').stderr


def test_root_on_a_machine_reads_no_private_file_here(attacked: Attacked) -> None:
    for path, lines in ((attacked.own, {'public'}), (attacked.underlay, {'public'}),
                        (attacked.module, {'public too'})):
        read = attacked.shell.run(Command(('grep', '-rhs', '', path), sudo=True), timeout=60.0,
                                  check=False).stdout
        assert {*read.splitlines()} == lines
    undo = attacked.shell.run(Command(('umount', f'{attacked.own}/a secret before'), sudo=True),
                              timeout=60.0, check=False)
    assert 'must be superuser' in undo.stderr


def test_token_of_a_machine_is_on_no_command_line(attacked: Attacked) -> None:
    token = attacked.machine.id.split(':')[2].encode()
    for path in Path('/proc').glob('[0-9]*/cmdline'):
        with contextlib.suppress(OSError):
            assert token not in path.read_bytes(), path
    spied = attacked.log.read_bytes()
    assert token not in spied
    if os.geteuid() != 0:
        pytest.skip('sudo looks for programs in folders of its own, and not for the spy')
    assert b'--rootfs' in spied


def test_shared_folder_of_another_machine_gives_no_rights(attacked: Attacked) -> None:
    """A guest on one machine could run what root on another machine has put there."""
    said = process.run(Command(('podman', 'exec', attacked.machine.id.split(':')[1], 'findmnt',
                                '-J', '-o', 'TARGET,OPTIONS'), sudo=True), timeout=60.0).stdout
    options = {each['target']: each['options'].split(',') for top in
               json.loads(said)['filesystems'] for each in (top, *top.get('children', ()))}
    assert {'ro', 'nosuid', 'nodev', 'noexec'} <= set(options['/opt/fogros2/shared'])


def test_login_id_is_in_no_subordinate_range(tmp_path: Path) -> None:
    path = tmp_path / 'subuid'
    first = login_ids.login_id('token', [])
    path.write_bytes(f'# a line\nJürgen:{first - 5}:10\n'.encode('latin-1'))
    second = login_ids.login_id('token', [path, tmp_path / 'missing'])
    another = login_ids.login_id('another token', [])
    assert len({first, second, another}) == 3 and all(
        number in login_ids.IDS for number in (first, second, another))
    path.write_text(f'alice:100000:{2 ** 31}\n')
    with pytest.raises(PrerequisiteError, match='no user id'):
        login_ids.login_id('token', [path])

# SPDX-License-Identifier: Apache-2.0
"""
The files of a container machine, and accounts of the computer that runs it.

Root on the machine makes any file in the machine's root, with any owner and mode: the machine may
be hijacked. The account on this computer may have any id that an account here can have.
"""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
import pwd
import stat
import subprocess

import pytest

from fogros2 import process
from fogros2.errors import PrerequisiteError
from fogros2.model import Command
from fogros2.provider.container import login_ids
from fogros2.provider.container import machine as container_machine
from rigs.container_machines import Cloud, cloud, cloud_network, engine, key
from rigs.stranger import NOBODY

__all__ = ['cloud', 'cloud_network', 'engine', 'key']

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


def test_no_account_looks_into_a_machine_s_root(cloud: Cloud) -> None:
    with cloud.machine() as (machine, shell):
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


def test_setuid_file_and_device_of_a_machine_are_none_here(cloud: Cloud) -> None:
    machine_id = cloud.create(cloud.spec(on_exit='stop'))
    opt = folder_of(machine_id) / 'root/opt'
    for name in ('id', 'id2'):
        with cloud.shell(cloud.reached(machine_id)) as shell:
            shell.run(Command(('sh', '-ec', f'cp -L /usr/bin/id /opt/{name}; '
                               f'chmod 4755 /opt/{name}; mknod -m 666 /opt/null{name} c 1 3'),
                              sudo=True), timeout=60.0)
            # programs of the system get their rights there
            assert shell.run(Command(('sudo', '-n', 'id', '-u')), timeout=60.0).stdout == '0\n'
        assert python(RUN, str(opt), name).stdout == f'{NOBODY}\n'
        assert 'PermissionError' in python(OPEN, str(opt), f'null{name}').stderr
        if name == 'id':
            # as after a boot, which keeps no mount
            cloud.provider.stop(machine_id)
            process.run(Command(('umount', str(folder_of(machine_id))), sudo=True), timeout=60.0,
                        check=False)
            cloud.provider.start(machine_id)


def test_login_id_is_in_no_subordinate_range(tmp_path: Path) -> None:
    path = tmp_path / 'subuid'
    first = login_ids.login_id('token', [])
    path.write_text(f'# a line\nalice:{first - 5}:10\n')
    second = login_ids.login_id('token', [path, tmp_path / 'missing'])
    another = login_ids.login_id('another token', [])
    assert len({first, second, another}) == 3 and all(
        number in login_ids.IDS for number in (first, second, another))
    path.write_text(f'alice:100000:{2 ** 31}\n')
    with pytest.raises(PrerequisiteError, match='no user id'):
        login_ids.login_id('token', [path])


def test_token_of_a_machine_is_on_no_command_line(
        cloud: Cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if os.geteuid() != 0:
        pytest.skip('sudo looks for programs in folders of its own')
    log, spy = tmp_path / 'log', tmp_path / 'podman'
    spy.write_text(SPY.format(log=log, engine=process.which('podman')))
    spy.chmod(0o755)
    monkeypatch.setitem(process._ENVIRONMENT, 'PATH', f'{tmp_path}:{os.environ["PATH"]}')
    with cloud.machine() as (machine, _):
        token = machine.id.split(':')[2].encode()
        for path in Path('/proc').glob('[0-9]*/cmdline'):
            with contextlib.suppress(OSError):
                assert token not in path.read_bytes(), path
    cloud.provider.destroy(machine.id)
    assert b'--rootfs' in log.read_bytes() and token not in log.read_bytes()


def test_shared_folder_of_another_machine_gives_no_rights(cloud: Cloud) -> None:
    """A guest on one machine could run what root on another machine has put there."""
    machine = cloud.reached(cloud.create(cloud.spec(), common=['/map']))
    said = process.run(Command(('podman', 'exec', machine.id.split(':')[1], 'findmnt', '-J',
                                '-o', 'TARGET,OPTIONS'), sudo=True), timeout=60.0).stdout
    options = {each['target']: each['options'].split(',') for top in
               json.loads(said)['filesystems'] for each in (top, *top.get('children', ()))}
    assert {'ro', 'nosuid', 'nodev', 'noexec'} <= set(options['/opt/fogros2/shared'])

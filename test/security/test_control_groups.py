# SPDX-License-Identifier: Apache-2.0
"""
Root removes the control groups of launches, among those that other accounts made.

An account whose control group is its own, as systemd gives each user one, makes groups below it
with any name but a slash.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import secrets
import subprocess
import sys

import pytest

from fogros2 import process
from fogros2.dds.cyclonedds import CycloneDds
from fogros2.model import Command, VpnInterface
from fogros2.vpn.wireguard import WireGuard
from rigs.stranger import NOBODY

NETWORK = '198.18.7.0/24'
#: The folder of control groups, version 2.
TOP = next((path for path in (Path('/sys/fs/cgroup'), Path('/sys/fs/cgroup/unified'))
            if (path / 'cgroup.procs').exists()), None)
#: `ip netns exec` hides the control groups.
ENTER = 'mount -t cgroup2 cgroup2 /sys/fs/cgroup; exec "$@"'
VPN = WireGuard(CycloneDds().ports)
#: Send a message of DDS into the VPN of the robot with this address.
SEND = """
import ipaddress, socket
address = str(ipaddress.ip_address('{}') + 1)
socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'RTPS' + bytes(40), (address, 7410))
"""


def sudo(*words: str, check: bool = True) -> str:
    return process.run(Command(words, sudo=True), timeout=60.0, check=check).stdout


def write(word: str, path: Path) -> None:
    sudo('sh', '-c', 'echo "$1" >"$2"', 'sh', word, str(path))


def do(space: str, command: Command, *, check: bool = True) -> None:
    """Run a script of the VPN's in a network namespace, as the launch does with root's rights."""
    words = 'ip', 'netns', 'exec', space, 'sh', '-ec', ENTER, 'sh', *command.argv
    said = process.run(Command(words, sudo=True, input=command.input), timeout=60.0,
                       check=check).stdout
    assert 'no control group' not in said, said


def group_of(pid: int) -> Path:
    """Return the folder of a process's control group."""
    assert TOP is not None
    lines = Path(f'/proc/{pid}/cgroup').read_text().splitlines()
    return Path(f'{TOP}{next(line[3:] for line in lines if line.startswith("0::"))}')


@pytest.fixture
def space(tun: None) -> Iterator[str]:
    """Return the name of a network namespace."""
    if TOP is None:
        pytest.skip('needs control groups, version 2')
    name = f'fogt{os.getpid()}'
    sudo('ip', 'netns', 'add', name)
    yield name
    sudo('ip', 'netns', 'delete', name)


@pytest.fixture
def groups(root: None) -> Iterator[Path]:
    """Return a control group below which another account makes its own."""
    if TOP is None:
        pytest.skip('needs control groups, version 2')
    path = TOP / f'test-{os.getpid()}'
    sudo('mkdir', str(path))
    sudo('chown', '-R', f'{NOBODY}:{NOBODY}', str(path))
    yield path
    sudo('find', str(path), '-depth', '-type', 'd', '-exec', 'rmdir', '{}', ';')


def made(groups: Path, name: str) -> None:
    """Let the other account make a control group below its own, and all that lead there."""
    sudo('setpriv', f'--reuid={NOBODY}', f'--regid={NOBODY}', '--clear-groups',
         'mkdir', '-p', f'{groups}/{name}')


def interface(folder: Path, number: int, pid: int = 0) -> VpnInterface:
    name = f'fog{secrets.token_hex(3)}'
    return VpnInterface(name, f'198.18.{number}.1', f'198.18.{number}.0/24', 51820 + number,
                        str(folder / name / 'vpn.key'), firewall=True, process=str(pid or ''))


@contextlib.contextmanager
def launch(group: Path | None = None) -> Iterator[int]:
    """Yield the id of a process that stands for a launch, in a control group."""
    child = subprocess.Popen(['sleep', '600'])
    try:
        if group is not None:
            write(str(child.pid), group / 'cgroup.procs')
        yield child.pid
    finally:
        child.kill()
        child.wait()


def test_group_s_name_leads_root_to_no_file(groups: Path, space: str, tmp_path: Path) -> None:
    """Split at its blank, it is two paths: the second leads to files of the attacker's choice."""
    tmp_path.chmod(0o755)
    own = interface(tmp_path, 7, os.getpid())
    victim = tmp_path / 'victim'
    victim.touch()
    made(groups, f'a {tmp_path}/{own.name}')
    (tmp_path / own.name).mkdir()
    (tmp_path / own.name / 'cgroup.procs').write_text('chosen\n')
    (tmp_path / 'cgroup.procs').symlink_to(victim)
    for command in VPN.down(own):
        do(space, command, check=False)
    assert victim.read_text() == ''


def test_launch_below_another_one_reaches_its_own_machines(
        groups: Path, space: str, tmp_path: Path) -> None:
    sudo('ip', '-n', space, 'link', 'set', 'lo', 'up')
    with launch(groups) as pid, launch(groups) as below:
        outer, inner = interface(tmp_path, 7, pid), interface(tmp_path, 8, below)
        for each in (outer, inner):
            write(str(below), group_of(pid) / 'cgroup.procs')
            for command in (VPN.keys(each), *VPN.up(each, [])):
                do(space, command)
        for each, own in ((outer, pid), (inner, below)):
            for command in VPN.repair(each, []):
                do(space, command)
            assert group_of(own) == groups / each.name
            sudo('sh', '-c', 'echo $$ >"$1/cgroup.procs"; exec ip netns exec "$2" "$3" -c "$4"',
                 'sh', str(group_of(own)), space, sys.executable, SEND.format(each.address))
        engine = group_of(pid) / 'engine'
        sudo('mkdir', str(engine))
        for each in (outer, inner):
            for command in VPN.down(each):
                do(space, command)
        assert group_of(pid) == engine.parent and group_of(below) == groups
        sudo('rmdir', str(engine))
        for command in VPN.down(outer):
            do(space, command)
        assert group_of(pid) == groups
    assert not [path for path in groups.iterdir() if path.is_dir()]
    for each in (outer, inner):
        assert not list(Path('/run').glob(f'{each.name}*'))


def test_group_of_an_account_does_not_make_down_fail(
        groups: Path, space: str, tmp_path: Path) -> None:
    """It bears the interface's name, and nobody can read which processes a threaded group has."""
    own = interface(tmp_path, 7, os.getpid())
    made(groups, own.name)
    write('threaded', groups / own.name / 'cgroup.type')
    with launch(groups) as pid:
        write(str(pid), groups / own.name / 'cgroup.procs')
        for command in VPN.down(own):
            do(space, command)
        assert group_of(pid) == groups / own.name


def test_group_that_an_account_replaced_is_left_alone(
        groups: Path, space: str, tmp_path: Path) -> None:
    """The owner of a group can remove an empty group that root made there."""
    with launch(groups) as pid:
        own = interface(tmp_path, 7, pid)
        do(space, VPN.keys(own))
        for command in VPN.up(own, []):
            do(space, command)
        group = group_of(pid)
        write(str(pid), groups / 'cgroup.procs')
        sudo('rmdir', str(group))
        made(groups, group.name)
        write(str(pid), group / 'cgroup.procs')
        for command in VPN.down(own):
            do(space, command)
        assert group_of(pid) == group

# SPDX-License-Identifier: Apache-2.0
"""Fast DDS where accounts, containers, many processes and many addresses meet: nodes of ROS 2."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import subprocess
import sys
import tempfile

import pytest

from rigs.vpn_lab import Child, Lab, missing, PASSED

NODE, CROWD = (Path(__file__).with_name(f'{name}_node.py') for name in ('dds', 'crowd'))
#: A container's memory: the network is the host's.
CONTAINER = ('unshare', '--mount', 'sh', '-c',
             'mount -t tmpfs -o mode=1777 tmpfs /dev/shm; exec "$@"', 'sh')
NOBODY = 65534


@pytest.fixture
def middleware() -> str:
    return 'fastdds'


@pytest.fixture
def user() -> tuple[str, ...]:
    """Return the words that make a program one of an account other than root's."""
    number = str(os.getuid() or NOBODY)
    words = ('setpriv', f'--reuid={number}', f'--regid={number}', '--clear-groups')
    said = subprocess.run([*(words if os.getuid() == 0 else ()), sys.executable, '-c',
                           'import rclpy'], capture_output=True, env={
                               name: os.environ[name] for name in PASSED if name in os.environ})
    if said.returncode != 0:
        pytest.skip('another account cannot read this Python environment')
    return words


@pytest.fixture
def public(vpn: Lab) -> Iterator[Path]:
    """Return the lab's folder, in which all accounts read."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o777)
        vpn.folder = Path(folder)
        yield vpn.folder


def start(vpn: Lab, words: tuple[str, ...], *topics: str, host: str = 'machine') -> Child:
    child = vpn.start(host, [*words, sys.executable, str(NODE), *topics],
                      group=vpn.interfaces[host].name, ROS_LOG_DIR=str(vpn.folder),
                      HOME=str(vpn.folder), **vpn.configure(host))
    child.wait('ready', timeout=60.0)
    return child


@pytest.mark.parametrize(
    ('host', 'place'), [('robot', ()), ('machine', CONTAINER)], ids=['root', 'container'])
def test_accounts_hear_each_other(
        vpn: Lab, public: Path, user: tuple[str, ...], place: tuple[str, ...], host: str) -> None:
    first = start(vpn, place, 'to:/down', 'from:/up', host=host)
    second = start(vpn, user, 'to:/up', 'from:/down', host=host)
    first.wait('topic', '/up', count=3)
    second.wait('topic', '/down', count=3)


def test_many_addresses_are_heard_without_shared_memory(vpn: Lab) -> None:
    for number in range(81, 86):
        # as containers' bridges bring them: more addresses than Fast DDS keeps by default
        vpn.ip('-n', vpn.spaces['robot'], 'address', 'add', f'192.168.{number}.1/24', 'dev', 'e0')
    machine = vpn.node('machine', 'from:/up', 'to:/down')
    robot = vpn.node('robot', 'to:/up', 'from:/down')
    machine.wait('topic', '/up', count=3)
    robot.wait('topic', '/down', count=3)
    # the nodes belong to root where sudo has started them
    maps = ''.join(vpn.shell(host, f'cd /proc; for each in $(ip netns pids {vpn.spaces[host]}); '
                             'do cat $each/maps; done 2>/dev/null; :')
                   for host in ('robot', 'machine'))
    assert 'libfastrtps' in maps
    assert '/dev/shm/fastrtps' not in maps


def test_dozens_of_processes_know_each_other(vpn: Lab) -> None:
    if reason := missing('fastdds'):
        pytest.skip(reason)
    vpn.second()
    hosts, each = ('machine', 'second'), 12
    crowds = [vpn.start(host, [sys.executable, str(CROWD), str(each), str(2 * each), host],
                        ROS_LOG_DIR=str(vpn.folder), **vpn.configure(host)) for host in hosts]
    for crowd in crowds:
        crowd.wait('known', 2 * each, timeout=60.0)

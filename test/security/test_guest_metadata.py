# SPDX-License-Identifier: Apache-2.0
"""A guest of a machine gets none of the rights that a cloud gives the machine."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2_features.guests import program as guests
from rigs.stranger import NOBODY

#: The metadata services of AWS, Google and Azure; AWS's for containers; Azure's agent; by IPv6.
SERVICES = ['169.254.169.254', '169.254.170.2', '168.63.129.16', 'fd00:ec2::254', 'fd20:ce::254']
#: Serves HTTP and DNS at the addresses, then tries them as an account; prints those that answer.
TRY = """\
import os, socket, sys
uid, *services = sys.argv[1:]
servers = [socket.create_server((host, port), family=socket.AF_INET6 if ':' in host else
                                socket.AF_INET) for host in services for port in (80, 53)]
os.setgroups([]), os.setgid(int(uid)), os.setuid(int(uid))
for server in servers:
    host, port = server.getsockname()[:2]
    try:
        socket.create_connection((host, port), 2).close()
        print(host, port)
    except OSError:
        pass
"""


@pytest.fixture
def cloud(root: None) -> Iterator[str]:
    """Return a network namespace that has the addresses of the services."""
    name = f'fogmeta{os.getpid() % 10000}'
    for words in (('netns', 'add', name), ('-n', name, 'link', 'set', 'lo', 'up'), *(
            ('-n', name, 'addr', 'add', host, 'dev', 'lo') for host in SERVICES)):
        process.run(Command(('ip', *words), sudo=True), timeout=60.0)
    yield name
    process.run(Command(('ip', 'netns', 'del', name), sudo=True), timeout=60.0)


def inside(cloud: str, *words: str) -> str:
    return process.run(Command(('ip', 'netns', 'exec', cloud, *words), sudo=True),
                       timeout=60.0).stdout


def answering(cloud: str, uid: int) -> set[tuple[str, str]]:
    """Return the services and ports that answer an account."""
    said = inside(cloud, 'python3', '-IS', '-c', TRY, str(uid), *SERVICES)
    return {(host, port) for host, port in map(str.split, said.splitlines())}


def confine(cloud: str, user: str, uid: int) -> None:
    """Run what the door of a machine runs for a guest's account."""
    source = Path(guests.__file__).read_text().partition("if __name__ == '__main__':")[0]
    inside(cloud, 'python3', '-IS', '-c', f'{source}\nconfine({user!r}, {uid})')


def test_guest_gets_no_answer_of_the_metadata_service(cloud: str) -> None:
    every = {(host, port) for host in SERVICES for port in ('80', '53')}
    assert answering(cloud, NOBODY) == every
    for _ in range(2):  # each connection of the guest does it
        confine(cloud, 'fogabc123m0g224', NOBODY)
    assert answering(cloud, NOBODY) == {(host, '53') for host in SERVICES}, 'names are found'
    assert answering(cloud, NOBODY - 1) == every, 'the nodes of the launch are not concerned'

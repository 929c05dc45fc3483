# SPDX-License-Identifier: Apache-2.0
"""The tests' own cluster: it does what one has to do, and nothing of it is left."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys

import pytest

from fogros2.model import Command
from fogros2.process import run
from fogros2.waiting import wait_until
from rigs.cluster import node

RUN = """
import signal, sys
from pathlib import Path
from rigs.cluster import cluster
binaries, store = map(Path, sys.argv[1:])
with cluster(binaries.parent, binaries, store=store) as running:
    print(running.folder, flush=True)
    sys.stdin.read()
"""


def mounts() -> list[str]:
    return [line for line in Path('/proc/self/mountinfo').read_text().splitlines()
            if '/fogros2/kubernetes/' in line or '/run/fog' in line]


def process_namespace(folder: Path) -> str:
    """Return the process namespace of the node that has a folder."""
    own = os.readlink('/proc/self/ns/pid')
    for process in Path('/proc').glob('[0-9]*'):
        try:
            words = (process / 'cmdline').read_text(errors='replace').split('\0')
            there = os.readlink(process / 'ns/pid')
        except OSError:
            continue
        if '--inside' in words and str(folder) in words and there != own:
            return there
    raise AssertionError(f'nothing runs in {folder}')


def processes(namespace: str) -> dict[tuple[str, str], str]:
    """Return the names of a namespace's processes by their id and time of start."""
    found = {}
    for process in Path('/proc').glob('[0-9]*'):
        try:
            if os.readlink(process / 'ns/pid') == namespace:
                # what follows the name in parentheses begins with the state, field 3 of proc(5)
                fields = (process / 'stat').read_text().rpartition(')')[2].split()
                found[process.name, fields[22 - 3]] = (process / 'comm').read_text().strip()
        except OSError:
            continue
    return found


def network(folder: Path) -> list[str]:
    """Return what of a node's network is on this computer: links, and firewall rules."""
    ruleset = run(Command(('nft', 'list', 'ruleset'), sudo=True), timeout=30.0).stdout
    return [name for name in os.listdir('/sys/class/net')
            if name in ('pods', 'uplink', f'fogt{folder.name}')] + [
                line for line in ruleset.splitlines() if 'KUBE-' in line or 'CNI-' in line]


def groups(name: str) -> list[Path]:
    return [tree / name for tree in node.hierarchies() if (tree / name).exists()]


@pytest.fixture
def started(kubernetes, binaries):
    """Return a process that has a cluster of its own, and the folder of that."""
    child = subprocess.Popen(
        [sys.executable, '-c', RUN, str(binaries), str(kubernetes.images)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield child, Path(child.stdout.readline().strip())
    finally:
        child.kill()
        child.communicate()


@pytest.mark.skipif(os.geteuid() != 0, reason="other users' processes are root's to look at")
def test_killed_test_leaves_nothing_of_its_cluster(started):
    child, folder = started
    space = process_namespace(folder)
    own = processes(space)
    assert len(own) >= 8
    assert groups(node.MARK + folder.name)
    assert network(folder) == [f'fogt{folder.name}']
    assert mounts() == [], 'mounts are seen outside'
    child.send_signal(signal.SIGKILL)
    # the node notices, and does the rest alone
    wait_until(lambda: not folder.exists() or None, timeout=30.0, what='the folder to be gone')
    # the kernel gives the namespace's number away again: another test's container may have it
    assert not own.keys() & processes(space).keys()
    assert groups(node.MARK + folder.name) == []
    assert network(folder) == []
    assert mounts() == []


def test_cluster_changes_no_setting_and_reaches_nobody_else(kubernetes):
    assert kubernetes.run('ip', 'route', 'show', 'default').stdout == ''
    for name in node.KERNEL_SETTINGS:
        assert kubernetes.run('findmnt', '-n', f'/proc/sys/{name}').returncode == 0, name

# SPDX-License-Identifier: Apache-2.0
"""The tests' own cluster: it does what one has to do, and nothing of it is left."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import uuid

import pytest

from fogros2.model import Command
from fogros2.process import run
from fogros2.waiting import wait_until
from rigs.cluster import BARE, node, services
from rigs.cluster.cluster import free_network
from rigs.cluster.node_process import run_node

RUN = """
import signal, sys
from pathlib import Path
from rigs.cluster import cluster
binaries, store = map(Path, sys.argv[1:])
with cluster(binaries.parent, binaries, store=store) as running:
    print(running.folder, flush=True)
    sys.stdin.read()
"""


def pod(name: str, *words: str, **spec: object) -> dict[str, object]:
    return {'apiVersion': 'v1', 'kind': 'Pod', 'metadata': {'name': name, 'labels': {'pod': name}},
            # a new namespace may not have the token of its service account yet
            'spec': {'restartPolicy': 'Never', 'automountServiceAccountToken': False,
                     'containers': [{'name': 'it', 'image': BARE, 'command': list(words)}],
                     **spec}}


def test_pods_reach_the_robot_and_nobody_else(kubernetes, client, namespaces):
    space = namespaces().name
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind((kubernetes.layout.host, 0))
        robot.settimeout(30.0)
        send = ('import socket, time\ns = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)\n'
                'try:\n    s.connect(("192.0.2.77", 9))\n    s.send(b"out")\n'
                'except OSError as error:\n    out = error.strerror\nelse:\n    out = "sent"\n'
                f's.sendto(out.encode(), ("{kubernetes.layout.host}", {robot.getsockname()[1]}))')
        client.ask('POST', f'/api/v1/namespaces/{space}/pods', pod('dial', 'python3', '-c', send))
        said, sender = robot.recvfrom(99)
    assert sender[0] == kubernetes.layout.node
    routes = kubernetes.run('ip', 'route', 'show', 'default')
    assert routes.stdout == '', 'the node has a way out'
    assert said in (b'sent', b'Network is unreachable')


def mounts() -> list[str]:
    return [line for line in Path('/proc/self/mountinfo').read_text().splitlines()
            if '/fogros2/kubernetes/' in line or '/run/fog' in line]


def process_namespace(folder: Path) -> str:
    """Return the process namespace of the node that has a folder."""
    own = os.readlink('/proc/self/ns/pid')
    for process in Path('/proc').glob('[0-9]*'):
        try:
            words = (process / 'cmdline').read_text().split('\0')
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


@pytest.mark.skipif(os.geteuid() != 0, reason='kills a process of root')
def test_next_cluster_removes_a_killed_node(kubernetes, binaries):
    network_of = free_network()
    host, there = network_of.hosts()
    name = uuid.uuid4().hex[:6]
    started = run_node(kubernetes.folder.parent, {
        'commands': {'containerd': services.commands(services.NOWHERE)['containerd']},
        'binaries': str(binaries), 'cable': {
            'name': f'fogt{name}', 'host': f'{host}/30', 'node': f'{there}/30'},
    }, {'containerd.toml': services.containerd('')}, name=name)
    folder = started.folder
    assert started.await_line(30.0) == {'ready': True}
    space = process_namespace(folder)
    own = processes(space)
    for process in Path('/proc').glob('[0-9]*'):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            words = (process / 'cmdline').read_text().split('\0')
            if str(folder) in words and '--inside' not in words:
                os.kill(int(process.name), signal.SIGKILL)
    started.stop()
    wait_until(lambda: not own.keys() & processes(space).keys() or None, timeout=10.0,
               what='its processes to end')
    assert folder.exists() and groups(node.MARK + folder.name)
    assert network(folder) == [], "the cable is the namespace's"
    node.forget_others(kubernetes.folder)
    assert not folder.exists() and not groups(node.MARK + folder.name)
    assert kubernetes.kubeconfig.exists(), 'the one that runs is spared'


def test_kubelet_changes_no_setting_of_the_computer(kubernetes):
    for name in node.KERNEL_SETTINGS:
        assert kubernetes.run('findmnt', '-n', f'/proc/sys/{name}').returncode == 0, name

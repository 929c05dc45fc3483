# SPDX-License-Identifier: Apache-2.0
"""
A network that leads nowhere for simulated clouds, images for its machines' engines, and a look at
what a test leaves behind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import ipaddress
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
from typing import Any

import pytest

from fogros2 import process
from fogros2.errors import PrerequisiteError
from fogros2.model import Command
from fogros2.process import run, which
from fogros2.provider.container import debian_root
from fogros2.provider.container import root as container_root
from rigs.cluster import images as cluster_images
from rigs.container_machines import cloud_network, engine
from rigs.domains import taken
from rigs.launched import embedded, Launched, launching
from rigs.traces import nothing_left as nothing_left_of
from rigs.traces import RUN, Traces

__all__ = ['cloud_network', 'engine']

#: Stands for ROS 2 without Cyclone DDS, and for the package manager that brings it.
ROS = {
    'usr/bin/apt-get': """#!/bin/sh
case " $* " in *" install "*) busybox touch /opt/ros/jazzy/lib/librmw_fastrtps_cpp.so ;; esac
""",
    'opt/ros/jazzy/setup.sh': 'AMENT_PREFIX_PATH=/opt/ros/jazzy\n',
    'opt/ros/jazzy/lib/demo/program': """#!/bin/sh
echo "it has $(cd /opt/ros/jazzy/lib; echo *) for $RMW_IMPLEMENTATION and was told $*"
""",
}
#: What of a Debian system Python and ROS 2's libraries don't need.
LEFT_OUT = ('./var', './usr/share', './usr/sbin', './usr/lib/apt', './usr/lib/systemd',
            './usr/lib/*/perl*', './usr/lib/*/gconv')


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give tests with a Debian system time for debootstrap, which the first one waits for."""
    for item in items:
        if {'images', 'isolated_root'} & set(getattr(item, 'fixturenames', ())):
            item.add_marker(pytest.mark.timeout(900), append=False)


@pytest.fixture(scope='session')
def domain() -> Iterator[str]:
    """Have a ROS domain for all tests of this process that need only one."""
    with taken() as domain:
        yield domain


@pytest.fixture(scope='module', autouse=True)
def no_dds_of_others() -> Iterator[None]:
    """Forget what tests that run nodes in this process have set, for launches of a module too."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ('CYCLONEDDS_URI', 'RMW_IMPLEMENTATION'):
            patch.delenv(name, raising=False)
            patch.delitem(process._ENVIRONMENT, name, raising=False)
        yield


@pytest.fixture(autouse=True)
def own_domain(domain: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the tests' nodes among themselves and off the network of this computer."""
    monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    # by this, a process is known to be this run's
    monkeypatch.setenv(RUN, f'{os.getpid()}-{domain}')


@pytest.fixture(autouse=True)
def no_filter_left() -> Iterator[None]:
    """Remove the DDS filter of this process that a failed test left: it would fail others."""
    yield
    for name in re.findall(r'/(fog[0-9a-f]{6})\b', Path('/proc/self/cgroup').read_text()):
        run(Command(('nft', 'delete', 'table', 'inet', name), sudo=True), timeout=60, check=False)


@pytest.fixture
def nothing_left(
    state_home: Path, root: None, own_domain: None, tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[None]:
    """Fail a test after which something is there that wasn't before, and is nobody else's."""
    traces = Traces(state_home, tmp_path_factory.getbasetemp(), os.environ[RUN])
    with nothing_left_of(traces, timeout=60.0):
        yield


@pytest.fixture
def launch(nothing_left: None) -> Iterator[Callable[..., Launched]]:
    """Return what starts launches, which are over when the test ends and leave nothing."""
    with launching() as start:
        yield start


@pytest.fixture(scope='session')
def isolated_root(root: None) -> None:
    """Skip where isolated machines get no root, or one that can't have the robot's ROS."""
    if not embedded():
        pytest.skip('an isolated root gets ROS 2 by pip alone')
    try:
        debian_root.check_programs()
    except PrerequisiteError as error:
        pytest.skip(f'needs an isolated root: {error}')
    python = Path(debian_root.root(), 'usr/bin/python3').resolve().name
    if python != f'python{sys.version_info.major}.{sys.version_info.minor}':
        pytest.skip(f'the robot has another Python than the isolated root, {python}')


@pytest.fixture(scope='session')
def nobody(engine: str, cloud_network: str) -> str:
    """Return an address in the cloud's network that no machine has."""
    subnet = run(Command((engine, 'network', 'inspect', cloud_network, '--format',
                          '{{range .Subnets}}{{.Subnet}}{{end}}'), sudo=True), timeout=60).stdout
    return str(list(ipaddress.ip_network(subnet.strip()).hosts())[-1])


@pytest.fixture(scope='session')
def busybox(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a layer that holds busybox alone."""
    try:
        program = cluster_images.static_busybox()
    except PrerequisiteError as error:
        pytest.skip(str(error))
    path = tmp_path_factory.mktemp('busybox') / 'layer.tar'
    archive = container_root.Archive()
    archive.file('bin/busybox', program.read_bytes(), 0o755)
    archive.link('bin/sh', 'busybox')
    path.write_bytes(archive.data())
    return path


@pytest.fixture(scope='session')
def crun(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return mounts that bring crun to a machine made of this computer's root."""
    if which('crun'):
        return []
    folder = tmp_path_factory.mktemp('crun')
    # not installed here, where podman would take it for its own containers
    made = run(Command(('sh', '-ec', 'cd "$1"; apt-get download -q crun libyajl2; '
                        'for each in *.deb; do dpkg -x "$each" .; done', 'sh', str(folder))),
               timeout=60, check=False)
    if made.returncode:
        pytest.skip('needs crun, or a package index that has it')
    return [f'{path.resolve()}:/{path.relative_to(folder)}'
            for name in ('usr/bin/crun', 'libyajl.so.2') for path in folder.rglob(name)]


@pytest.fixture(scope='session')
def images(engine: str, busybox: Path, tmp_path_factory: pytest.TempPathFactory,
           ) -> Iterator[Path]:
    """Return a folder with images as files: a Debian system, one like ROS 2's, and busybox."""
    if which('debootstrap') is None:
        pytest.skip('needs debootstrap')
    folder = tmp_path_factory.mktemp('images')
    cache = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache', 'fogros2/kubernetes')
    with cluster_images.alone(cache):
        root = cluster_images.base(cache, print)
    system, top, ros = (folder / f'{name}.layer' for name in ('system', 'top', 'ros'))
    run(Command(('tar', '-C', str(root), '--one-file-system', '-cf', str(system), *(
        f'--exclude={pattern}' for pattern in LEFT_OUT), '.'), sudo=True), timeout=60)
    # the robot's Python may lie in root's home
    archive = container_root.Archive()
    archive.folder('root', 0o711)
    top.write_bytes(archive.data())
    archive = container_root.Archive()
    for name, text in ROS.items():
        archive.file(name, text.encode(), 0o755)
    ros.write_bytes(archive.data())
    # as an entry point would set up what is mounted: the robot's ROS 2 or its wheels
    here = [f'PATH={sys.prefix}/bin:/usr/bin:/bin', 'AMENT_PREFIX_PATH=' + ':'.join(
        [*filter(None, [os.environ.get('AMENT_PREFIX_PATH')]), sys.prefix])]
    here += [f'{name}={os.environ[name]}' for name in ('LD_LIBRARY_PATH', 'PYTHONPATH')
             if name in os.environ]
    for name, layers, variables in (
            ('system', (system, top), here), ('ros', (busybox, ros), ['PATH=/usr/bin:/bin']),
            ('box', (busybox,), ['PATH=/bin'])):
        cluster_images.write_archive(folder / f'{name}.tar', [cluster_images.Image(
            f'fogros2.test/{name}:1', layers, {'Env': variables})])
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(scope='session')
def with_python() -> list[str]:
    """Return options of ``docker run`` that bring this Python environment into ``system.tar``."""
    mounts = container_root.environment_mounts(None)
    if not embedded():
        mounts.append('/usr/lib')  # what ROS 2 is linked with
    return [word for mount in mounts for word in ('-v', f'{mount}:{mount}:ro')]


@pytest.fixture
def children() -> Iterator[list[subprocess.Popen[bytes]]]:
    """Return a list; the processes put there are gone after the test."""
    started: list[subprocess.Popen[bytes]] = []
    yield started
    for child in started:
        if child.poll() is None:
            child.kill()
        child.wait(60)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return a bench for nodes; see rigs.bench."""
    from rigs.bench import made
    with made(monkeypatch.setenv) as bench:
        yield bench

# SPDX-License-Identifier: Apache-2.0
"""
apt and pip packages on a container machine, from a repository and a folder of this test.

The machine has a root of its own, so that nothing that is installed here is there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
import hashlib
import importlib.util
import os
from pathlib import Path
import shutil
import time
import uuid
import zipfile

import pytest

from fogros2.deploy import Launch
from fogros2.host.installer import apt_install
from fogros2.model import Command, MachineSpec, NodeSpec
from fogros2.process import run
from fogros2.provider.container import debian_root
from fogros2.report import StepDone
from fogros2.waiting import wait_until
from rigs.cluster.images import RootShell
from rigs.rosdep import rosdep_source

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
    pytest.mark.skipif(shutil.which('dpkg-deb') is None, reason='needs dpkg'),
    pytest.mark.usefixtures('isolated_root'),
]

#: What apt reads in place of this computer's own sources.
APT = 'Dir::Etc::sourcelist "/fogt/sources.list";\nDir::Etc::sourceparts "-";\n'
#: rosdep, and what it imports.
ROSDEP = ('rosdep2', 'rospkg', 'rosdistro', 'catkin_pkg', 'yaml', 'pyparsing', 'dateutil', 'six',
          'distro', 'packaging', 'docutils')
#: What the node says of the packages, and of a variable that it needs besides.
NODE = ('import fogt_one, os, shutil; '
        'print(fogt_one.name, shutil.which("fogt-hello"), os.environ["PYTHONPATH"], flush=True)')


def debian_package(folder: Path, name: str, program: str, modules: Sequence[Path] = ()) -> str:
    """
    Write a Debian package with one program and some Python modules; return its entry for apt.

    :param program: the program's text.
    """
    tree, deb = folder / 'tree' / name, folder / f'{name}.deb'
    site = tree / 'usr/lib/python3/dist-packages'
    for path in (tree / 'DEBIAN', tree / 'usr/bin', site):
        path.mkdir(parents=True)
    control = (f'Package: {name}\nVersion: 1\nArchitecture: all\n'
               'Maintainer: A <a@example.com>\nDescription: for a test\n')
    (tree / 'DEBIAN/control').write_text(control)
    file = tree / 'usr/bin' / ('rosdep' if 'rosdep' in name else name)
    file.write_text(program)
    file.chmod(0o755)
    for module in modules:
        if module.is_dir():
            shutil.copytree(module, site / module.name,
                            ignore=shutil.ignore_patterns('__pycache__', '*.so'))
        else:
            shutil.copy(module, site)
    run(Command(('dpkg-deb', '--root-owner-group', '--build', '-Znone', str(tree), str(deb))),
        timeout=30.0)
    data = deb.read_bytes()
    return (f'{control}Filename: ./{deb.name}\nSize: {len(data)}\n'
            f'SHA256: {hashlib.sha256(data).hexdigest()}\n\n')


@pytest.fixture(scope='module')
def packages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return a folder with Debian packages, apt's list of them, and a wheel."""
    folder = tmp_path_factory.mktemp('packages')
    folder.chmod(0o755)
    # rosdep is the one that these tests have, under the name of Debian's package
    modules = [Path(spec.origin).parent if spec.submodule_search_locations else Path(spec.origin)
               for spec in map(importlib.util.find_spec, ROSDEP) if spec and spec.origin]
    (folder / 'Packages').write_text(
        debian_package(folder, 'fogt-hello', '#!/bin/sh\n')
        + debian_package(folder, 'python3-rosdep2', '#!/usr/bin/python3\nimport rosdep2.main\n'
                                                    'rosdep2.main.rosdep_main()\n', modules))
    (folder / 'sources.list').write_text('deb [trusted=yes] file:/fogt ./\n')
    (folder / 'apt.conf').write_text(APT)
    with zipfile.ZipFile(folder / 'fogt_one-1-py3-none-any.whl', 'w') as archive:
        archive.writestr('fogt_one.py', 'name = "from-pip"')
        archive.writestr('fogt_one-1.dist-info/METADATA',
                         'Metadata-Version: 2.1\nName: fogt-one\nVersion: 1\n')
        archive.writestr('fogt_one-1.dist-info/WHEEL', 'Wheel-Version: 1.0\n'
                         'Root-Is-Purelib: true\nTag: py3-none-any\n')
        archive.writestr('fogt_one-1.dist-info/RECORD', '')
    yield folder


@pytest.fixture
def spec(cloud_network: str, packages: Path) -> MachineSpec:
    return MachineSpec(
        f'needs-{uuid.uuid4().hex[:6]}', 'container', {
            'network': cloud_network, 'isolated': True,
            'mounts': [f'{packages}:/fogt', f'{packages}/apt.conf:/etc/apt/apt.conf.d/99fogt']},
        environment={'PIP_NO_INDEX': '1', 'PIP_FIND_LINKS': '/fogt', 'PYTHONPATH': '/mine'},
        apt=('fogt-hello',), pip=('fogt-one',))


def said(machine) -> str:
    """Run the node; return what it printed."""
    heard = []
    machine.subscribe(heard.append)
    node = NodeSpec(f'n-{time.monotonic_ns()}', 'node', arguments=('python3', '-c', NODE))
    machine.start([node])
    wait_until(lambda: any(e['event'] == 'exited' and e['node'] == node.id for e in heard),
               timeout=60, what='the node to end')
    return ' '.join(e['text'] for e in heard if e['event'] == 'output' and e['node'] == node.id)


def test_node_finds_what_its_machine_was_asked_for(spec):
    events = []
    launch = Launch(report=events.append)
    try:
        name, program, path = said(launch.up(spec)).split()
        assert name == 'from-pip' and program == '/usr/bin/fogt-hello'
        # the user's folder comes first, and takes nothing away
        assert path.startswith('/mine:') and path.endswith('/last')
    finally:
        assert launch.down() == []
    (detail,) = [e.detail for e in events if isinstance(e, StepDone) and e.step == 'ROS 2']
    assert 'installed fogt-hello' in detail and 'installed fogt-one by pip' in detail


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """Return a built workspace whose package runs with what this computer doesn't have."""
    prefix = tmp_path / 'ws' / 'install' / 'needy'
    for path, text in (
            ('share/ament_index/resource_index/packages/needy', ''),
            ('share/needy/package.xml',
             '<package><name>needy</name><exec_depend>fogt_apt</exec_depend>'
             '<exec_depend>fogt_pip</exec_depend><exec_depend>fogt_unknown</exec_depend>'
             '<exec_depend>std_msgs</exec_depend></package>')):
        (prefix / path).parent.mkdir(parents=True, exist_ok=True)
        (prefix / path).write_text(text)
    (tmp_path / 'ws/install/.colcon_install_layout').write_text('isolated')
    return tmp_path / 'ws'


def test_what_the_workspace_runs_with_is_installed_once(spec, packages, workspace):
    lists = packages / uuid.uuid4().hex[:6]
    lists.mkdir()
    variables = rosdep_source(
        lists, {'fogt_apt': '[fogt-hello]', 'fogt_pip': '{pip: {packages: [fogt-one]}}'},
        f'/fogt/{lists.name}')
    spec = dataclasses.replace(
        spec, apt=(), pip=(), workspace=str(workspace), on_exit='keep',
        environment={**spec.environment, **variables})
    details = []
    for last in (False, True):
        launch = Launch(report=lambda event: details.append(event.detail) if (
            isinstance(event, StepDone) and event.step == 'ROS 2') else None)
        try:
            machine = launch.up(dataclasses.replace(spec, on_exit='delete') if last else spec)
            assert said(machine).split()[:2] == ['from-pip', '/usr/bin/fogt-hello']
        finally:
            assert launch.down() == []
    assert 'installed fogt-hello' in details[0] and 'installed fogt-one by pip' in details[0]
    assert 'the machine may lack fogt_unknown' in details[0]
    assert details[1] == 'there already'


def test_apt_installs_after_a_dpkg_that_was_killed(packages, tmp_path):
    base, shell = debian_root.root(), RootShell(debian_root.root(), tmp_path)
    status = (base / 'var/lib/dpkg/status').read_text()
    for name, text in (('fogt/Packages', (packages / 'Packages').read_text()),
                       ('etc/apt/sources.list', 'deb [trusted=yes] file:/fogt ./\n'),
                       # what dpkg was about to write when it was killed
                       ('var/lib/dpkg/updates/0000', status.split('\n\n')[0] + '\n')):
        path = tmp_path / 'files' / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    shutil.copy(packages / 'fogt-hello.deb', tmp_path / 'files/fogt')
    try:
        shell.run(apt_install(['fogt-hello']), timeout=60.0)
        assert os.listdir(tmp_path / 'files/var/lib/dpkg/updates') == []
        assert (tmp_path / 'files/usr/bin/fogt-hello').exists()
    finally:
        debian_root.remove(tmp_path / 'files')

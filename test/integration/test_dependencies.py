# SPDX-License-Identifier: Apache-2.0
"""
apt and pip packages, and workspaces over another, on a container machine.

The packages are from a repository and a folder of this test.

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

import pytest

from fogros2.deploy import Launch
from fogros2.host.installer import apt_install
from fogros2.host.workspace import find_workspaces, underlays
from fogros2.model import Command, MachineSpec, NodeSpec
from fogros2.process import run
from fogros2.provider.container import debian_root
from fogros2.report import StepDone
from fogros2.waiting import wait_until
from rigs.cluster.images import RootShell
from rigs.colcon_workspace import colcon_workspace
from rigs.pip_site import wheel
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
#: What the node says: names of all that was asked for, declared and below, and a variable.
NODE = """
from fogt_base.text import below
from fogt_top.text import name
import fogt_one, fogt_two, os, shutil
print(name, below, fogt_one.name, fogt_two.name, shutil.which('fogt-hello'),
      shutil.which('fogt-asked'), os.environ['PYTHONPATH'], flush=True)
"""


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
        + debian_package(folder, 'fogt-asked', '#!/bin/sh\n')
        + debian_package(folder, 'python3-rosdep2', '#!/usr/bin/python3\nimport rosdep2.main\n'
                                                    'rosdep2.main.rosdep_main()\n', modules))
    (folder / 'sources.list').write_text('deb [trusted=yes] file:/fogt ./\n')
    (folder / 'apt.conf').write_text(APT)
    for name in ('fogt_one', 'fogt_two'):
        wheel(folder, name, **{name: f"name = '{name}'"})
    yield folder


@pytest.fixture
def workspaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Source two built workspaces, the second of which declares what this computer hasn't."""
    for name, programs, module in (
            ('base', {}, "below = 'below'"), ('top', {'node': NODE}, "name = 'top'")):
        for variable, value in colcon_workspace(
                tmp_path / name, f'fogt_{name}', programs=programs, module=module).items():
            monkeypatch.setenv(variable, value)
    manifest = tmp_path / 'top/install/fogt_top/share/fogt_top/package.xml'
    manifest.write_text(manifest.read_text().replace('<export>', ''.join(
        f'<exec_depend>{name}</exec_depend>'
        for name in ('fogt_apt', 'fogt_pip', 'fogt_unknown', 'std_msgs')) + '<export>'))
    chain = find_workspaces(os.environ)
    assert chain == [str(tmp_path / 'top'), str(tmp_path / 'base')]
    monkeypatch.setenv('AMENT_PREFIX_PATH', f"{os.environ['AMENT_PREFIX_PATH']}:/srv/acme")
    return chain


@pytest.fixture
def spec(cloud_network: str, packages: Path, workspaces: list[str]) -> MachineSpec:
    variables = rosdep_source(
        packages, {'fogt_apt': '[fogt-hello]', 'fogt_pip': '{pip: {packages: [fogt-one]}}'},
        '/fogt')
    return MachineSpec(
        f'needs-{uuid.uuid4().hex[:6]}', 'container', {
            'network': cloud_network, 'isolated': True,
            'mounts': [f'{packages}:/fogt', f'{packages}/apt.conf:/etc/apt/apt.conf.d/99fogt']},
        workspace=workspaces[0], underlays=underlays(workspaces[0], workspaces), on_exit='keep',
        environment={'PIP_NO_INDEX': '1', 'PIP_FIND_LINKS': '/fogt', 'PYTHONPATH': '/mine',
                     **variables},
        apt=('fogt-asked',), pip=('fogt-two',))


def said(machine) -> str:
    """Run the node; return what it printed."""
    heard = []
    machine.subscribe(heard.append)
    node = NodeSpec(f'n-{time.monotonic_ns()}', 'node', package='fogt_top', executable='node')
    machine.start([node])
    wait_until(lambda: any(e['event'] == 'exited' and e['node'] == node.id for e in heard),
               timeout=60, what='the node to end')
    return ' '.join(e['text'] for e in heard if e['event'] == 'output' and e['node'] == node.id)


def test_node_finds_what_it_needs_and_kept_machines_have_it(spec):
    """Asked for by the launch file, declared by the workspace, and in the workspace below."""
    details = {'ROS 2': [], 'workspace': []}
    for last in (False, True):
        launch = Launch(report=lambda event: details[event.step].append(event.detail) if (
            isinstance(event, StepDone) and event.step in details) else None)
        try:
            machine = launch.up(dataclasses.replace(spec, on_exit='delete') if last else spec)
            *found, path = said(machine).split()
            assert found == ['top', 'below', 'fogt_one', 'fogt_two', '/usr/bin/fogt-hello',
                             '/usr/bin/fogt-asked']
            # the user's folder comes first, and takes nothing away
            assert path.startswith('/mine:') and path.endswith('/last')
        finally:
            assert launch.down() == []
    first, again = details['ROS 2']
    assert 'installed fogt-asked, fogt-hello, installed fogt-two, fogt-one by pip' in first
    assert 'the machine may lack fogt_unknown' in first
    assert again == 'there already'
    assert '/srv/acme stays here' in details['workspace'][0]


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

# SPDX-License-Identifier: Apache-2.0
"""What a robot sends whose FogROS2 came by colcon, which writes no list of files."""

from __future__ import annotations

import dataclasses
from importlib import metadata
import os
from pathlib import Path
import stat
import sys
import threading
import zipfile

import pytest

from fogros2.errors import Cancelled, PrerequisiteError
from fogros2.host import bootstrap, wheels
from fogros2.host.inspection import HostFacts, Python
from fogros2.host.wheels import Wheels
from fogros2.host.workspace import inspect
from fogros2.model import MachineSpec
from fogros2.plan import Underlay

INDEX = 'share/ament_index/resource_index/packages'


def install(root: Path) -> Path:
    """Lay this package out as colcon's isolated install space has it; return the prefix."""
    prefix = root / 'install' / 'fogros2'
    site = prefix / 'lib' / 'python3.12' / 'site-packages'
    info = site / 'fogros2-0.1.0-py3.12.egg-info'
    for path, text in {
        root / 'install' / '.colcon_install_layout': 'isolated\n',
        root / 'src' / 'fogros2' / 'package.xml':
            '<package format="3"><name>fogros2</name></package>',
        site / 'fogros2' / '__init__.py': '',
        site / 'fogros2' / 'clock.py': 'x = 1\n',
        site / 'fogros2' / '__pycache__' / 'clock.cpython-312.pyc': 'no\n',
        site / 'fogros2_examples' / 'talker.py': '',
        site / 'other' / '__init__.py': 'not ours\n',
        info / 'PKG-INFO': 'Metadata-Version: 2.1\nName: fogros2\nVersion: 0.1.0\n',
        info / 'top_level.txt': 'fogros2\nfogros2_examples\n',
        info / 'entry_points.txt': '[fogros2.dds]\nx = fogros2:y\n',
        info / 'SOURCES.txt': 'setup.py\nfogros2/__init__.py\n',
        prefix / INDEX / 'fogros2': '',
        prefix / INDEX / 'fogros2_examples': '',
        prefix / INDEX / 'other': '',
        prefix / 'share' / 'fogros2' / 'launch' / 'cloud.launch.py': '',
        prefix / 'lib' / 'fogros2_examples' / 'talker': '#!/usr/bin/env python3\n',
    }.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (prefix / 'lib' / 'fogros2_examples' / 'talker').chmod(0o755)
    return prefix


@pytest.fixture
def colcon(tmp_path, monkeypatch):
    """Have this package installed by colcon, beside a ROS 2 without our launch."""
    prefix = install(tmp_path / 'ws')
    (info,) = prefix.glob('lib/*/site-packages/*.egg-info')

    def distribution(name):
        if name != 'fogros2':
            raise metadata.PackageNotFoundError(name)
        return metadata.PathDistribution(info)

    monkeypatch.setattr(wheels.metadata, 'distribution', distribution)
    return prefix


def test_a_wheel_is_made_of_what_colcon_installed(colcon, tmp_path):
    packed = wheels.collect(tmp_path / 'cache')
    assert (packed.fogros2, packed.pip, packed.ros) == (
        'fogros2-0.1.0-py3-none-any.whl', '', False)
    with zipfile.ZipFile(Path(packed.folder, packed.fogros2)) as archive:
        assert set(archive.namelist()) == {
            'fogros2/__init__.py', 'fogros2/clock.py', 'fogros2_examples/talker.py',
            *(f'fogros2-0.1.0.data/data/{path}' for path in (
                f'{INDEX}/fogros2', f'{INDEX}/fogros2_examples',
                'share/fogros2/launch/cloud.launch.py', 'lib/fogros2_examples/talker')),
            *(f'fogros2-0.1.0.dist-info/{name}' for name in (
                'METADATA', 'WHEEL', 'RECORD', 'entry_points.txt'))}
        assert b'Name: fogros2' in archive.read('fogros2-0.1.0.dist-info/METADATA')
        talker = archive.getinfo('fogros2-0.1.0.data/data/lib/fogros2_examples/talker')
        assert talker.external_attr >> 16 & 0o111


def test_another_content_is_another_wheel(colcon, tmp_path, monkeypatch):
    first = wheels.collect(tmp_path / 'cache')
    # for the machines of a launch nobody looks anew
    assert wheels.collect(tmp_path / 'cache') is first
    monkeypatch.setattr(wheels, 'FRESH', 0.0)
    assert wheels.collect(tmp_path / 'cache').key == first.key
    (module,) = colcon.glob('lib/*/site-packages/fogros2/clock.py')
    module.write_text('x = 2\n')
    assert wheels.collect(tmp_path / 'cache').key != first.key


def test_cache_is_the_users_alone_with_any_umask(colcon, tmp_path):
    before = os.umask(0)
    try:
        packed = wheels.collect(tmp_path / 'fogros2/wheels')
    finally:
        os.umask(before)
    for folder in (tmp_path / 'fogros2', tmp_path / 'fogros2/wheels', Path(packed.folder)):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_development_install_is_refused_with_a_remedy(colcon, tmp_path):
    (info,) = colcon.glob('lib/*/site-packages/*.egg-info')
    (info / 'RECORD').write_text('fogros2.pth,,\n')
    (info / 'WHEEL').write_text('Tag: py3-none-any\n')
    (info / 'direct_url.json').write_text('{"dir_info": {"editable": true}, "url": "file:///x"}')
    with pytest.raises(PrerequisiteError, match='installed for development, .*without -e'):
        wheels.collect(tmp_path / 'cache')


def test_path_without_a_setup_script_is_reported(colcon, tmp_path, monkeypatch):
    (colcon / INDEX / 'fogros2').unlink()
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    with pytest.raises(PrerequisiteError, match='in no ament prefix.*setup.bash'):
        wheels.collect(tmp_path / 'cache')


def test_workspace_with_fogros2_needs_no_wheel(tmp_path):
    root = tmp_path / 'ws'
    install(root)
    workspace = inspect(root)
    robot = HostFacts(
        'ubuntu', '24.04', 'x86_64', 'u', '/home/u', 'glibc 2.39', True,
        (Python('/usr/bin/python3', (3, 12), True),),
        frozenset({'ip', 'nft', 'rsync', 'wg', 'wireguard-go', 'colcon', 'rosdep'}),
        {'jazzy': '/opt/ros/jazzy'}, {'jazzy': ('rmw_fastrtps_cpp',)},
        environments={'/opt/ros/jazzy': '1-1'})
    under = Underlay(('/opt/ros/jazzy',), {
        'AMENT_PREFIX_PATH': f'{root}/install/fogros2:/opt/ros/jazzy'})
    spec = MachineSpec('m', 'ssh', workspace=str(root))
    alike = bootstrap.plan_alike(spec, robot, robot, under, [workspace])
    assert alike is not None

    # a machine with a ROS 2 of its own needs no wheel either
    other = dataclasses.replace(robot, environments={})
    packed = Wheels('/cache', 'k', (3, 12), 'x86_64', 'glibc 2.28', 'f.whl', ros=False)
    todo = bootstrap.plan(spec, other, robot, under, packed, [workspace])
    assert not todo.wheels_target and todo.commands == ()
    assert todo.install.setup == ('/opt/ros/jazzy/setup.sh',)
    assert todo.install.environment['AMENT_PREFIX_PATH'] == (
        f'{root}/install/fogros2:/opt/ros/jazzy')


def test_fetching_needs_no_virtual_environment(tmp_path, monkeypatch):
    """Which the user's pip.conf may ask for."""
    commands = []
    monkeypatch.setattr(wheels.process, 'run', lambda command, **_: commands.append(command))
    wheels.fetch(['numpy'], (3, 13), timeout=60.0, folder=tmp_path)
    assert [command.environment['PIP_REQUIRE_VIRTUALENV'] for command in commands] == ['0']


def test_fetching_ends_when_the_launch_does(tmp_path, monkeypatch):
    pip = tmp_path / 'python'
    pip.write_text('#!/bin/sh\nexec sleep 100\n')
    pip.chmod(0o755)
    monkeypatch.setattr(sys, 'executable', str(pip))
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(Cancelled):
        wheels.fetch(['numpy'], (3, 13), timeout=60.0, cancel=cancel, folder=tmp_path)

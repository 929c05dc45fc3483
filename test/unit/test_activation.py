# SPDX-License-Identifier: Apache-2.0
"""``. .venv-ros/bin/activate`` sets what ``tools/run.sh ros`` sets."""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]
VARIABLES = ('VIRTUAL_ENV', 'AMENT_PREFIX_PATH', 'PYTHONPATH')
SETUP = 'export ROS_DISTRO=jazzy AMENT_PREFIX_PATH={0} PYTHONPATH={0}/lib PATH={0}/bin:$PATH\n'


@pytest.fixture
def ros(tmp_path: Path) -> Path:
    """Return the folder of something that looks like ROS 2 Jazzy."""
    prefix = tmp_path / 'jazzy'
    (prefix / 'share' / 'rclpy').mkdir(parents=True)
    for shell in ('sh', 'bash', 'zsh'):
        (prefix / f'setup.{shell}').write_text(SETUP.format(prefix))
    return prefix


@pytest.fixture
def venv(tmp_path: Path, ros: Path) -> Path:
    """Return an environment as tools/setup.sh makes it, its activate script done twice."""
    folder = tmp_path / 'venv'
    subprocess.run([sys.executable, '-m', 'venv', '--without-pip', str(folder)], check=True)
    teach = f"teach_activate '{folder}' '{ros}/setup.sh'"
    subprocess.run(['sh', '-euc', f'. tools/common.sh; {teach}; {teach}'], cwd=ROOT, check=True)
    return folder


def environment(*command: str, **variables: str) -> dict[str, str]:
    """Return the variables that a command prints with ``env -0``."""
    printed = subprocess.run(
        command, capture_output=True, text=True, check=True,
        env={'HOME': '/', 'PATH': '/usr/bin:/bin', **variables}).stdout
    return dict(line.partition('=')[::2] for line in printed.split('\0') if line)


@pytest.mark.parametrize('shell', ['bash', 'sh'])
@pytest.mark.parametrize('sourced', [False, True], ids=['fresh', 'ros sourced'])
def test_activation_sets_the_variables_of_run(
    ros: Path, venv: Path, shell: str, sourced: bool,
) -> None:
    before = f'. {ros}/setup.{shell}; ' if sourced else ''
    found = environment(shell, '-c', f'{before}. {venv}/bin/activate; env -0')
    expected = environment(
        str(ROOT / 'tools' / 'run.sh'), 'ros', '--', 'env', '-0', FOGROS2_VENV_ROS=str(venv),
        ROS_DISTRO='jazzy', AMENT_PREFIX_PATH=str(ros))
    assert {name: found[name] for name in VARIABLES} == {
        name: expected[name] for name in VARIABLES}
    assert found['PATH'].split(':')[0] == expected['PATH'].split(':')[0] == f'{venv}/bin'


def test_deactivate_restores_the_variables(ros: Path, venv: Path) -> None:
    script = f'. {ros}/setup.bash; . {venv}/bin/activate; deactivate; env -0'
    found = environment('bash', '-c', script)
    assert (found['AMENT_PREFIX_PATH'], found['PYTHONPATH']) == (str(ros), f'{ros}/lib')
    assert found['PATH'].startswith(f'{ros}/bin:') and str(venv) not in found['PATH']

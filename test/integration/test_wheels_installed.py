# SPDX-License-Identifier: Apache-2.0
"""The two wheels, built by pip and installed into a fresh environment: commands and files work."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig
import venv

import pytest

from rigs.launched import embedded

ROOT = Path(__file__).resolve().parents[2]
WHEELS = {'fogros2': ROOT, 'ros2_embedded': ROOT / 'ros2_embedded'}


def sources(folder: Path) -> Path:
    """Copy what belongs to the project, as setuptools leaves folders behind where it builds."""
    listed = subprocess.run(['git', 'ls-files', '-z', '-co', '--exclude-standard'], cwd=ROOT,
                            capture_output=True)
    if listed.returncode != 0:
        pytest.skip('this tree is under no version control, which says what goes in')
    for name in filter(None, listed.stdout.decode().split('\0')):
        target = folder / name
        if (ROOT / name).is_file() and not name.startswith(('test/', 'doc/', 'benchmarks/')):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target)
    return folder


@pytest.fixture(scope='module')
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a new virtual environment with the wheels; their dependencies are the tests' own."""
    pytest.importorskip('launch.actions', reason='launch is not installed')
    if not embedded():
        pytest.skip('the tests run on an installation of ROS 2')
    top = tmp_path_factory.mktemp('wheels')
    copy = sources(top / 'source')
    pip = [sys.executable, '-m', 'pip', '--quiet', '--disable-pip-version-check']
    subprocess.run(
        [*pip, 'wheel', '--no-deps', '--no-build-isolation', '--wheel-dir', str(top / 'built'),
         str(copy), str(copy / 'ros2_embedded')], check=True)
    built = sorted((top / 'built').glob('*.whl'))
    assert [path.name.partition('-')[0] for path in built] == sorted(WHEELS)
    folder = top / 'environment'
    venv.create(folder, symlinks=True)
    python = folder / 'bin' / 'python'
    subprocess.run(
        [*pip, '--python', str(python), 'install', '--no-deps', '--no-index', *map(str, built)],
        check=True)
    (site,) = folder.glob('lib/python3.*/site-packages')
    # behind its own; a line of a .pth brings no .pth files of that folder, so no editable install
    (site / 'dependencies.pth').write_text(sysconfig.get_path('purelib') + '\n')
    return folder


def run(environment: Path, *words: str) -> str:
    done = subprocess.run(
        words, cwd='/', capture_output=True, text=True, timeout=60,
        env={'PATH': f'{environment}/bin:/usr/bin:/bin', 'HOME': str(environment),
             'FOGROS2_STATE_HOME': os.environ['FOGROS2_STATE_HOME']})
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_modules_and_metadata_are_the_wheels_own(environment: Path) -> None:
    said = run(environment, 'python', '-c',
               'import importlib.metadata as m, fogros2, launch, ros2fog_cli\n'
               'print(*(x.__file__ for x in (fogros2, launch, ros2fog_cli)), sep="\\n")\n'
               'print(m.version("fogros2"), *m.metadata("fogros2").get_all("Provides-Extra"))\n'
               'print(*m.requires("fogros2"), sep="\\n")')
    *files, about = said.splitlines()[:4]
    assert not [line for line in said.splitlines()[4:]
                if line.startswith('ros') and 'extra' not in line]
    assert all(path.startswith(str(environment)) for path in files)
    assert {'aws', 'kubernetes', 'monitor', 'video'} <= set(about.split()[1:])


def test_the_command_line_and_launch_files_work(environment: Path) -> None:
    assert run(environment, 'ros2', 'fog', 'list')  # other launches' machines, or 'no machines'
    assert "'name'" in run(
        environment, 'ros2', 'launch', '-s', 'fogros2_examples', 'talker.container.launch.py')
    assert run(environment, 'ros2', 'pkg', 'prefix', 'fogros2').strip() == str(environment)
    assert 'fogros2_examples talker' in run(
        environment, 'ros2', 'pkg', 'executables', 'fogros2_examples')

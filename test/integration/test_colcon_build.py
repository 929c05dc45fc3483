# SPDX-License-Identifier: Apache-2.0
"""The package in a colcon workspace, beside another one, built in each of colcon's ways."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[2]
SEARCHED = os.pathsep.join([os.path.dirname(sys.executable), os.environ.get('PATH', '')])
COLCON = shutil.which('colcon', path=SEARCHED)

pytestmark = [pytest.mark.skipif(COLCON is None, reason='colcon is not installed')]

OTHER = {
    'package.xml': '<package format="3"><name>other</name><version>1.0.0</version>'
                   '<description>For a test.</description>'
                   '<maintainer email="nobody@example.org">nobody</maintainer>'
                   '<license>Apache-2.0</license><depend>fogros2</depend>'
                   '<export><build_type>ament_python</build_type></export></package>\n',
    'setup.py': "from setuptools import setup\nsetup(name='other', version='1.0.0',\n"
                "      packages=['other'], data_files=[\n"
                "          ('share/ament_index/resource_index/packages', ['resource/other']),\n"
                "          ('share/other', ['package.xml'])])\n",
    'setup.cfg': '[develop]\nscript_dir=$base/lib/other\n[install]\n'
                 'install_scripts=$base/lib/other\n',
    'resource/other': '', 'other/__init__.py': '',
}


@pytest.fixture(scope='module')
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Lay out a workspace's ``src``: what of this tree is under version control, and a package."""
    folder = tmp_path_factory.mktemp('workspace') / 'src'
    names = subprocess.run(['git', 'ls-files', '-z'], cwd=ROOT, check=True, capture_output=True)
    for name in filter(None, names.stdout.decode().split('\0')):
        target = folder / 'fogros2' / name
        if (ROOT / name).is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target)
    for name, text in OTHER.items():
        target = folder / 'other' / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text)
    return folder


def bash(script: str, cwd: Path) -> str:
    done = subprocess.run(
        ['bash', '-ec', script], cwd=cwd, capture_output=True, text=True, timeout=200,
        env={**os.environ, 'PATH': SEARCHED, 'ROS_LOG_DIR': str(cwd / 'log'),
             'PYTHONWARNINGS': 'ignore', 'COLCON_LOG_LEVEL': 'error'})
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize('option', ['', '--symlink-install --merge-install'])
def test_it_is_built_beside_others_and_found(sources, tmp_path, option):
    (tmp_path / 'src').symlink_to(sources)
    bash(f'{COLCON} build {option}', tmp_path)
    said = bash('. install/setup.bash\n'
                'python3 -c "import fogros2, os; print(os.path.realpath(fogros2.__file__))"\n'
                'ros2 pkg executables fogros2_examples\n'
                'ros2 pkg prefix fogros2\n'
                'ros2 fog -h\n'
                'ros2 launch fogros2_examples talker.container.launch.py -s', tmp_path)
    where = str(sources if option else tmp_path)
    assert said.startswith(where), said
    for words in ('fogros2_examples talker', f'{tmp_path}/install', 'ros2 fog', "'name'"):
        assert words in said

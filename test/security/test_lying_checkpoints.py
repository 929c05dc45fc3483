# SPDX-License-Identifier: Apache-2.0
"""A checkpoint takes no more of the robot's disk than its limit, and its snapshots end."""

from __future__ import annotations

from collections.abc import Iterator
import inspect
import os
from pathlib import Path
import subprocess
import sys
import tempfile

import pytest

from fogros2 import process
from fogros2.errors import ShellError
from fogros2.model import Endpoint, Result
from fogros2.shell.local import LocalShell
from fogros2.shell.sync import Room
from fogros2.store import delete_folder, Store
from fogros2_features.replacement import snapshots
from fogros2_features.replacement.snapshots import Checkpoint
from rigs.stranger import NOBODY
from ros2fog_cli.api.bugreport import known_secrets

pytestmark = pytest.mark.skipif(process.which('rsync') is None, reason='needs rsync')


class Lying(LocalShell):
    """A machine that says that its folder has a hundred bytes."""

    def run(self, *_: object, **__: object) -> Result:
        return Result(0, f"100\n{'0' * 64}  -\n", '')


@pytest.fixture
def shell() -> Lying:
    return Lying(Endpoint('local'), name='planner')


def used(folder: Path) -> int:
    return sum(512 * path.lstat().st_blocks for path in folder.rglob('*'))


def test_machine_cannot_send_more_than_it_says(
    shell: Lying, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(snapshots, 'LIMIT', 1 << 20)
    (tmp_path / 'map').mkdir()
    (tmp_path / 'map/large').write_bytes(bytes(4 << 20))
    with pytest.raises(ShellError, match='this computer has sent more than 0.0 GB in place of'):
        Checkpoint(str(tmp_path / 'map'), tmp_path / 'robot').save(shell, still=True)
    assert not list((tmp_path / 'robot').iterdir())


def test_copy_ends_when_it_is_too_large(shell: Lying, tmp_path: Path) -> None:
    (tmp_path / 'map').mkdir()
    with open(tmp_path / 'map/large', 'wb') as file:
        file.truncate(4 << 30)
    with pytest.raises(ShellError, match='has sent more than 0.0 GB'):
        shell.fetch(str(tmp_path / 'map'), tmp_path / 'robot', known=None, limit=1 << 20,
                    timeout=60.0)
    assert used(tmp_path / 'robot') < 2 << 30, 'it was noticed while it came'


def test_files_without_content_are_counted(shell: Lying, tmp_path: Path) -> None:
    (tmp_path / 'map').mkdir()
    for number in range(300):
        (tmp_path / f'map/{number}').touch()
    with pytest.raises(ShellError, match='has sent more than'):
        shell.fetch(str(tmp_path / 'map'), tmp_path / 'robot', known=None, limit=1 << 20,
                    timeout=60.0)


#: Fetches a folder, as another account.
FETCH = f"""\
import os, sys
from pathlib import Path
from fogros2.model import Endpoint
from fogros2.shell.local import LocalShell
os.setgroups([]), os.setgid({NOBODY}), os.setuid({NOBODY})
LocalShell(Endpoint('local'), name='planner').fetch(
    sys.argv[1], Path(sys.argv[2]), known=None, limit=1 << 20, timeout=60.0)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason='root alone gives a folder to another account')
def test_folders_that_nobody_may_read_are_counted(home: Path) -> None:
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        for number in range(4):
            folder = Path(name, str(number))
            folder.mkdir()
            (folder / 'large').write_bytes(bytes(1 << 19))
            # the copy belongs to the account, which has no right to it
            folder.chmod(0o055)
        done = subprocess.run([sys.executable, '-c', FETCH, name, str(home / 'copy')],
                              capture_output=True, text=True, timeout=60)
    assert 'has sent more than' in done.stderr


@pytest.fixture
def home() -> Iterator[Path]:
    """Return a folder of an account that is not root's."""
    with tempfile.TemporaryDirectory() as name:
        if os.geteuid() == 0:
            os.chown(name, NOBODY, NOBODY)
        yield Path(name)


#: Makes six snapshots of a folder with folders that nobody may write, as another account.
SIX = f"""\
import os, sys
from pathlib import Path
from fogros2_features.replacement.snapshots import Checkpoint
from fogros2.model import Endpoint
from fogros2.shell.local import LocalShell
from fogros2.store import Store
if os.geteuid() == 0:
    os.setgroups([]), os.setgid({NOBODY}), os.setuid({NOBODY})
home = Path(sys.argv[1])
source, store = home / 'map', home / 'state/machines/planner/checkpoint'
(source / 'a/b').mkdir(parents=True)
(source / 'a/b/file').touch()
(source / 'a/outside').symlink_to('/')
kept = Checkpoint(str(source), store)
for number in range(6):
    (source / 'number').write_text(str(number))
    for folder in ('a/b', 'a'):
        (source / folder).chmod(0o555)
    assert kept.save(LocalShell(Endpoint('local'), name='planner'), still=True)
    print(sorted(path.name for path in store.iterdir()))
Store(home / 'state').delete('planner')
print(list((home / 'state/machines').iterdir()))
for folder in ('a', 'a/b'):
    (source / folder).chmod(0o755)
"""


def test_snapshots_of_folders_without_rights_are_deleted(home: Path) -> None:
    done = subprocess.run([sys.executable, '-c', SIX, str(home)], capture_output=True, text=True,
                          timeout=60)
    assert done.stdout.splitlines() == [
        *(str([f'{number:08}']) for number in range(1, 7)), '[]'], done.stderr


#: Levels of folders, and calls that a function may make in each other before a RecursionError:
#: Python's own limit of 1000 takes minutes on some file systems.
DEEP, CALLS = 180, 120


def make_deep(folder: Path, mode: int = 0o755) -> None:
    """Make folders in a folder, and a file of a block in the last one."""
    path = folder / '/'.join('d' * DEEP)
    for level in reversed([path, *path.parents][:DEEP]):
        os.mkdir(level)
    (path / 'file').write_bytes(bytes(4096))
    for level in [path, *path.parents][:DEEP]:
        level.chmod(mode)


@pytest.fixture
def few_calls() -> Iterator[None]:
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(len(inspect.stack()) + CALLS)
    yield
    sys.setrecursionlimit(before)


def test_folder_of_any_depth_is_counted_and_deleted(tmp_path: Path, few_calls: None) -> None:
    source, store = tmp_path / 'map', Store(tmp_path / 'state')
    source.mkdir()
    make_deep(source)
    kept = Checkpoint(str(source), store.launch_folder('abcdef') / 'checkpoints/planner')
    shell = LocalShell(Endpoint('local'), name='planner')
    for number in range(2):
        (source / 'number').write_text(str(number))
        assert kept.save(shell, still=True)
    assert kept.restore(shell)
    with pytest.raises(ShellError, match='too much'):
        Room(source, DEEP * 4096, None, 'too much').measure()
    store.sweep()
    known_secrets({}, store)
    delete_folder(store.root)
    delete_folder(source)
    assert list(tmp_path.iterdir()) == []


#: Deletes a folder, as another account if this one is root.
DELETE = f"""\
import os, sys
from pathlib import Path
from fogros2.store import delete_folder
if os.geteuid() == 0:
    os.setgroups([]), os.setgid({NOBODY}), os.setuid({NOBODY})
sys.setrecursionlimit({CALLS})
delete_folder(Path(sys.argv[1]))
"""


def test_deep_folder_that_nobody_may_write_is_deleted(home: Path) -> None:
    make_deep(home, 0o500)
    if os.geteuid() == 0:
        subprocess.run(['chown', '-R', f'{NOBODY}:{NOBODY}', str(home / 'd')], check=True)
    subprocess.run([sys.executable, '-c', DELETE, str(home / 'd')], timeout=60, check=True)
    assert list(home.iterdir()) == []


def test_deletion_follows_no_link(tmp_path: Path) -> None:
    outside = tmp_path / 'outside'
    outside.mkdir(mode=0o555)
    (tmp_path / 'inside').mkdir()
    (tmp_path / 'inside/link').symlink_to(outside)
    delete_folder(tmp_path / 'inside')
    assert not (tmp_path / 'inside').exists() and outside.stat().st_mode & 0o777 == 0o555

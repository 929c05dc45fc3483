# SPDX-License-Identifier: Apache-2.0
"""The search for files that a container machine may not show, and its last results."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import time

import pytest

from fogros2.provider import container
from fogros2.provider.container import hidden_files
from fogros2.provider.container import root as container_root
from fogros2.waiting import wait_until


def end_of_tick() -> None:
    """Wait until a change is seen in the time of the path that was changed last."""
    begin = time.time_ns()
    wait_until(lambda: time.time_ns() > begin + hidden_files.TICK, timeout=60.0, what='a tick')


@pytest.mark.skipif(os.geteuid() != 0, reason='root alone makes the folder of a machine')
def test_search_of_a_failed_creation_leaves_no_folder(tmp_path: Path) -> None:
    """The engine fails at once, while the search is at work in the folder."""
    top, archive = tmp_path / 'roots/top', container_root.Archive().data()
    busy = ('import sys\n'
            'for number in range(10 ** 6): open(f"{sys.argv[1]}/{number}", "w").close()')
    done = subprocess.run(
        ['sh', '-ec', container._CREATE, 'sh', top, '', '', '', busy, container.clean(top), '', '',
         'sh', '-c', f'until [ -e {top}/1000 ]; do :; done; exit 3'], input=b'label\n' + archive)
    assert done.returncode == 3
    assert not top.exists()


def test_search_finds_what_not_everybody_may_read(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    for name, mode, text in (('root', 0o600, 'x'), ('group', 0o640, 'x'), ('all', 0o644, 'x'),
                             ('program', 0o711, 'x'), ('lock', 0o600, '')):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(mode)
    (tmp_path / 'link').symlink_to('root')
    (tmp_path / 'open').mkdir(0o755)
    (tmp_path / 'open/deep').mkdir(0o700)
    (tmp_path / 'open/deep/file').write_text('x')
    found, changed = hidden_files.search(str(tmp_path))
    assert sorted(found) == [f'{tmp_path}/{name}' for name in ('group', 'open/deep', 'root')]
    assert set(changed) == {str(tmp_path), f'{tmp_path}/open', f'{tmp_path}/open/deep'}


@pytest.mark.parametrize('change', ['file', 'mode', 'removal', 'folder'])
def test_change_makes_the_last_search_invalid(tmp_path: Path, change: str) -> None:
    folder = tmp_path / 'folder'
    tmp_path.chmod(0o755)
    folder.mkdir(0o755)
    (folder / 'file').write_text('x')
    end_of_tick()
    _, changed = hidden_files.search(str(tmp_path), str(tmp_path))
    assert hidden_files.unchanged(changed)
    if change == 'file':
        (folder / 'other').write_text('x')
    elif change == 'mode':
        (folder / 'file').chmod(0o600)
    elif change == 'removal':
        (folder / 'file').unlink()
    else:
        folder.rename(tmp_path / 'renamed')
    assert not hidden_files.unchanged(changed)


def test_machine_gets_a_search_of_its_own_folders(tmp_path: Path) -> None:
    top, cache, shown = tmp_path / 'top', tmp_path / 'cache/hidden', tmp_path / 'shown'
    other = os.fsdecode(b'J\xfcrgen')  # no UTF-8
    for folder in (top, shown, shown / 'a', shown / other):
        folder.mkdir(0o755)
    for name in ('a', other):
        (shown / name / 'secret').write_text('x')
        (shown / name / 'secret').chmod(0o600)
    end_of_tick()
    for names in (['a'], ['a', other], [other], [other]):
        (top / 'shown').write_bytes(b''.join(bytes(shown / name) + b'\n' for name in names))
        hidden_files.main(str(top), str(cache))
        assert (top / 'hidden').read_bytes() == b''.join(
            bytes(shown / name / 'secret') + b'\0' for name in names)
        assert set(hidden_files.read(str(cache))) == {str(shown / name) for name in names}
        if names != ['a']:
            cache.write_bytes(cache.read_bytes()[:-9])

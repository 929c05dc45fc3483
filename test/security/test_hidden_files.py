# SPDX-License-Identifier: Apache-2.0
"""Files of this computer that root alone may read, where a container machine shows its folders."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import subprocess
import time
import uuid

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2.provider import container
from fogros2.provider.container import hidden_files
from fogros2.provider.container import root as container_root
from fogros2.waiting import wait_until
from rigs.container_machines import Cloud, cloud, cloud_network, engine, key

__all__ = ['cloud', 'cloud_network', 'engine', 'key']


def sudo(script: str, *words: str) -> str:
    return process.run(Command(('sh', '-ec', script, 'sh', *words), sudo=True),
                       timeout=60.0).stdout


@pytest.fixture
def own(root: None) -> Iterator[str]:
    """Return a folder in /usr/local with a file for all users, and one for root."""
    path = f'/usr/local/share/fogros2-test-{uuid.uuid4().hex}'
    sudo('umask 022; mkdir -p "$1"; cd "$1"; echo public >public; echo secret >"a secret"; '
         'chmod 600 "a secret"', path)
    yield path
    sudo('rm -rf "$1"', path)


def end_of_tick() -> None:
    """Wait until a change is seen in the time of the path that was changed last."""
    begin = time.time_ns()
    wait_until(lambda: time.time_ns() > begin + hidden_files.TICK, timeout=60.0, what='a tick')


def seen(cloud: Cloud, machine_id: str, folder: str) -> set[str]:
    """Return the lines that root on a machine finds in files below a folder."""
    with cloud.shell(cloud.reached(machine_id)) as shell:
        return set(shell.run(Command(('grep', '-rhs', '', folder), sudo=True), timeout=60.0,
                             check=False).stdout.splitlines())


def test_root_on_a_machine_reads_no_file_of_root_here(cloud: Cloud, own: str) -> None:
    first = cloud.create(cloud.spec(on_exit='stop'))
    assert seen(cloud, first, own) == {'public'}
    # what comes after the search that the first machine needed
    sudo('umask 077; mkdir "$1/closed"; echo secret >"$1/closed/file"; echo secret >"$1/new"', own)
    second = cloud.create(cloud.spec())
    assert seen(cloud, second, own) == {'public'}
    with cloud.shell(cloud.reached(second)) as shell:
        undo = shell.run(Command(('umount', f'{own}/a secret'), sudo=True), timeout=60.0,
                         check=False)
        assert 'must be superuser' in undo.stderr
    cloud.provider.stop(first)
    cloud.provider.start(first)
    assert seen(cloud, first, own) == {'public'}


def test_root_on_a_machine_reads_no_private_file_of_an_underlay(
    cloud: Cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    underlay = tmp_path / 'underlay'
    underlay.mkdir(0o755)
    (underlay / 'public').write_text('public\n')
    (underlay / 'private').write_text('secret\n')
    (underlay / 'private').chmod(0o600)
    module = tmp_path / 'module.py'
    module.write_text('public too\n')
    monkeypatch.setattr(container_root, 'editable', lambda site: [str(module)])
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(underlay), os.pathsep)
    identity = cloud.create(cloud.spec())
    assert seen(cloud, identity, str(underlay)) == {'public'}
    assert seen(cloud, identity, str(module)) == {'public too'}


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
    for folder in (top, shown, shown / 'a', shown / 'b'):
        folder.mkdir(0o755)
    for name in 'ab':
        (shown / name / 'secret').write_text('x')
        (shown / name / 'secret').chmod(0o600)
    end_of_tick()
    for names in ('a', 'ab', 'b', 'b'):
        (top / 'shown').write_text(''.join(f'{shown / name}\n' for name in names))
        hidden_files.main(str(top), str(cache))
        assert (top / 'hidden').read_bytes() == b''.join(
            f'{shown / name}/secret\0'.encode() for name in names)
        assert set(hidden_files.read(str(cache))) == {str(shown / name) for name in names}
        if names != 'a':
            cache.write_bytes(cache.read_bytes()[:-9])

# SPDX-License-Identifier: Apache-2.0
"""Snapshots of a node's folder: complete or not there, and never larger than a disk."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

import pytest

from fogros2 import process
from fogros2.describe.values import check_folder
from fogros2.errors import ConfigurationError, ConnectError, DeadlineExceeded, ShellError
from fogros2.model import Endpoint, Result
from fogros2.process import which
from fogros2.shell import ATTEMPTS
from fogros2.shell.local import LocalShell
from fogros2_features.replacement import snapshots
from fogros2_features.replacement.snapshots import Checkpoint
from fogros2_testing.fakes import FakeShell

pytestmark = pytest.mark.skipif(which('rsync') is None, reason='needs rsync')


@pytest.fixture
def shell():
    return LocalShell(Endpoint('local'), name='planner')


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / 'machine' / 'map'
    (path / 'parts').mkdir(parents=True)
    (path / 'parts/1').write_text('one')
    return path


@pytest.fixture
def kept(folder, tmp_path):
    return Checkpoint(str(folder), tmp_path / 'robot')


def texts(path):
    return {str(found.relative_to(path)): found.read_text()
            for found in sorted(path.rglob('*')) if found.is_file()}


def test_newest_snapshot_replaces_the_one_before(kept, folder, shell, tmp_path):
    assert kept.save(shell, still=False) and texts(kept.newest) == {'parts/1': 'one'}
    assert not kept.save(shell, still=False), 'nothing has changed'
    inode = (kept.newest / 'parts/1').stat().st_ino
    (folder / 'parts/2').write_text('two')
    assert kept.save(shell, still=False)
    assert texts(kept.newest) == {'parts/1': 'one', 'parts/2': 'two'}
    assert (kept.newest / 'parts/1').stat().st_ino == inode, 'a link, and no second copy'
    (folder / 'parts/1').unlink()
    assert kept.save(shell, still=False) and texts(kept.newest) == {'parts/2': 'two'}
    assert [path.name for path in (tmp_path / 'robot').iterdir()] == ['00000003']


def test_restored_folder_equals_the_snapshot(kept, folder, shell, tmp_path):
    assert not kept.restore(shell), 'there is none yet'
    kept.save(shell, still=False)
    (folder / 'parts/1').write_text('later')
    (folder / 'other').write_text('later')
    assert kept.restore(shell, '.before-abc') and texts(folder) == {'parts/1': 'one'}
    assert texts(tmp_path / 'machine/map.before-abc') == {'parts/1': 'later', 'other': 'later'}
    (folder / 'parts/1').write_text('here')
    assert texts(kept.newest) == {'parts/1': 'one'}, 'nodes write no snapshot'
    kept.restore(shell, '.before-abc')
    assert texts(tmp_path / 'machine/map.before-abc')['other'] == 'later', 'kept once'


class Torn(LocalShell):
    """A shell over which a copy does what a test wants, then ends."""

    def fetch(self, source, target, **words):
        self.during(Path(source), target)
        super().fetch(source, target, **words)


@pytest.fixture
def torn():
    return Torn(Endpoint('local'), name='planner')


def test_copy_of_a_changing_folder_is_not_used(kept, folder, torn):
    numbers = iter(range(100))
    torn.during = lambda source, target: (source / 'more').write_text(str(next(numbers)))
    with pytest.raises(ShellError, match='changes faster than it can be copied.*~/checkpoint'):
        kept.save(torn, still=False)
    assert kept.newest is None
    assert kept.save(torn, still=True), 'its node says that the files are consistent'


def test_copy_from_which_a_file_vanishes_is_tried_again(
        kept, folder, shell, tmp_path, monkeypatch):
    """A node writes a file aside and renames it, so rsync exits with 24."""
    (folder / 'map.tmp').write_text('half')
    program = tmp_path / 'bin/rsync'
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\n{which("rsync")} "$@" || exit\n'
                       f'! rm {folder}/map.tmp 2>/dev/null || exit 24\n')
    program.chmod(0o755)
    monkeypatch.setitem(process._ENVIRONMENT, 'PATH', f'{program.parent}:{os.environ["PATH"]}')
    assert kept.save(shell, still=False) and texts(kept.newest) == {'parts/1': 'one'}


@pytest.mark.parametrize('error', [ConnectError, DeadlineExceeded])
def test_next_copy_continues_the_one_that_was_cut_off(
        kept, folder, torn, shell, tmp_path, error):
    def cut(source, target):
        target.mkdir()
        (target / 'parts').write_text('half')
        raise error('the connection is lost')

    kept.save(shell, still=False)
    (folder / 'parts/2').write_text('two')
    torn.during = cut
    with pytest.raises(error):
        kept.save(torn, still=True)
    assert texts(kept.newest) == {'parts/1': 'one'}
    assert texts(tmp_path / 'robot/partial') == {'parts': 'half'}
    kept.save(shell, still=True)
    assert texts(kept.newest) == {'parts/1': 'one', 'parts/2': 'two'}


class Cut(LocalShell):
    """A shell whose next copies to the machine break."""

    cuts = 0

    def sync(self, source, target, **words):
        if self.cuts:
            self.cuts -= 1
            raise ConnectError('the connection is lost')
        return super().sync(source, target, **words)


@pytest.mark.parametrize('aside', ['', '.before-abc'], ids=['machine', 'robot'])
def test_folder_that_was_not_restored_replaces_no_snapshot(kept, folder, shell, tmp_path, aside):
    kept.save(shell, still=True)
    other = Cut(Endpoint('local'), name='next')
    other.cuts = ATTEMPTS
    (folder / 'parts/1').unlink()
    with pytest.raises(ConnectError):
        kept.restore(other, aside)
    (folder / 'parts').mkdir(parents=True, exist_ok=True)
    (folder / 'parts/half').write_text('of a node that began anew')
    for still in (False, True):
        with pytest.raises(ShellError, match='the last one was not restored, and stays'):
            kept.save(other, still=still)
    assert texts(kept.newest) == {'parts/1': 'one'}
    assert kept.restore(shell) and texts(folder) == {'parts/1': 'one'}
    (folder / 'parts/2').write_text('two')
    assert kept.save(shell, still=True)
    assert texts(kept.newest) == {'parts/1': 'one', 'parts/2': 'two'}


def test_restoring_goes_on_after_a_short_cut(kept, folder, shell):
    kept.save(shell, still=True)
    (folder / 'parts/1').unlink()
    other = Cut(Endpoint('local'), name='next')
    other.cuts = ATTEMPTS - 1
    assert kept.restore(other) and texts(folder) == {'parts/1': 'one'}


def test_missing_folder_has_no_snapshot(shell, tmp_path):
    kept = Checkpoint(str(tmp_path / 'nothing'), tmp_path / 'robot')
    assert not kept.save(shell, still=False) and kept.newest is None


def test_too_large_folder_is_refused(kept, shell, monkeypatch):
    monkeypatch.setattr(snapshots, 'LIMIT', 1)
    with pytest.raises(ShellError, match=r'has 0.0 GB, and a checkpoint at most 0.0 GB'):
        kept.save(shell, still=False)


def test_unreadable_file_is_named(kept):
    shell = FakeShell(handlers={'sh': lambda command: Result(0, 'unreadable ./parts/1\n', '')})
    with pytest.raises(ShellError, match='./parts/1 in .* can not be read'):
        kept.save(shell, still=False)


def test_robot_whose_disk_is_full_keeps_the_last_snapshot(kept, folder, shell, tmp_path):
    """A file system of the test's own would need root; a limit of sizes fails as a full disk."""
    kept.save(shell, still=False)
    (folder / 'large').write_bytes(b'x' * 3_000_000)
    program = ('import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20,) * 2)\n'
               'import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n'
               'from pathlib import Path\n'
               'from fogros2_features.replacement.snapshots import Checkpoint\n'
               'from fogros2.model import Endpoint\n'
               'from fogros2.shell.local import LocalShell\n'
               'Checkpoint(sys.argv[1], Path(sys.argv[2])).save(\n'
               '    LocalShell(Endpoint("local"), name="planner"), still=True)\n')
    ended = subprocess.run([sys.executable, '-c', program, str(folder), str(tmp_path / 'robot')],
                           capture_output=True, text=True)
    assert ended.returncode != 0 and 'Error: ' in ended.stderr
    assert texts(kept.newest) == {'parts/1': 'one'}
    assert not (tmp_path / 'robot/partial').exists()


@pytest.mark.parametrize('given, path', [
    ('$HOME/map', '~/map'), ('~/a/b/', '~/a/b'), ('/var/map', '/var/map')])
def test_folders(given, path):
    assert check_folder('checkpoint', given) == path


@pytest.mark.parametrize('given', ['$HOME', '~', '/', '', 'map', '~/../etc', '/var//map', '~/.'])
def test_folder_that_cannot_be_copied_is_refused(given):
    with pytest.raises(ConfigurationError, match='is no folder that can be copied'):
        check_folder('checkpoint', given)

# SPDX-License-Identifier: Apache-2.0
"""No file of another account that waits at a predictable path is taken for the user's own."""

from __future__ import annotations

from collections.abc import Callable
import importlib.util
import os
from pathlib import Path

import pytest

from fogros2.dds.fastdds import DEFAULT_FILE, FastDds
from fogros2.describe import defaults
from fogros2.errors import PrerequisiteError, StoreError
from fogros2.host import wheels
from fogros2.provider.container import debian_root
from fogros2.store import state_home, Store
from fogros2.waiting import in_thread

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason='gives files to other accounts')

STRANGER, FRIEND = 4711, 4712


@pytest.fixture
def shared(tmp_path: Path) -> Path:
    """Return a folder of root's in which every account may write, as /tmp."""
    folder = tmp_path / 'shared'
    folder.mkdir()
    folder.chmod(0o1777)
    return folder


def planted(path: Path) -> None:
    """Make a folder of the other account."""
    path.mkdir()
    path.chmod(0o777)
    os.chown(path, STRANGER, STRANGER)


@pytest.mark.parametrize(('variable', 'folder'), [
    ('XDG_CACHE_HOME', wheels.cache_folder), ('XDG_CACHE_HOME', debian_root.cache_folder),
    ('XDG_STATE_HOME', state_home), ('XDG_STATE_HOME', Store)])
@pytest.mark.parametrize('link', [False, True])
def test_folder_that_another_account_made_is_refused(
    shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str,
    folder: Callable[[], object], link: bool,
) -> None:
    monkeypatch.delenv('FOGROS2_STATE_HOME', raising=False)
    monkeypatch.setenv(variable, str(shared))
    folder()
    if link:
        (tmp_path / 'of me').mkdir()
        (shared / 'fogros2').symlink_to(tmp_path / 'of me')
        os.lchown(shared / 'fogros2', STRANGER, STRANGER)
    else:
        planted(shared / 'fogros2')
    with pytest.raises(StoreError, match='fogros2 belongs to another account'):
        folder()


@pytest.mark.skipif(not any(map(importlib.util.find_spec, ('tomllib', 'tomli'))),
                    reason='needs Python 3.11 or tomli')
def test_defaults_of_another_account_are_refused(shared: Path) -> None:
    (shared / 'install').mkdir()
    (shared / 'install/.colcon_install_layout').write_text('merged\n')
    planted(shared / 'src')
    file = shared / 'fogros2.toml'
    file.write_text("[container]\nmounts = ['/root']\n")
    environment = {'XDG_CONFIG_HOME': str(shared / 'none'),
                   'AMENT_PREFIX_PATH': str(shared / 'install')}
    assert file in defaults.files(environment)
    defaults.check(environment)
    os.chown(file, STRANGER, STRANGER)
    with pytest.raises(StoreError, match='fogros2.toml belongs to another account'):
        defaults.check(environment)
    # a workspace of a colleague, whose code the user runs anyway
    os.chown(file, FRIEND, FRIEND)
    os.chown(shared, FRIEND, FRIEND)
    defaults.check(environment)


def test_profile_of_another_account_is_refused(
    shared: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(shared)
    file = shared / DEFAULT_FILE
    file.write_text('<dds><address>203.0.113.66</address></dds>')
    assert FastDds().asked({'HOME': '/root'}) == ['203.0.113.66']
    os.chown(file, STRANGER, STRANGER)
    with pytest.raises(StoreError, match=f'{file} belongs to another account'):
        FastDds().asked({'HOME': '/root'})


def test_pipe_of_another_account_is_no_profile(
    shared: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(shared)
    os.mkfifo(DEFAULT_FILE)
    os.chown(DEFAULT_FILE, STRANGER, STRANGER)
    assert in_thread(lambda: FastDds().asked({'HOME': '/root'})).result(10.0) == []


def test_pip_of_another_account_does_not_run(
    shared: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(shared)
    monkeypatch.setenv('FOGROS2_WHEELS', str(shared / 'none'))
    (shared / 'pip.py').write_text(f'open({str(shared / "attacked")!r}, "w")')
    with pytest.raises(PrerequisiteError, match='numpy'):
        wheels.fetch(['numpy'], (3, 13), timeout=60.0, folder=shared / 'cache')
    assert not (shared / 'attacked').exists()

# SPDX-License-Identifier: Apache-2.0
"""Modules that programs import: looked for, brought, and found by these programs alone."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
import platform
import subprocess
import sys
from types import SimpleNamespace

import pytest

from fogros2.errors import PrerequisiteError
from fogros2.host import modules
from fogros2.model import NodeSpec

HERE = modules.Answer(
    (sys.version_info.major, sys.version_info.minor), platform.machine(),
    ' '.join(platform.libc_ver()), ('numpy', 'av', 'cv2'))


@pytest.mark.parametrize('programs, needed', [
    ([], ()), ([('fogros2_examples', 'talker')], ()), ([('my_robot', 'encoder')], ()),
    ([('fogros2_examples', 'talker'), ('image_transport_h264', 'decoder')],
     ('av', 'cv2', 'numpy')),
    ([('fogros2_examples', 'image_processor')], ('cv2', 'numpy')),
    ([('fogros2_examples', 'image_processor'), ('image_transport_h264', 'decoder')],
     ('av', 'cv2', 'numpy')),
    ([('fogros2_examples', 'camera'), ('fogros2', 'bridge')], ('cv2', 'foxglove', 'numpy'))])
def test_programs_need_their_modules(
    programs: list[tuple[str, str]], needed: tuple[str, ...],
) -> None:
    assert modules.needed_by(programs) == needed


def test_only_nodes_that_need_modules_find_them(tmp_path: Path) -> None:
    decoder = NodeSpec('1', 'decoder', 'image_transport_h264', 'decoder', ('--ros-args',))
    talker = NodeSpec('2', 'talker', 'fogros2_examples', 'talker')
    place = tmp_path / 'a folder'
    places = {'numpy': '', 'av': str(place), 'cv2': str(place), 'foxglove': '/else'}
    assert modules.fitted(talker, places) is talker
    assert modules.fitted(decoder, {'numpy': '', 'av': '', 'cv2': ''}) is decoder
    prefix = modules.fitted(decoder, places).prefix
    for before, after in ((None, f'{place}/site'), ('/a:/b', f'{place}/site:/a:/b')):
        environment = {'PATH': os.environ['PATH'], **({'PYTHONPATH': before} if before else {})}
        said = subprocess.run(
            [*prefix, 'sh', '-c', 'echo "$PYTHONPATH $0 $1"', 'a word', 'b c'], check=True,
            env=environment, text=True, stdout=subprocess.PIPE).stdout
        assert said == f'{after} a word b c\n'


def test_modules_are_copied_to_an_equal_machine() -> None:
    copy = modules.copy(HERE)
    assert copy is not None
    ((folder, entries),) = copy.entries.items()
    assert {'numpy', 'av', 'cv2', 'av.libs'} <= set(entries)
    assert not {'..', 'bin', 'fogros2'} & set(entries)
    assert Path(folder, 'av', '__init__.py').is_file()
    some = modules.copy(dataclasses.replace(HERE, missing=('av',)))
    assert some is not None and 'av' in some.entries[folder] and 'cv2' not in some.entries[folder]


def test_abi3_modules_are_copied_to_later_pythons() -> None:
    later = dataclasses.replace(HERE, python=(3, 99), missing=('cv2',))
    assert modules.copy(later) is not None
    assert modules.copy(dataclasses.replace(later, missing=('numpy',))) is None


@pytest.mark.parametrize('changes', [
    {'python': (3, 9)}, {'architecture': 'riscv64'}, {'libc': 'glibc 2.17'}, {'libc': ' '}])
def test_only_modules_that_run_there_are_copied(changes: dict[str, object]) -> None:
    assert modules.copy(dataclasses.replace(HERE, **changes)) is None  # type: ignore[arg-type]


def test_equal_needs_share_a_folder() -> None:
    one = modules.folder('/home/a', HERE, ['av 18'])
    assert one.startswith('/home/a/.local/share/fogros2/modules-')
    assert one == modules.folder('/home/a', HERE, ['av 18'])
    less = dataclasses.replace(HERE, missing=('av',))
    assert len({one, modules.folder('/home/a', HERE, ['av 17']),
                modules.folder('/home/a', less, ['av 18'])}) == 3


@pytest.mark.parametrize('output', ['', 'bash: python3: command not found', '[1]', '{}'])
def test_machine_without_python_is_reported(output: str) -> None:
    with pytest.raises(PrerequisiteError, match='no Python of the machine'):
        modules.answer(output)


def test_module_that_is_too_old_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    names = modules.needed_by([('image_transport_h264', 'encoder')])
    assert modules.lacking_here(names) == []
    monkeypatch.setattr(modules, '_installed', lambda name: SimpleNamespace(version='11.0.0'))
    assert [module.name for module in modules.lacking_here(names)] == ['av']


@pytest.mark.parametrize('version, missing', [
    ('0.29.9', ('foxglove',)), ('0.30.0', ()), ('1.0', ()), ('', ('foxglove',))])
def test_machine_reports_missing_and_old_modules(
    tmp_path: Path, version: str, missing: tuple[str, ...],
) -> None:
    if version:
        (tmp_path / 'foxglove.py').write_text(f'__version__ = {version!r}\n')
    variables = {'PYTHONPATH': str(tmp_path), 'PATH': '/usr/bin:/bin'}
    command = modules.ask(['foxglove'], variables, [])
    said = subprocess.run(command.argv, input=command.input.decode(), check=True, text=True,
                          stdout=subprocess.PIPE).stdout
    assert modules.answer(said).missing == missing

# SPDX-License-Identifier: Apache-2.0
"""Modules that programs import: looked for, brought, and found by these programs alone."""

from __future__ import annotations

import dataclasses
import hashlib
from importlib import metadata
import os
from pathlib import Path
import platform
import subprocess
import sys
import threading
from types import SimpleNamespace
from typing import Optional
import zipfile

import pytest

from fogros2 import locked, modules
from fogros2.bootstrap import RosInstall
from fogros2.deploy.equipping import Equipment
from fogros2.errors import PrerequisiteError
from fogros2.host import HostFacts
from fogros2.model import Endpoint, NodeSpec
from fogros2.report import step
from fogros2.shell.local import LocalShell
from fogros2.waiting import Timeouts

HERE = modules.Answer(
    (sys.version_info.major, sys.version_info.minor), platform.machine(),
    ' '.join(platform.libc_ver()), ('numpy', 'av', 'cv2'))


@pytest.mark.parametrize('programs, needed', [
    ([], ()), ([('fogros2_examples', 'talker')], ()), ([('my_robot', 'encoder')], ()),
    ([('fogros2_examples', 'talker'), ('image_transport_h264', 'decoder')],
     ('numpy', 'av', 'cv2')),
    ([('fogros2_examples', 'image_processor')], ('numpy', 'cv2')),
    ([('fogros2_examples', 'image_processor'), ('image_transport_h264', 'decoder')],
     ('numpy', 'av', 'cv2')),
    ([('fogros2_examples', 'camera'), ('fogros2', 'bridge')], ('numpy', 'cv2', 'foxglove'))])
def test_who_needs_what(programs: list[tuple[str, str]], needed: tuple[str, ...]) -> None:
    assert modules.needed_by(programs) == needed


def test_nodes_that_need_them_find_them_first_and_no_other_does(tmp_path: Path) -> None:
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


def test_what_is_here_can_be_copied_where_it_runs() -> None:
    copy = modules.copy(HERE)
    assert copy is not None
    ((folder, entries),) = copy.entries.items()
    assert {'numpy', 'av', 'cv2', 'av.libs'} <= set(entries)
    assert not {'..', 'bin', 'fogros2'} & set(entries)
    assert Path(folder, 'av', '__init__.py').is_file()
    some = modules.copy(dataclasses.replace(HERE, missing=('av',)))
    assert some is not None and 'av' in some.entries[folder] and 'cv2' not in some.entries[folder]


def installed_in(folder: Path, name: str, module: str) -> None:
    """Lay a pure Python distribution into a folder, as pip does."""
    info = folder / f'{name.replace("-", "_")}-99.dist-info'
    info.mkdir(parents=True)
    (folder / f'{module}.py').write_text(f"__version__ = '99'\nFOLDER = {str(folder)!r}\n")
    (info / 'METADATA').write_text(f'Metadata-Version: 2.1\nName: {name}\nVersion: 99\n')
    (info / 'WHEEL').write_text('Wheel-Version: 1.0\nTag: py3-none-any\n')
    (info / 'RECORD').write_text(f'{module}.py,,\n{info.name}/METADATA,,\n')


def test_what_is_compiled_for_later_pythons_too_can_be_copied_to_those() -> None:
    later = dataclasses.replace(HERE, python=(3, 99), missing=('cv2',))
    assert modules.copy(later) is not None
    assert modules.copy(dataclasses.replace(later, missing=('numpy',))) is None


@pytest.mark.parametrize('changes', [
    {'python': (3, 9)}, {'architecture': 'riscv64'}, {'libc': 'glibc 2.17'}, {'libc': ' '}])
def test_nothing_is_copied_that_would_not_run_there(changes: dict[str, object]) -> None:
    assert modules.copy(dataclasses.replace(HERE, **changes)) is None  # type: ignore[arg-type]


def test_one_need_has_one_folder() -> None:
    one = modules.folder('/home/a', HERE, ['av 18'])
    assert one.startswith('/home/a/.local/share/fogros2/modules-')
    assert one == modules.folder('/home/a', HERE, ['av 18'])
    less = dataclasses.replace(HERE, missing=('av',))
    assert len({one, modules.folder('/home/a', HERE, ['av 17']),
                modules.folder('/home/a', less, ['av 18'])}) == 3


@pytest.mark.parametrize('output', ['', 'bash: python3: command not found', '[1]', '{}'])
def test_a_machine_without_python_says_so(output: str) -> None:
    with pytest.raises(PrerequisiteError, match='no Python there'):
        modules.answer(output)


def test_one_that_is_too_old_is_lacking(monkeypatch: pytest.MonkeyPatch) -> None:
    assert modules.lacking_here(modules.IMAGES) == []
    monkeypatch.setattr(modules, '_installed', lambda name: SimpleNamespace(version='11.0.0'))
    assert [module.name for module in modules.lacking_here(modules.IMAGES)] == ['av']


@pytest.mark.parametrize('version, package, missing', [
    ('0.29.9', '', ('foxglove',)), ('0.30.0', '', ()), ('1.0', '', ()), ('', '', ('foxglove',)),
    ('', 'foxglove_bridge', ())])
def test_a_ros_package_may_stand_in_its_place(
    tmp_path: Path, version: str, package: str, missing: tuple[str, ...],
) -> None:
    if version:
        (tmp_path / 'foxglove.py').write_text(f'__version__ = {version!r}\n')
    index = tmp_path / 'share/ament_index/resource_index/packages'
    index.mkdir(parents=True)
    if package:
        (index / package).touch()
    variables = {'AMENT_PREFIX_PATH': f'/elsewhere:{tmp_path}', 'PYTHONPATH': str(tmp_path),
                 'PATH': '/usr/bin:/bin'}
    command = modules.ask(['foxglove'], variables, [])
    said = subprocess.run(command.argv, input=command.input.decode(), check=True, text=True,
                          stdout=subprocess.PIPE).stdout
    assert modules.answer(said).missing == missing


# --- on a machine: this computer, by its own shell ----------------------------------------------

@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """
    Return a machine whose PyAV can't be imported, and whose index is a folder.

    The last wheel that is put there is the one that is pinned.
    """
    monkeypatch.setattr(locked, 'FILE', tmp_path / 'locked.txt')
    locked.FILE.write_text(f"av==98.0 --hash=sha256:{64 * '0'}\n")
    broken, index = tmp_path / 'broken', tmp_path / 'index'
    broken.mkdir()
    (broken / 'av.py').write_text("raise OSError('libavcodec.so.60 is not there')\n")
    index.mkdir()
    ros = RosInstall('ros', ('ros2', 'launch'), (f'{tmp_path}/not there yet.sh',), {
        'PATH': f"{Path(sys.executable).parent}:{os.environ['PATH']}", 'PYTHONPATH': str(broken),
        'PIP_NO_INDEX': '1', 'PIP_FIND_LINKS': str(index)}, HostFacts(home=str(tmp_path)))
    told: list[object] = []
    job = SimpleNamespace(
        name='m', spec=SimpleNamespace(environment={}), timeouts=Timeouts(),
        cancel=threading.Event(), step=lambda name: step(told.append, 'm', name))
    return SimpleNamespace(ros=ros, job=job, index=index, told=told, home=tmp_path, broken=broken)


def wheel(index: Path, version: str, program: str = '') -> None:
    path = index / f'av-{version}-py3-none-any.whl'
    with zipfile.ZipFile(path, 'w') as archive:
        info = f'av-{version}.dist-info'
        archive.writestr('av/__init__.py', program or f"__version__ = '{version}'\n")
        archive.writestr(f'{info}/METADATA', f'Metadata-Version: 2.1\nName: av\n'
                                             f'Version: {version}\n')
        archive.writestr(f'{info}/WHEEL', 'Wheel-Version: 1.0\nRoot-Is-Purelib: true\n'
                                          'Tag: py3-none-any\n')
        archive.writestr(f'{info}/RECORD', '')
    locked.FILE.write_text(
        f'av=={version} --hash=sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}\n')


def equipped(machine: SimpleNamespace) -> tuple[NodeSpec, str]:
    """Return a decoder as it is started there, and what was said of its modules."""
    equipment = Equipment(machine.job, LocalShell(Endpoint('local'), name='m'), machine.ros)
    (node,) = equipment.fitted([NodeSpec('1', 'd', 'image_transport_h264', 'decoder')])
    return node, machine.told[-1].detail


def test_what_works_there_is_left_alone(machine: SimpleNamespace) -> None:
    (machine.broken / 'av.py').unlink()
    node, said = equipped(machine)
    assert node.prefix == () and said == 'there already'


@pytest.mark.parametrize('old', [None, "__version__ = '11.0.0'\n"])
def test_a_machine_of_another_kind_asks_its_index(
    machine: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, old: Optional[str],
) -> None:
    monkeypatch.setattr(modules, 'copy', lambda there: None)
    if old is not None:
        (machine.broken / 'av.py').write_text(old)
    for version in ('14.0.0', '99.2.0', '99.1.0'):
        wheel(machine.index, version)
    node, said = equipped(machine)
    assert said == 'av installed'
    (place,) = machine.home.glob('.local/share/fogros2/modules-*/site')
    assert (place / 'av' / '__init__.py').read_text() == "__version__ = '99.1.0'\n"
    assert not (place.parent / 'pip').exists() and str(place) in node.prefix[-2]
    # the next launch finds it
    again, said = equipped(machine)
    assert said == 'there from before' and again == node


def test_a_machine_that_can_not_have_them_says_what_to_do(
    machine: SimpleNamespace, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(modules, 'copy', lambda there: None)
    with pytest.raises(PrerequisiteError, match="'m' can't get av, .*") as caught:
        equipped(machine)
    assert 'pip install av' in caught.value.hint
    wheel(machine.index, '99.0', 'import a_library_that_is_not_there\n')
    with pytest.raises(PrerequisiteError, match="cannot be imported: No module named 'a_lib"):
        equipped(machine)
    assert not list(machine.home.glob('.local/share/fogros2/*')), 'it left what is of no use'


def test_modules_of_several_folders_are_sent_together(
    machine: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    (machine.broken / 'cv2.py').write_text("raise OSError('no libGL')\n")
    for name, module in (('av', 'av'), ('opencv-python', 'cv2')):
        installed_in(tmp_path / name, name, module)
    monkeypatch.setattr(modules, '_installed', lambda name: next(iter(
        metadata.distributions(name=name, path=[str(tmp_path / name)])), None))
    _node, said = equipped(machine)
    assert said == 'av, cv2 sent'
    (place,) = machine.home.glob('.local/share/fogros2/modules-*/site')
    assert {path.name for path in place.glob('*.py')} == {'av.py', 'cv2.py'}


@pytest.mark.parametrize('fault, hint', [
    ('libGL.so.1: cannot open shared object file: No such file', 'libgl1'),
    ('libodd.so.7: cannot open shared object file: No such file', 'apt-file search libodd.so.7'),
    ('odd', 'install them on the robot with pip')])
def test_import_that_fails_names_reason_and_remedy(
    machine: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, fault: str, hint: str,
) -> None:
    monkeypatch.setattr(modules, 'copy', lambda there: None)
    wheel(machine.index, '99.0', f'raise ImportError({fault!r})\n')
    with pytest.raises(PrerequisiteError, match=fault.split(':')[0]) as caught:
        equipped(machine)
    assert hint in caught.value.hint

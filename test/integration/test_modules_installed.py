# SPDX-License-Identifier: Apache-2.0
"""Modules that programs import are installed on a machine with pip, or copied there."""

from __future__ import annotations

import hashlib
from importlib import metadata
import os
from pathlib import Path
import sys
from types import SimpleNamespace

import pytest

from fogros2.deploy.steps.installing import Modules
from fogros2.errors import PrerequisiteError
from fogros2.host import locked, modules
from fogros2.host.bootstrap import RosInstall
from fogros2.host.inspection import HostFacts
from fogros2.model import Endpoint, MachineSpec, NodeSpec
from fogros2.shell.local import LocalShell
from rigs import deploying
from rigs.pip_site import wheel


def installed_in(folder: Path, name: str, module: str) -> None:
    """Lay a pure Python distribution into a folder, as pip does."""
    info = folder / f'{name.replace("-", "_")}-99.dist-info'
    info.mkdir(parents=True)
    (folder / f'{module}.py').write_text(f"__version__ = '99'\nFOLDER = {str(folder)!r}\n")
    (info / 'METADATA').write_text(f'Metadata-Version: 2.1\nName: {name}\nVersion: 99\n')
    (info / 'WHEEL').write_text('Wheel-Version: 1.0\nTag: py3-none-any\n')
    (info / 'RECORD').write_text(f'{module}.py,,\n{info.name}/METADATA,,\n')


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
    ros = RosInstall('ros', (f'{tmp_path}/not there yet.sh',), {
        'PATH': f"{Path(sys.executable).parent}:{os.environ['PATH']}", 'PYTHONPATH': str(broken),
        'PIP_NO_INDEX': '1', 'PIP_FIND_LINKS': str(index)}, HostFacts(home=str(tmp_path)))
    told: list[object] = []
    context, job = deploying.job(
        tmp_path / 'state', MachineSpec('m', 'fake'), report=told.append)
    job.shell = LocalShell(Endpoint('local'), name='m')
    return SimpleNamespace(ros=ros, context=context, job=job, index=index, told=told,
                           home=tmp_path, broken=broken)


def pin(index: Path, version: str, program: str = '') -> None:
    path = wheel(index, 'av', version, **{
        'av/__init__': program or f"__version__ = '{version}'\n"})
    locked.FILE.write_text(
        f'av=={version} --hash=sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}\n')


def equipped(machine: SimpleNamespace) -> tuple[NodeSpec, str]:
    """Return a decoder as it is started there, and what was said of its modules."""
    (node,) = Modules(machine.context, machine.job, machine.ros).fitted([
        NodeSpec('1', 'd', 'image_transport_h264', 'decoder')])
    return node, machine.told[-1].detail


def test_working_modules_are_left_alone(machine: SimpleNamespace) -> None:
    (machine.broken / 'av.py').unlink()
    node, said = equipped(machine)
    assert node.prefix == () and said == 'there already'


def test_machine_of_another_kind_uses_its_index(
    machine: SimpleNamespace, monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also for a module that is too old there."""
    monkeypatch.setattr(modules, 'copy', lambda there: None)
    (machine.broken / 'av.py').write_text("__version__ = '11.0.0'\n")
    for version in ('14.0.0', '99.2.0', '99.1.0'):
        pin(machine.index, version)
    node, said = equipped(machine)
    assert said == 'av installed'
    (place,) = machine.home.glob('.local/share/fogros2/modules-*/site')
    assert (place / 'av' / '__init__.py').read_text() == "__version__ = '99.1.0'\n"
    assert not (place.parent / 'pip').exists() and str(place) in node.prefix[-2]
    # the next launch finds it
    again, said = equipped(machine)
    assert said == 'there from before' and again == node


def test_failed_installation_has_a_remedy(
    machine: SimpleNamespace, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(modules, 'copy', lambda there: None)
    with pytest.raises(PrerequisiteError, match="'m' can't get av, .*") as caught:
        equipped(machine)
    assert 'pip install av' in caught.value.hint
    fault = 'libodd.so.7: cannot open shared object file: No such file'
    pin(machine.index, '99.0', f'raise ImportError({fault!r})\n')
    with pytest.raises(PrerequisiteError, match='cannot be imported: libodd.so.7') as caught:
        equipped(machine)
    assert 'apt-file search libodd.so.7' in caught.value.hint
    left = list(machine.home.glob('.local/share/fogros2/modules-*'))
    assert not left, 'it is of no use'


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

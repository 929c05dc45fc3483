# SPDX-License-Identifier: Apache-2.0
"""``ros2 doctor``: FogROS2's check and report, by ros2doctor's own classes where it is."""

from __future__ import annotations

from collections.abc import Iterator
import importlib
from importlib import metadata, util
import sys
from types import ModuleType
from typing import Any
import warnings

import pytest

from ros2fog_cli.api import doctor

CHECKS = (doctor.Check('one', 'ok', 'is there', 'nothing to do'),
          doctor.Check('two', 'warning', 'is old', 'get a newer one'),
          doctor.Check('three', 'failed', 'is away', 'get one'))


class Counted:
    """ros2doctor's Result, Report and bases, as much as they do."""

    def __init__(self, name: str = '') -> None:
        self.name = name
        self.error = self.warning = 0
        self.items: list[tuple[str, str]] = []

    def add_error(self) -> None:
        self.error += 1

    def add_warning(self) -> None:
        self.warning += 1

    def add_to_report(self, item_name: str, item_info: str) -> None:
        self.items.append((item_name, item_info))


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return the module under test, loaded anew, on ros2doctor or what stands for it."""
    if util.find_spec('ros2doctor') is None:
        api, form = ModuleType('ros2doctor.api'), ModuleType('ros2doctor.api.format')
        vars(api).update(DoctorCheck=object, DoctorReport=object, Report=Counted, Result=Counted)
        vars(form).update(doctor_warn=warnings.warn,
                          doctor_error=lambda text: warnings.warn(
                              f'ERROR: {text}', stacklevel=2))
        for name, one in (('ros2doctor', ModuleType('ros2doctor')), ('ros2doctor.api', api),
                          ('ros2doctor.api.format', form)):
            monkeypatch.setitem(sys.modules, name, one)
    monkeypatch.setattr(doctor, 'examine', lambda **asked: list(CHECKS))
    sys.modules.pop('ros2fog_cli.ros2doctor', None)
    yield importlib.import_module('ros2fog_cli.ros2doctor')
    del sys.modules['ros2fog_cli.ros2doctor']


def test_ros2_doctor_counts_and_reports_every_check(module: Any) -> None:
    check = module.FogCheck()
    with pytest.warns(UserWarning) as said:
        result = check.check()
    assert (result.error, result.warning) == (1, 1)
    assert [str(one.message) for one in said] == [
        'FogROS2, two: is old (get a newer one)', 'ERROR: FogROS2, three: is away (get one)']
    assert check.category() == module.FogReport().category() == 'fogros2'
    report = module.FogReport().report()
    assert report.name == 'FOGROS2'
    assert report.items == [
        ('one', 'ok: is there'), ('two', 'warning: is old (get a newer one)'),
        ('three', 'failed: is away (get one)')]


@pytest.mark.parametrize('group, name', [
    ('ros2doctor.checks', 'FogCheck'), ('ros2doctor.report', 'FogReport')])
def test_ros2_doctor_finds_check_and_report(module: Any, group: str, name: str) -> None:
    (point,) = [one for one in metadata.entry_points(group=group) if one.name == name]
    assert point.load() is getattr(module, name)

# SPDX-License-Identifier: Apache-2.0
"""What the check of a cloud account asks and says, without a cloud."""

from __future__ import annotations

from decimal import Decimal
import importlib.util
from pathlib import Path
import subprocess
import sys
from types import ModuleType

import pytest

from fogros2.model import Machine, MachineSpec, MachineState
from fogros2.provider import TAG_NAME
from fogros2_testing.fakes import FakeProvider

PROGRAM = Path(__file__).resolve().parents[2] / 'tools' / 'cloud_check.py'


@pytest.fixture
def check() -> ModuleType:
    spec = importlib.util.spec_from_file_location('cloud_check', PROGRAM)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(('answer', 'begins'), [
    ('yes', True), ('y', False), ('no', False), ('', False), (EOFError, False),
    (KeyboardInterrupt, False)])
def test_only_a_whole_yes_at_the_terminal_begins(check, monkeypatch, answer, begins):
    def asked(prompt):
        if isinstance(answer, str):
            return answer
        raise answer

    monkeypatch.delenv('YES', raising=False)
    monkeypatch.setattr('sys.stdin.isatty', lambda: True, raising=False)
    monkeypatch.setattr('builtins.input', asked)
    assert check.agreed() is begins


def test_without_a_terminal_only_the_variable_begins(check, monkeypatch, capsys):
    monkeypatch.delenv('YES', raising=False)
    monkeypatch.setattr('sys.stdin.isatty', lambda: False, raising=False)
    assert not check.agreed() and 'YES=1' in capsys.readouterr().out
    monkeypatch.setenv('YES', '1')
    assert check.agreed()


@pytest.mark.parametrize(('price', 'words'), [
    (Decimal('0.0208'), '$0.0208 an hour'), (None, 'names no price')])
def test_plan_has_the_machine_and_its_price(check, monkeypatch, capsys, price, words):
    monkeypatch.setattr(FakeProvider, 'cost_per_hour', lambda self, spec: price, raising=False)
    assert check.announce(FakeProvider(), MachineSpec('check-1', 'fake'), 'a pod') == price
    said = capsys.readouterr().out
    assert "creates 'check-1': a pod" in said and words in said


def test_machine_that_the_launch_left_is_deleted_and_named(check, monkeypatch):
    there = [Machine('fake-1', 'check-1', 'fake', MachineState.RUNNING)]
    asked = []

    class Cloud(FakeProvider):
        def find(self, tags):
            assert tags == {TAG_NAME: 'check-1'}
            return list(there)

    def delete(words, **more):
        asked.append(words)
        there.clear()

    monkeypatch.setattr(subprocess, 'run', delete)
    assert check.remaining(Cloud(), 'check-1') == []
    assert asked == [['ros2', 'fog', 'delete', 'check-1', '--yes']]
    there.append(Machine('fake-1', 'check-1', 'fake', MachineState.RUNNING))
    monkeypatch.setattr(subprocess, 'run', lambda words, **more: None)
    assert check.remaining(Cloud(), 'check-1') == there


def test_unknown_provider_is_refused():
    done = subprocess.run([sys.executable, str(PROGRAM), 'nowhere'], capture_output=True,
                          text=True)
    assert done.returncode == 2 and 'kubernetes' in done.stderr

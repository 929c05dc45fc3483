# SPDX-License-Identifier: Apache-2.0
"""The template of doc/developers/providers.md keeps the contract, and its tests run."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

import pytest

from fogros2.errors import ConfigurationError
from fogros2.model import MachineSpec

TEMPLATE = Path(__file__).resolve().parents[2] / 'doc' / 'provider_template'


def test_template_passes_its_contract_tests(tmp_path):
    result = subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', '--rootdir', tmp_path,
         TEMPLATE / 'test'], cwd=tmp_path, capture_output=True, text=True, timeout=120,
        env={**os.environ, 'PYTHONPATH': str(TEMPLATE), 'PYTHONDONTWRITEBYTECODE': '1'})
    assert result.returncode == 0, result.stdout
    assert result.stdout.startswith('.' * 19 + ' ')


def test_launch_files_can_name_the_template_s_machine(monkeypatch):
    monkeypatch.syspath_prepend(str(TEMPLATE))
    from fogros2_shelf.machines import ShelfInstance
    assert ShelfInstance(folder='/srv/shelf', name='planner').provider == 'shelf'
    with pytest.raises(ConfigurationError, match='folder=True has the wrong type'):
        ShelfInstance(folder=True, name='planner')


def test_cloud_template_checks_its_options(monkeypatch):
    monkeypatch.syspath_prepend(str(TEMPLATE))
    monkeypatch.setenv('MEADOW_TOKEN', 'token')
    from fogros2_meadow import MeadowProvider
    options = {'region': 'north', 'machine_types': ('large',)}
    MeadowProvider().check(MachineSpec('planner', 'meadow', options))
    with pytest.raises(ConfigurationError, match='no spot machines'):
        MeadowProvider().check(MachineSpec('planner', 'meadow', {**options, 'spot': True}))

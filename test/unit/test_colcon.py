# SPDX-License-Identifier: Apache-2.0
"""What ``colcon test`` runs: the quick part, unless it is told otherwise."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parents[2]
Source = pytest.Config.ArgsSource


@pytest.mark.parametrize(('prefix', 'source', 'quick'), [
    ('fogros2', Source.TESTPATHS, True), ('fogros2', Source.ARGS, False),
    (None, Source.TESTPATHS, False)])
def test_the_quick_part_is_for_colcon_that_names_no_test(
    prefix: str | None, source: Source, quick: bool,
) -> None:
    spec = importlib.util.spec_from_file_location('quick', ROOT / 'test' / 'conftest.py')
    assert spec and spec.loader
    conftest = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(conftest)
    config = SimpleNamespace(
        getoption={'junitprefix': prefix}.get, args_source=source, args=['test'], rootpath=ROOT)
    conftest.pytest_configure(config)
    if quick:
        assert all(Path(folder).is_dir() for folder in config.args) and len(config.args) == 3
        assert not any('integration' in folder for folder in config.args)
    else:
        assert config.args == ['test']

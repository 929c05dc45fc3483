# SPDX-License-Identifier: Apache-2.0
"""What colcon takes from the tree: one version, and the quick part of the tests."""

from __future__ import annotations

import importlib.util
from pathlib import Path
import re
from types import SimpleNamespace
import xml.etree.ElementTree as ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[2]
Source = pytest.Config.ArgsSource


def test_all_files_have_the_same_version() -> None:
    version = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    assert version and re.fullmatch(r'\d+\.\d+\.\d+', version)
    for name in ('fogros2_examples', 'image_transport_h264', 'point_cloud_stream'):
        assert ElementTree.parse(ROOT / name / 'package.xml').findtext('version') == version
    assert f"\nVERSION = '{version}'\n" in (ROOT / 'ros2_embedded/setup.py').read_text()
    # the newest part of the change log
    (newest, *_) = re.findall(r'^(\d\S+)(?: \(.*\))?\n---', (ROOT / 'CHANGELOG.rst').read_text(),
                              re.MULTILINE)
    assert newest == version


def test_manifest_has_the_dependencies_of_the_packages_below() -> None:
    """Rosdep and colcon do not look below a package."""
    def of(path: Path) -> set[tuple[str | None, str | None]]:
        return {(found.text, found.get('condition'))
                for found in ElementTree.parse(path).iter('exec_depend')}

    below = [*ROOT.glob('*/package.xml')]
    own = {(path.parent.name, None) for path in below} | {('fogros2', None)}
    assert len(below) == 3
    assert set().union(*map(of, below)) - own <= of(ROOT / 'package.xml')


@pytest.mark.parametrize(('prefix', 'source', 'quick'), [
    ('fogros2', Source.TESTPATHS, True), ('fogros2', Source.ARGS, False),
    (None, Source.TESTPATHS, False)])
def test_colcon_without_arguments_runs_the_fast_tests(
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

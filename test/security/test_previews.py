# SPDX-License-Identifier: Apache-2.0
"""A preview of a launch file runs no command or call of it, wherever that is."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
import sys

from launch.launch_description_sources import get_launch_description_from_any_launch_file
import pytest
from ros2cli.cli import main

from ros2fog_cli.api.preview import Preview

COMMAND, CALL = "$(command 'touch {}')", "$(eval '__import__(\\'os\\').mkdir(\\'{}\\') or 1')"
#: Makes the file when it is imported.
MODULE = "$(eval '1' made)"


@pytest.fixture(params=[COMMAND, CALL, MODULE])
def code(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.syspath_prepend(tmp_path / 'modules')
    (tmp_path / 'modules').mkdir()
    (tmp_path / 'modules/made.py').write_text(f'open({str(tmp_path / "made")!r}, "w").close()')
    monkeypatch.delitem(sys.modules, 'made', raising=False)
    return str(request.param).format(tmp_path / 'made')


@pytest.fixture(params=[
    '<include file="{}"/>', '<include file="a$(var x {})"/>', '<arg name="a" default="{}"/>',
    '<let name="a" value="{}"/>', '<set_env name="a" value="{}"/>', '<executable cmd="{}"/>',
    '<node pkg="{}" exec="a"/>', '<node pkg="a" exec="a" if="{}"/>',
    '<node pkg="a" exec="a" if="$(not {})"/>',
    '<group unless="{}"><node pkg="a" exec="b"/></group>',
    '<fog_machine name="m" provider="container" image="{}"/>'])
def made(tmp_path: Path, request: pytest.FixtureRequest, code: str) -> Path:
    """Return the file that a command or a call of a launch file beside it would make."""
    path = tmp_path / 'made'
    content = request.param.format(code)
    (tmp_path / 'x.launch.xml').write_text(f'<launch>{content}</launch>')
    return path


def test_plan_runs_no_code_of_a_launch_file(made: Path) -> None:
    file = str(made.with_name('x.launch.xml'))
    list(Preview(get_launch_description_from_any_launch_file(file), {}).lines())
    assert not made.exists()


@pytest.mark.skipif(find_spec('ros2launch') is not None,
                    reason="ROS 2's own ros2launch evaluates the names of included files")
def test_launch_shows_a_file_and_runs_no_code_of_it(made: Path) -> None:
    for option in ('-s', '-p'):
        assert not main(argv=['launch', str(made.with_name('x.launch.xml')), option])
    assert not made.exists()

# SPDX-License-Identifier: Apache-2.0
"""A preview of a launch file runs no command of it, wherever the command is."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from launch.launch_description_sources import get_launch_description_from_any_launch_file
import pytest
from ros2cli.cli import main

from ros2fog_cli.api.preview import Preview


@pytest.fixture(params=[
    '<include file="{}"/>', '<include file="a$(var x {})"/>', '<arg name="a" default="{}"/>',
    '<let name="a" value="{}"/>', '<set_env name="a" value="{}"/>', '<executable cmd="{}"/>',
    '<node pkg="{}" exec="a"/>', '<node pkg="a" exec="a" if="{}"/>',
    '<node pkg="a" exec="a" if="$(not {})"/>',
    '<group unless="{}"><node pkg="a" exec="b"/></group>',
    '<fog_machine name="m" provider="container" image="{}"/>'])
def made(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Return the file that a command of a launch file beside it would make."""
    path = tmp_path / 'made'
    content = request.param.format(f"$(command 'touch {path}')")
    (tmp_path / 'x.launch.xml').write_text(f'<launch>{content}</launch>')
    return path


def test_plan_runs_no_command_of_a_launch_file(made: Path) -> None:
    file = str(made.with_name('x.launch.xml'))
    list(Preview(get_launch_description_from_any_launch_file(file), {}).lines())
    assert not made.exists()


@pytest.mark.skipif(find_spec('ros2launch') is not None,
                    reason="ROS 2's own ros2launch evaluates the names of included files")
def test_launch_shows_a_file_and_runs_no_command_of_it(made: Path) -> None:
    for option in ('-s', '-p'):
        assert not main(argv=['launch', str(made.with_name('x.launch.xml')), option])
    assert not made.exists()

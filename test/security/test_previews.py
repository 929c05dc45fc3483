# SPDX-License-Identifier: Apache-2.0
"""A preview of a launch file runs no command of it, wherever the command is."""

from __future__ import annotations

from pathlib import Path

from launch.launch_description_sources import get_launch_description_from_any_launch_file
import pytest

from ros2fog_cli.api.preview import Preview


@pytest.mark.parametrize('element', [
    '<include file="{}"/>', '<include file="a$(var x {})"/>', '<arg name="a" default="{}"/>',
    '<let name="a" value="{}"/>', '<set_env name="a" value="{}"/>', '<executable cmd="{}"/>',
    '<node pkg="{}" exec="a"/>', '<node pkg="a" exec="a" if="{}"/>',
    '<node pkg="a" exec="a" if="$(not {})"/>',
    '<group unless="{}"><node pkg="a" exec="b"/></group>',
    '<fog_machine name="m" provider="container" image="{}"/>'])
def test_preview_runs_no_command_of_a_launch_file(tmp_path: Path, element: str) -> None:
    made = tmp_path / 'made'
    file = tmp_path / 'x.launch.xml'
    file.write_text('<launch>' + element.format(f"$(command 'touch {made}')") + '</launch>')
    list(Preview(get_launch_description_from_any_launch_file(str(file)), {}).lines())
    assert not made.exists()

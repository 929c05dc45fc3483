# SPDX-License-Identifier: Apache-2.0
"""The applications' launch files: on a container, here, and what they differ by from a twin."""

from __future__ import annotations

import ast
from pathlib import Path
import shutil

from ament_index_python.packages import get_package_share_directory
import pytest

from fogros2.testing.launched import launching

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]


@pytest.fixture(autouse=True)
def surroundings(tmp_path, monkeypatch):
    """Keep what launch logs out of the user's home, and others' nodes out of the test."""
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    monkeypatch.setenv('ROS_DOMAIN_ID', '57')


@pytest.fixture
def launch():
    with launching() as start:
        yield start


def launch_file(name):
    return Path(get_package_share_directory('fogros2_examples'), 'launch', f'{name}.launch.py')


def twin(source):
    """
    Return a launch file without what is about machines: plain nodes, all here.

    Of ``source``, arguments that only say where things run, machines and streams go.
    """
    lines = source.splitlines()
    gone = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module == 'fogros2':
            gone.append(node)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            first = node.args[0] if node.args else None
            if node.func.id == 'FogMachine' or (
                    node.func.id == 'DeclareLaunchArgument' and isinstance(first, ast.Constant)
                    and first.value in ('machine', 'foxglove', 'transport')):
                gone.append(node)
            elif node.func.id == 'CloudNode':
                gone += [word for word in node.keywords
                         if word.arg in ('machine', 'stream_topics')]
    for node in sorted(gone, key=lambda node: -node.lineno):
        head = lines[node.lineno - 1][:node.col_offset]
        tail = lines[node.end_lineno - 1][node.end_col_offset:].lstrip(',').lstrip()
        rest = head + tail if head.strip() else tail and ' ' * node.col_offset + tail
        lines[node.lineno - 1:node.end_lineno] = [rest] if rest.strip() else []
    text = '\n'.join(lines) + '\n'
    imported = ('from launch import LaunchDescription\n'
                if 'import LaunchDescription' not in text else '')
    place = text.index('from launch')
    return text[:place] + imported + text[place:].replace(
        'FogROSLaunchDescription', 'LaunchDescription').replace('CloudNode', 'Node')


@pytest.mark.parametrize('name', ['planning'])
def test_a_launch_file_is_ten_lines_longer_than_its_twin_at_most(name, launch, tmp_path):
    source = launch_file(name).read_text()
    here = twin(source)
    assert 'fogros2 ' not in here.replace('fogros2_examples', '') and 'Cloud' not in here
    assert 0 < source.count('\n') - here.count('\n') <= 10
    path = tmp_path / 'twin.launch.py'
    path.write_text(here)
    # and it is one that launch takes
    shown = launch(str(path), '--show-args')
    assert shown.ended() == 0, shown.text
    assert 'machine' not in shown.text and "'picture'" in shown.text


@pytest.mark.parametrize('machine', ['container', 'robot'])
def test_motion_planning(machine, launch, tmp_path):
    drawn = tmp_path / 'planning.png'
    run = launch('fogros2_examples', 'planning.launch.py', f'machine:={machine}',
                 'environment:=cubicles', f'picture:={drawn}')
    assert run.ended() == 0, run.text
    assert run.errors == [] and 'WARNING' not in run.text, run.text
    assert 'path of ' in run.text
    assert ('[planner.motion_planner-1]' in run.text) == (machine == 'container')
    assert drawn.read_bytes().startswith(b'\x89PNG')


def test_a_launch_says_what_can_not_be_planned(launch, tmp_path):
    run = launch('fogros2_examples', 'planning.launch.py', 'machine:=robot', 'environment:=attic')
    assert run.ended() == 0 and 'exit code 2' in run.text
    assert "no environment is called 'attic': there are apartment, cubicles" in run.text

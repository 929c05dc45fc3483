# SPDX-License-Identifier: Apache-2.0
"""FogROS2 without any feature, cloud and cluster: an installation from which they are removed."""

from __future__ import annotations

from importlib import metadata
import os
from pathlib import Path
import re
import secrets
import shutil

import pytest

import fogros2
from rigs.launched import launching, ros2

pytestmark = pytest.mark.usefixtures('nothing_left')

KEPT = ('fogros2', 'ros2fog_cli', 'fogros2_examples')
FEATURES = ('fogros2_features', 'fogros2_monitor', 'fogros2_replicas', 'fogros2_share',
            'image_transport_h264', 'point_cloud_stream')
CLOUDS = ('fogros2.provider.aws', 'fogros2.provider.azure', 'fogros2.provider.gcp',
          'fogros2.provider.kubernetes', 'fogros2.shell.kubernetes', 'fogros2.kubernetes_client',
          'fogros2.describe.machines_cloud')
LAUNCH_FILE = """
from launch import LaunchDescription
from launch.actions import Shutdown
from launch_ros.actions import Node
from fogros2 import CloudNode, ContainerInstance

def generate_launch_description():
    machine = ContainerInstance(name='{name}'{keywords})
    return LaunchDescription([
        CloudNode(package='fogros2_examples', executable='talker', machine=machine),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{{'count': 2}}], on_exit=Shutdown())])
"""


@pytest.fixture
def alone(tmp_path: Path) -> dict[str, str]:
    """Return the variables for an installation of the core."""
    site, packages = tmp_path / 'site', Path(fogros2.__file__).parents[1]
    for name in KEPT:
        shutil.copytree(packages / name, site / name,
                        ignore=shutil.ignore_patterns('__pycache__'))
    for name in CLOUDS:
        path = site.joinpath(*name.split('.'))
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.with_suffix('.py').unlink()
    for name in FEATURES:  # before those of the whole installation
        (site / name).mkdir()
        (site / name / '__init__.py').write_text(f'raise ImportError({name!r})\n')
    whole, info = metadata.distribution('fogros2'), site / 'fogros2-0.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text(whole.read_text('METADATA') or '')
    gone = re.compile(rf"= *({'|'.join(map(re.escape, FEATURES + CLOUDS))})\b")
    (info / 'entry_points.txt').write_text('\n'.join(
        line for line in (whole.read_text('entry_points.txt') or '').splitlines()
        if not gone.search(line)))
    paths = filter(None, (str(site), os.environ.get('PYTHONPATH')))
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(paths),
            'ROS_LOG_DIR': str(tmp_path / 'log')}


def test_the_core_alone_runs_a_talker_on_a_container(
    alone: dict[str, str], engine: str, tmp_path: Path,
) -> None:
    file = tmp_path / 'talker.launch.py'
    name = f'alone-{secrets.token_hex(3)}'
    with launching() as start:
        file.write_text(LAUNCH_FILE.format(name=name, keywords=', idle_timeout=60'))
        refused = start(str(file), environment=alone)
        assert refused.ended() == 1
        assert "ContainerInstance has no attribute 'idle_timeout'" in refused.text
        file.write_text(LAUNCH_FILE.format(name=name, keywords=''))
        run = start(str(file), environment=alone)
        assert run.ended() == 0, run.text
    assert name not in ros2('fog', 'list', environment=alone).stdout
    assert run.text.count('I heard: [Hello World') >= 2
    assert run.clean, run.text

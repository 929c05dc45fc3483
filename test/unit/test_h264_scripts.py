# SPDX-License-Identifier: Apache-2.0
"""What the nodes' programs say where modules or images are missing."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize('role', ['encoder', 'decoder'])
def test_a_missing_module_is_one_line(tmp_path: Path, role: str) -> None:
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    (tmp_path / 'av.py').write_text("raise ModuleNotFoundError('none', name='av')\n")
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get('PYTHONPATH', '')])
    done = subprocess.run(
        [sys.executable, str(ROOT / 'image_transport_h264/scripts' / role)], timeout=30,
        env={**os.environ, 'PYTHONPATH': path}, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith('av is not installed here: pip install av')
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize('topic, named, warning', [
    ('/camera/imag_raw', '/camera/imag_raw',
     'no images on /camera/imag_raw (did you mean /camera/image_raw?)'),
    ('/fogros2/m/camera/imge_raw', '/camera/imge_raw',
     'no images on /camera/imge_raw (did you mean /camera/image_raw?)'),
    # neither what nobody publishes, nor other types, nor the streams' own copies
    ('/slam/lidar', '/slam/lidar', 'no images on /slam/lidar'),
    ('/camera/image_raw', '/camera/image_raw', None)])
def test_mistyped_topic_is_reported(topic: str, named: str, warning: str | None) -> None:
    encoder = pytest.importorskip('image_transport_h264.encoder', reason='needs rclpy and PyAV')
    image, lines = 'sensor_msgs/msg/Image', []
    graph = {'/camera/image_raw': (image, 1), '/fogros2/slam/lidar': (image, 1),
             '/lidars': ('sensor_msgs/msg/PointCloud2', 1), '/lidar_': (image, 0)}
    encoder.EncoderNode._look_for_images(SimpleNamespace(
        _look=SimpleNamespace(cancel=lambda: None), get_logger=lambda: SimpleNamespace(
            warning=lines.append),
        count_publishers=lambda name: graph.get(name, ('', 0))[1],
        get_topic_names_and_types=lambda: [(name, [kind]) for name, (kind, _) in graph.items()],
    ), topic, named)
    assert lines == [warning] * bool(warning)

# SPDX-License-Identifier: Apache-2.0
"""FogROS2's own launch file for Google Cloud, launched where it lies."""

from __future__ import annotations

from rigs.clouds import Gcp, Robot
from rigs.launched import launching

CLOUDS = ('gcp',)


def test_fogros2s_talker_gcp_runs_byte_for_byte(upstream, box, tmp_path):
    # a box of its own: the file names its project
    file = upstream / 'FogROS2/fogros2_examples/launch/talker.gcp.launch.py'
    cloud = Gcp('shade-prod')
    with cloud.open() as box, launching() as start:
        robot = Robot(cloud, box, tmp_path, start)
        run = robot.launch(str(file))
        run.wait_for('I heard: [Hello World from ')
        (instance,) = box.alive()
        assert (instance.zone[:-2], instance.type) == ('us-central1', 'e2-medium')
        run.interrupt()
        assert run.ended() == 0, run.text
        assert run.errors == [] and 'Traceback' not in run.text, run.text
        assert box.things() == {}

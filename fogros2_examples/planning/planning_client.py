# SPDX-License-Identifier: Apache-2.0
"""
Request motion plans, and measure their time: publish a scene on ``environment``, call ``plan``.

The node shows the result: the path on ``path``, the body along the path on ``motion``, and a
picture on ``picture`` and in a file.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path as File
import time
from typing import Any, Optional

import cv2
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
import numpy
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from fogros2_examples.files import PICTURES
from fogros2_examples.meshes import Floats
from fogros2_examples.nodes import LATCHED, run, until
from fogros2_examples.parameters import within, writable
from fogros2_examples.planning.app_files import loaded
from fogros2_examples.planning.messages import (
    COLOURS,
    mesh_marker,
    pose_message,
    pose_of,
    scene_message,
)
from fogros2_examples.planning.picture import picture, spaced
from fogros2_examples.planning.scene import MADE, Scene
from fogros2_examples.slam.messages import image


class PlanningClient(Node):
    """
    The client.

    Parameters: ``environment``, 'apartment', 'cubicles', or a file of OMPL.app (``.cfg``);
    ``count``, number of plans, 0 for no end; ``picture``, a PNG file to write, '' for none;
    ``time``, time-out of a plan in s; ``wait``, further time-out of the answer and of the
    planner's start in s; ``figures``, a file for the times of each plan, as lines of JSON.
    """

    def __init__(self) -> None:
        super().__init__('planning_client')
        self.environment = str(self.declare_parameter('environment', 'apartment').value)
        self.count = within(self, 'count', 1, 0)
        self.picture = writable(self, 'picture', PICTURES)
        self.figures = writable(self, 'figures')
        self.seconds = within(self, 'time', 30.0, 0.1)
        self.wait = within(self, 'wait', 120.0, 0.1)
        self.told: Optional[DiagnosticStatus] = None
        self.scenes = self.create_publisher(MarkerArray, 'environment', LATCHED)
        self.paths = self.create_publisher(Path, 'path', LATCHED)
        self.motions = self.create_publisher(MarkerArray, 'motion', LATCHED)
        self.pictures = self.create_publisher(Image, 'picture', LATCHED)
        self.create_subscription(DiagnosticStatus, 'planning_status', self.hear, LATCHED)
        self.planner = self.create_client(GetPlan, 'plan')

    def hear(self, status: DiagnosticStatus) -> None:
        """Store the planner's status."""
        self.told = status

    def run(self) -> int:
        """Request all plans, and return the exit status: 0 if all paths were found."""
        scene = MADE[self.environment]() if self.environment in MADE else (
            loaded(File(self.environment)))
        self.scenes.publish(scene_message(scene))
        if not until(self, lambda: self.told is not None and self.told.hardware_id == scene.name,
                     self.wait):
            self.get_logger().fatal(f'no planner took the environment in {self.wait:g} s')
            return 2
        solved, path = 0, numpy.empty((0, 7))
        for number in range(self.count) if self.count else itertools.count():
            answer = self._plan(scene, number)
            if len(answer):
                solved, path = solved + 1, answer
                if not self.count:
                    self._show(scene, path)
        if solved and not self._show(scene, path):
            return 1
        return 0 if solved == self.count else 1

    def _plan(self, scene: Scene, number: int) -> Floats:
        request = GetPlan.Request()
        for name, pose in (('start', scene.start), ('goal', scene.goal)):
            stamped = PoseStamped(pose=pose_message(pose))
            stamped.header.frame_id = scene.name
            setattr(request, name, stamped)
        self.told = None
        begin = time.monotonic()
        future = self.planner.call_async(request)
        until(self, future.done, self.seconds + self.wait)
        total = time.monotonic() - begin
        until(self, lambda: self.told is not None, 5.0)
        response = future.result() if future.done() else None
        path = numpy.array([pose_of(stamped.pose) for stamped in response.plan.poses]
                           if response else []).reshape(-1, 7)
        figures: dict[str, Any] = {'plan': number, 'total': total, 'found': bool(len(path))}
        if self.told is not None:
            figures |= {value.key: float(value.value) for value in self.told.values
                        if value.key != 'end'}
            self.get_logger().info(
                f'{self.told.message}; {total:.3f} s with the way there and back')
        else:
            self.get_logger().error(f'no answer in {self.seconds + self.wait:g} s')
        if self.figures:
            with open(self.figures, 'a') as file:
                file.write(json.dumps(figures) + '\n')
        if response:
            self.paths.publish(response.plan)
        return path

    def _show(self, scene: Scene, path: Floats) -> bool:
        """Publish a path and its pictures; return False if the file could not be written."""
        apart = float(numpy.linalg.norm(scene.high - scene.low)) / 14
        self.motions.publish(MarkerArray(markers=[
            mesh_marker(scene.body, 'motion', number, scene.name, pose_message(pose),
                        COLOURS['body']) for number, pose in enumerate(spaced(path, apart))]))
        length = float(numpy.linalg.norm(numpy.diff(path[:, :3], axis=0), axis=1).sum())
        drawn = picture(scene, path, f'{scene.name}: a path of {length:.1f}')
        self.pictures.publish(image(Header(), drawn, 'bgr8'))
        if self.picture and not cv2.imwrite(self.picture, drawn):
            self.get_logger().error(f'{self.picture} can not be written')
            return False
        if self.picture:
            self.get_logger().info(f'wrote {self.picture}')
        return True


def main() -> None:
    """Request all plans; exit at once on an invalid parameter."""
    run('planning_client', PlanningClient, PlanningClient.run)

# SPDX-License-Identifier: Apache-2.0
"""
Plan grasps from depth images: image on ``depth``, ranked grasps on ``grasps``.

The node answers each image once, with the image's stamp: poses on ``grasps`` (none if there is no
grasp), poses with qualities on ``grasp_markers``, and the result on ``grasp_status``.
"""

from __future__ import annotations

import time
from typing import Optional

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseArray
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from visualization_msgs.msg import MarkerArray

from fogros2_examples.grasp.antipodal import Grasp, Gripper, plan
from fogros2_examples.grasp.messages import depth_of, grasp_messages
from fogros2_examples.grasp.surface import surface
from fogros2_examples.nodes import LATCHED, run


class GraspPlanner(Node):
    """
    The planner.

    Parameters: ``samples``, pairs of points to try; ``perturbed``, perturbations of each grasp;
    ``count``, maximum number of grasps; ``friction`` and ``opening`` (m) of the gripper.
    """

    def __init__(self) -> None:
        super().__init__('grasp_planner')
        self.samples = int(self.declare_parameter('samples', 1500).value)
        self.perturbed = int(self.declare_parameter('perturbed', 40).value)
        self.count = int(self.declare_parameter('count', 12).value)
        self.gripper = Gripper(
            opening=float(self.declare_parameter('opening', Gripper.opening).value),
            friction=float(self.declare_parameter('friction', Gripper.friction).value))
        self.info: Optional[CameraInfo] = None
        self.waiting: Optional[Image] = None
        self.poses = self.create_publisher(PoseArray, 'grasps', 10)
        self.markers = self.create_publisher(MarkerArray, 'grasp_markers', 10)
        self.status = self.create_publisher(DiagnosticStatus, 'grasp_status', LATCHED)
        self.create_subscription(CameraInfo, 'camera_info', self.learn, 10)
        self.create_subscription(Image, 'depth', self.see, 2)
        self.tell(DiagnosticStatus.OK, 'waiting for depth images', {})

    def learn(self, info: CameraInfo) -> None:
        """Store the CameraInfo, which may arrive after the first image."""
        self.info = info
        if self.waiting is not None:
            image, self.waiting = self.waiting, None
            self.see(image)

    def see(self, image: Image) -> None:
        """Answer an image with grasps."""
        if self.info is None:
            self.waiting = image
            return
        begin = time.monotonic()
        grasps: list[Grasp] = []
        try:
            depth = depth_of(image)
            k = self.info.k
            if (self.info.height, self.info.width) != depth.shape or not (k[0] > 0 and k[4] > 0):
                raise ValueError(f'camera_info is of {self.info.width}x{self.info.height} pixels, '
                                 f'the image has {image.width}x{image.height}'
                                 if k[0] > 0 and k[4] > 0 else 'camera_info has no focal length')
            seen = surface(depth, (k[0], k[4]), (k[2], k[5]))
            grasps = plan(seen, self.gripper, samples=self.samples, perturbed=self.perturbed,
                          count=self.count)
            text = f'{len(grasps)} grasps, the best of quality {grasps[0].quality:.2f}'
            level = DiagnosticStatus.OK
        except ValueError as error:
            text, level = f'no grasp: {error}', DiagnosticStatus.WARN
        seconds = time.monotonic() - begin
        poses, markers = grasp_messages(grasps, image.header)
        stamp = image.header.stamp
        self.tell(level, f'{text}; {seconds:.2f} s', {
            'stamp': f'{stamp.sec}.{stamp.nanosec:09d}', 'seconds': f'{seconds:.6f}'})
        self.markers.publish(markers)
        self.poses.publish(poses)

    def tell(self, level: bytes, message: str, figures: dict[str, str]) -> None:
        """Log a result, and publish it as status."""
        # Separate calls, because rclpy allows only one severity per call site.
        if level == DiagnosticStatus.OK:
            self.get_logger().info(message)
        else:
            self.get_logger().warning(message)
        self.status.publish(DiagnosticStatus(
            level=level, name='grasp_planner', message=message,
            values=[KeyValue(key=key, value=value) for key, value in figures.items()]))


def main() -> None:
    """Run until interrupted."""
    run('grasp_planner', GraspPlanner)

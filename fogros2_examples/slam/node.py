# SPDX-License-Identifier: Apache-2.0
"""
Run visual SLAM as a node.

The node subscribes to ``camera/image`` with ``camera/camera_info``. For depths it takes either
``camera/depth``, or ``camera/right/image`` with its ``camera_info``, with the same stamps. With
the stamp of the image it publishes ``pose``, ``/tf``, and ``computing``, the computing time. It
also publishes ``slam_state``, and, as the map grows, ``path`` and the point cloud ``map_points``.
The world's frame is ``map``; the camera's frame is the image's.
"""

from __future__ import annotations

from functools import partial
import os
from pathlib import Path
import time
from typing import Any, Optional

from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Path as PathMessage
import numpy
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, TimeReference
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

from fogros2_examples.nodes import LATCHED, run
from fogros2_examples.slam import messages, stored
from fogros2_examples.slam.tracking import Slam, State, Tracked

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # it is not part of the smallest ROS 2
    TFMessage = None

#: Only the newest images, so that a slow node is late by one image instead of many.
NEWEST = QoSProfile(depth=2)
#: Images to keep until a frame's other image arrives, and images without one until a warning.
WAITING, ALONE = 8, 30


class SlamNode(Node):
    """
    The SLAM node.

    Parameters: ``features`` per image; ``map_frame``; ``best_effort``, for cameras that publish
    with best effort; ``map_folder``, from which a map is read, and to which the service
    ``~/checkpoint`` and the end of the node save it.
    """

    def __init__(self) -> None:
        super().__init__('slam')
        self.features = int(self.declare_parameter('features', 1000).value)
        self.map_frame = str(self.declare_parameter('map_frame', 'map').value)
        newest = NEWEST
        if self.declare_parameter('best_effort', False).value:
            newest = QoSProfile(
                depth=NEWEST.depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.slam: Optional[Slam] = None
        folder = os.path.expandvars(str(self.declare_parameter('map_folder', '').value))
        self.file = Path(folder, 'map.npz') if folder else None
        if self.file:
            self.create_service(Trigger, '~/checkpoint', self._checkpoint)
        self.infos: dict[str, CameraInfo] = {}
        self.halves: dict[str, dict[int, Image]] = {'image': {}, 'depth': {}, 'right': {}}
        self.alone = 0
        self.reported = ''
        self.changed = False
        self.frame = ''
        self.poses = self.create_publisher(PoseStamped, 'pose', 10)
        self.transforms = TFMessage and self.create_publisher(TFMessage, '/tf', 10)
        self.times = self.create_publisher(TimeReference, 'computing', 10)
        self.states = self.create_publisher(String, 'slam_state', LATCHED)
        self.paths = self.create_publisher(PathMessage, 'path', LATCHED)
        self.clouds = self.create_publisher(PointCloud2, 'map_points', LATCHED)
        for half, topic in (('image', 'image'), ('depth', 'depth'), ('right', 'right/image')):
            self.create_subscription(
                Image, f'camera/{topic}', partial(self._take, half), newest)
        for half, topic in (('image', 'camera_info'), ('right', 'right/camera_info')):
            self.create_subscription(
                CameraInfo, f'camera/{topic}', partial(self._learn, half), newest)
        self.create_timer(1.0, self._show_map)
        self._say(State.STARTING, 'no image yet')

    def _learn(self, half: str, info: CameraInfo) -> None:
        self.infos[half] = info

    def _take(self, half: str, image: Image) -> None:
        """Keep an image until the other one with its stamp is there; then process both."""
        key = messages.nanoseconds(image.header.stamp)
        self.halves[half][key] = image
        other = 'right' if key in self.halves['right'] else 'depth'
        if key in self.halves['image'] and key in self.halves[other]:
            self._process(self.halves['image'][key], other, self.halves[other][key])
            self.alone = 0
            for waiting in self.halves.values():
                for old in [one for one in waiting if one <= key]:
                    del waiting[old]
        elif half == 'image':
            self.alone += 1
            if self.alone == ALONE:
                self._say(State.STARTING if self.slam is None else self.slam.state,
                          'neither a depth image nor a right one has the stamps of the images')
        while len(self.halves[half]) > WAITING:
            del self.halves[half][min(self.halves[half])]

    def _process(self, image: Image, other: str, second: Image) -> None:
        """Track a frame and publish its pose, then add the frame to the map."""
        begin = time.perf_counter()
        try:
            slam = self._algorithm(other)
            if slam is None:
                return
            grey = messages.grey(image)
            tracked = slam.track(
                messages.nanoseconds(image.header.stamp), grey,
                **({'right': messages.grey(second)} if other == 'right'
                   else {'depth': messages.depth(second)}))
        except ValueError as error:
            # An invalid message of a driver must not end the node: the next one may be valid.
            started = self.slam is not None and self.slam.state is not State.STARTING
            self._say(State.LOST if started else State.STARTING, str(error))
            return
        took = messages.time(round(1e9 * (time.perf_counter() - begin)))
        self.times.publish(TimeReference(header=image.header, time_ref=took, source='slam'))
        self._publish(image.header, tracked)
        self.changed = slam.extend(tracked) or self.changed or tracked.pose is not None
        self.frame = image.header.frame_id

    def _algorithm(self, other: str) -> Optional[Slam]:
        """Return the algorithm for this camera, None while the camera is unknown."""
        if self.slam is None:
            needed = other if other == 'right' else 'image'
            if 'image' not in self.infos or needed not in self.infos:
                self._say(State.STARTING, 'no camera info yet')
                return None
            self.slam = Slam(messages.camera(self.infos[needed], other == 'right'),
                             self.features)
            if self.file and self.file.exists():
                self.slam.resume(stored.load(self.slam.camera, self.file))
                self.get_logger().info(f'{len(self.slam.map.keyframes)} keyframes resumed')
        return self.slam

    def _checkpoint(self, request: object, response: Any) -> Any:
        response.success, response.message = True, ''
        try:
            self.save()
        except OSError as error:
            response.success, response.message = False, str(error)
        return response

    def save(self) -> None:
        """Write the map, if there is one and a folder for it."""
        if self.file and self.slam and self.slam.map.keyframes:
            stored.save(self.slam.map, self.file)

    def _publish(self, header: Header, tracked: Tracked) -> None:
        self._say(tracked.state, tracked.why)
        if tracked.pose is None:
            return
        map_header = Header(stamp=header.stamp, frame_id=self.map_frame)
        pose = messages.pose(tracked.pose)
        self.poses.publish(PoseStamped(header=map_header, pose=pose))
        transform = TransformStamped(header=map_header, child_frame_id=header.frame_id)
        at, to = pose.position, transform.transform.translation
        to.x, to.y, to.z = at.x, at.y, at.z
        transform.transform.rotation = pose.orientation
        if self.transforms:
            self.transforms.publish(TFMessage(transforms=[transform]))

    def _say(self, state: State, why: str) -> None:
        """Publish and log the state if it changed."""
        # Ignore numbers, which change with each image.
        text = f'{state.value}: {why}' if why else state.value
        kind = ''.join(letter for letter in text if not letter.isdigit())
        if kind != self.reported:
            self.reported = kind
            self.states.publish(String(data=text))
            if why and self.infos:
                self.get_logger().warning(text)
            else:
                self.get_logger().info(text)

    def _show_map(self) -> None:
        """Publish path and points if they changed; points only if there is a subscriber."""
        if not self.changed or self.slam is None:
            return
        self.changed = False
        track = self.slam.trajectory()
        if not track:
            return
        path = PathMessage()
        path.header.frame_id = self.map_frame
        for stamp, pose in track:
            stamped = PoseStamped(pose=messages.pose(pose))
            stamped.header.frame_id = self.map_frame
            stamped.header.stamp = messages.time(stamp)
            path.poses.append(stamped)
        path.header.stamp = path.poses[-1].header.stamp
        self.paths.publish(path)
        if self.clouds.get_subscription_count():
            points = self.slam.map.points(self.slam.map.keyframes).places
            self.clouds.publish(messages.cloud(path.header, numpy.asarray(points)))


def serve(node: SlamNode) -> None:
    """Run until a signal, then save the map."""
    try:
        rclpy.spin(node)
    finally:
        node.save()


def main() -> None:
    """Run until interrupted."""
    run('slam', SlamNode, serve)

# SPDX-License-Identifier: Apache-2.0
"""Convert between depth images, grasps and messages."""

from __future__ import annotations

import math

from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion, Vector3
import numpy
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from fogros2_examples.grasp.antipodal import Grasp
from fogros2_examples.slam.geometry import Camera
from fogros2_examples.slam.messages import camera_info, depth, DEPTHS, image


def depth_of(image: Image) -> NDArray[numpy.float32]:
    """
    Return the depths of an image, m, array (height, width); 0 or NaN means unknown.

    :raises ValueError: the encoding is none of depth, or the data do not fit the size.
    """
    values = depth(image)
    unit = 0.001 if values.dtype.kind == 'u' else 1.0  # REP 118
    return numpy.asarray(values * numpy.float32(unit), numpy.float32)


def depth_message(depths: NDArray[numpy.float32], encoding: str, header: Header) -> Image:
    """Return depths in m as an image message."""
    values = depths if encoding == '32FC1' else numpy.rint(1000 * depths)
    return image(header, values.astype(f'<{DEPTHS[encoding]}'), encoding)


def info_message(width: int, height: int, focal: float, header: Header) -> CameraInfo:
    """Return the CameraInfo of a pinhole camera with its axis in the middle of the image."""
    return camera_info(header, Camera(
        width, height, focal, focal, (width - 1) / 2, (height - 1) / 2), False)


def grasp_messages(grasps: list[Grasp], header: Header) -> tuple[PoseArray, MarkerArray]:
    """
    Return ranked grasps as poses, and as markers with their qualities.

    The position of a pose is between the finger tips. Its x axis is the line between the jaws, its
    z axis the direction of approach. A marker's ``id`` is the rank, its ``text`` the quality, its
    ``scale.x`` the width in m; its line connects the contacts.
    """
    poses = PoseArray(header=header)
    markers = MarkerArray(markers=[Marker(header=header, ns='grasps', action=Marker.DELETEALL)])
    for rank, grasp in enumerate(grasps):
        x, y, z = map(float, grasp.centre)
        pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(
            x=0.0, y=0.0, z=math.sin(grasp.angle / 2), w=math.cos(grasp.angle / 2)))
        poses.poses.append(pose)
        shade = float(min(1.0, max(0.0, grasp.quality)))
        markers.markers.append(Marker(
            header=header, ns='grasps', id=rank, type=Marker.LINE_LIST, action=Marker.ADD,
            pose=pose, scale=Vector3(x=grasp.width, y=0.0, z=0.0), text=f'{grasp.quality:.3f}',
            color=ColorRGBA(r=1 - shade, g=shade, b=0.1, a=1.0),
            points=[Point(x=-grasp.width / 2), Point(x=grasp.width / 2)]))
        markers.markers[-1].scale.x = grasp.width
    return poses, markers


def grasps_of(markers: MarkerArray) -> list[Grasp]:
    """Return the grasps of markers of ``grasp_messages``, in the same order."""
    return [Grasp(numpy.array([m.pose.position.x, m.pose.position.y, m.pose.position.z]),
                  2 * math.atan2(m.pose.orientation.z, m.pose.orientation.w),
                  m.scale.x, float(m.text))
            for m in markers.markers if m.action == Marker.ADD]

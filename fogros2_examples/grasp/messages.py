# SPDX-License-Identifier: Apache-2.0
"""Convert between depth images, grasps and messages."""

from __future__ import annotations

import array
import math

from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion, Vector3
import numpy
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from fogros2_examples.grasp.antipodal import Grasp

#: Encodings of depth: type of a pixel, and m per unit (REP 118).
ENCODINGS = {'16UC1': ('u2', 0.001), 'mono16': ('u2', 0.001), '32FC1': ('f4', 1.0)}


class BadImage(ValueError):
    """An image is no depth image; the text has the reason."""


def depth_of(image: Image) -> NDArray[numpy.float32]:
    """
    Return the depths of an image, m, array (height, width); 0 or NaN means unknown.

    :raises BadImage: the encoding is none of depth, or the data do not fit the size.
    """
    if image.encoding not in ENCODINGS:
        raise BadImage(f"'{image.encoding}' is no encoding of depth: it takes "
                       f"{', '.join(ENCODINGS)}")
    kind, unit = ENCODINGS[image.encoding]
    pixel = numpy.dtype(kind).newbyteorder('>' if image.is_bigendian else '<')
    if not image.width or not image.height or image.step < image.width * pixel.itemsize or (
            len(image.data) < image.step * image.height):
        raise BadImage(f'{len(image.data)} bytes are no image of {image.width}x{image.height} '
                       f'pixels and {image.step} bytes a row')
    rows = numpy.frombuffer(image.data, numpy.uint8)[:image.step * image.height].reshape(
        image.height, image.step)[:, :image.width * pixel.itemsize]
    values = numpy.ascontiguousarray(rows).view(pixel)
    return numpy.asarray(values * numpy.float32(unit), numpy.float32)


def depth_message(depth: NDArray[numpy.float32], encoding: str, header: Header) -> Image:
    """Return depths in m as an image message."""
    kind, unit = ENCODINGS[encoding]
    values = depth / unit
    pixels = (numpy.rint(values) if kind == 'u2' else values).astype(f'<{kind}')
    height, width = depth.shape
    return Image(header=header, height=height, width=width, encoding=encoding,
                 step=width * pixels.itemsize, data=array.array('B', pixels.tobytes()))


def info_message(width: int, height: int, focal: float, header: Header) -> CameraInfo:
    """Return the CameraInfo of a pinhole camera with its axis in the middle of the image."""
    x, y = (width - 1) / 2, (height - 1) / 2
    info = CameraInfo(header=header, width=width, height=height, distortion_model='plumb_bob',
                      d=[0.0] * 5)
    info.k = [focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0]
    info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    info.p = [focal, 0.0, x, 0.0, 0.0, focal, y, 0.0, 0.0, 0.0, 1.0, 0.0]
    return info


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

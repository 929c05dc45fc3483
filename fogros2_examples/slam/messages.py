# SPDX-License-Identifier: Apache-2.0
"""Convert between ROS messages and the data of the algorithm."""

from __future__ import annotations

import array
from typing import Optional

from builtin_interfaces.msg import Time
import cv2
from geometry_msgs.msg import Pose
import numpy
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from std_msgs.msg import Header

from fogros2_examples.letterbox import letterbox, Pixels
from fogros2_examples.slam.geometry import Array, Camera, from_quaternion, quaternion

#: Bytes of a pixel, and its conversions to grey and to RGB; None: there is nothing to convert.
_COLOURS = {'bgr8': (3, cv2.COLOR_BGR2GRAY, cv2.COLOR_BGR2RGB),
            'rgb8': (3, cv2.COLOR_RGB2GRAY, None),
            'bgra8': (4, cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2RGB),
            'rgba8': (4, cv2.COLOR_RGBA2GRAY, cv2.COLOR_RGBA2RGB),
            'mono8': (1, None, cv2.COLOR_GRAY2RGB), '8UC1': (1, None, cv2.COLOR_GRAY2RGB)}
#: Encodings of depth images, and types of their pixels.
DEPTHS = {'16UC1': 'u2', 'mono16': 'u2', '32FC1': 'f4'}


def grey(image: Image) -> Pixels:
    """
    Return the brightness of an image, (height, width).

    :raises ValueError: the encoding has no brightness, or the fields contradict each other.
    """
    channels, conversion = _colours(image, 0)
    pixels = _rows(image, channels)
    if conversion is None:
        return pixels
    return numpy.asarray(cv2.cvtColor(
        pixels.reshape(image.height, image.width, channels), conversion), numpy.uint8)


def rgb(image: Image, size: Optional[tuple[int, int]] = None) -> Pixels:
    """
    Return the colours of an image, (height, width, 3) of red, green, blue.

    :param size: width and height that the image is letterboxed to.
    :raises ValueError: the encoding has no brightness, or the fields contradict each other.
    """
    channels, conversion = _colours(image, 1)
    pixels = _rows(image, channels).reshape(image.height, image.width, channels)
    if size:
        # before the conversion, which then has fewer pixels
        pixels = letterbox(pixels, *size)
    return pixels if conversion is None else numpy.asarray(
        cv2.cvtColor(pixels, conversion), numpy.uint8)


def _colours(image: Image, which: int) -> tuple[int, Optional[int]]:
    """Return the channels of an image and its conversion, to grey or to RGB."""
    if image.encoding not in _COLOURS:
        raise ValueError(f"an image as '{image.encoding}': {', '.join(_COLOURS)} are for me")
    channels, *conversions = _COLOURS[image.encoding]
    return channels, conversions[which]


def depth(image: Image) -> NDArray[numpy.generic]:
    """
    Return a depth image, (height, width): millimetres as integer, or metres as float.

    :raises ValueError: the encoding is none of depth, or the fields contradict each other.
    """
    if image.encoding not in DEPTHS:
        raise ValueError(f"depth as '{image.encoding}': {', '.join(DEPTHS)} are for me")
    kind = numpy.dtype(DEPTHS[image.encoding]).newbyteorder('>' if image.is_bigendian else '<')
    return numpy.ascontiguousarray(_rows(image, kind.itemsize)).view(kind)


def _rows(image: Image, size: int) -> Pixels:
    data = numpy.frombuffer(image.data, numpy.uint8)
    if image.step < size * image.width or len(data) != image.height * image.step or not len(data):
        raise ValueError(f'an image of {image.width}x{image.height} in {len(data)} bytes, '
                         f'{image.step} a row')
    return data.reshape(image.height, image.step)[:, :size * image.width]


def image(header: Header, pixels: NDArray[numpy.generic], encoding: str) -> Image:
    """Return a message of an array (height, width) or (height, width, channels)."""
    # rclpy takes an array over as it is, and checks anything else byte by byte.
    return Image(
        header=header, height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
        step=pixels[0].nbytes, data=array.array('B', pixels.tobytes()))


def camera(info: CameraInfo, right: bool) -> Camera:
    """
    Return the camera that the info of a rectified image describes.

    :param right: whether this is the right camera of a pair, whose info has the baseline.
    :raises ValueError: the info has no focal length, or a right camera's info has no baseline.
    """
    p = info.p
    if p[0] <= 0 or p[5] <= 0:
        raise ValueError('the camera info has no focal length')
    made = Camera(info.width, info.height, p[0], p[5], p[2], p[6])
    if not right:
        return made
    if p[3] >= 0:
        raise ValueError("the right camera's info has no baseline: P[3] is to be -fx * baseline")
    return Camera(info.width, info.height, p[0], p[5], p[2], p[6], -p[3] / p[0])


def camera_info(header: Header, camera: Camera, right: bool) -> CameraInfo:
    """Return the message for a camera without distortion."""
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    shift = -camera.fx * camera.baseline if right else 0.0
    return CameraInfo(
        header=header, width=camera.width, height=camera.height, distortion_model='plumb_bob',
        d=[0.0] * 5, k=k, r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[*k[:3], shift, *k[3:6], 0.0, *k[6:], 0.0])


def pose(matrix: Array) -> Pose:
    """Return the message of a pose."""
    made = Pose()
    x, y, z, w = (float(value) for value in quaternion(matrix))
    made.position.x, made.position.y, made.position.z = (float(v) for v in matrix[:3, 3])
    made.orientation.x, made.orientation.y, made.orientation.z, made.orientation.w = x, y, z, w
    return made


def matrix(pose: Pose) -> Array:
    """Return the pose of a message."""
    at, turn = pose.position, pose.orientation
    return from_quaternion(numpy.array([at.x, at.y, at.z]),
                           numpy.array([turn.x, turn.y, turn.z, turn.w]))


def nanoseconds(stamp: Time) -> int:
    """Convert a stamp to nanoseconds."""
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def time(nanoseconds: int) -> Time:
    """Convert nanoseconds to a stamp."""
    return Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def cloud(header: Header, points: Array) -> PointCloud2:
    """Return points (N, 3) as a cloud of three floats each."""
    data = points.astype('<f4')
    return PointCloud2(
        header=header, height=1, width=len(data), point_step=12, row_step=12 * len(data),
        is_dense=True, data=array.array('B', data.tobytes()), fields=[
            PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
            for i, name in enumerate('xyz')])

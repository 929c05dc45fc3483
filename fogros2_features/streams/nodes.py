# SPDX-License-Identifier: Apache-2.0
"""
Transports by this project's own nodes: ``image_transport_h264`` and ``point_cloud_stream``.

doc/h264.md and doc/point_clouds.md describe their options.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from fogros2.model import NodeSpec
from fogros2_features.streams.topics import (
    carries_info,
    check_modules,
    DECODER_PARAMETERS,
    node,
    OPTIONS,
)
from fogros2_features.streams.transport import ImageTransport, Stream
from image_transport_h264.settings import BITRATE, ENCODERS, MAX_RATE, PRESETS, QUALITY

PRIORITY, BOOLEAN = (0.01, 100), (True, False)
#: Bytes of the largest message that ``image_transport_h264`` sends in slices.
LARGEST = 1 << 28


class Raw(ImageTransport):
    """Send ``/camera`` unencoded as ``/camera/raw``: for comparison, and for fast links."""

    camera_info = True
    options = OPTIONS
    numbers = {'priority': PRIORITY}
    choices = {'camera_info': BOOLEAN}
    #: The value of the nodes' parameter ``codec``, and the last part of the stream's topic.
    codec: ClassVar[str] = 'raw'

    def check(self) -> None:
        """Check for PyAV, OpenCV and NumPy."""
        check_modules()

    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the node that sends images."""
        return self._node(stream, 'encoder')

    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the node that receives images."""
        return self._node(stream, 'decoder')

    def _node(self, stream: Stream, role: str, codec: str = '') -> NodeSpec:
        return node(
            stream, role=role, name=self.codec, package='image_transport_h264', topic='image',
            options=DECODER_PARAMETERS,
            parameters={'codec': codec or self.codec, 'camera_info': carries_info(stream)})


class H264(Raw):
    """Send ``/camera`` as ``/camera/h264``."""

    codec = 'h264'
    options = OPTIONS | {'adapt', 'bitrate', 'encoder', 'gop', 'lossless', 'max_rate', 'preset',
                         'quality'}
    numbers = {'priority': PRIORITY, 'bitrate': BITRATE, 'gop': (1, 2 ** 31 - 1),
               'max_rate': MAX_RATE, 'quality': QUALITY}
    choices = {'camera_info': BOOLEAN, 'adapt': BOOLEAN, 'encoder': ENCODERS,
               'lossless': BOOLEAN, 'preset': PRESETS}


class Compressed(Raw):
    """
    Send ``/camera`` as ``/camera/fogros2/compressed``, in the format of ROS's own transport.

    The options are ``format`` (jpeg or png), and ``jpeg_quality`` (default 80).
    """

    codec = 'compressed'
    options = OPTIONS | {'format', 'jpeg_quality'}
    numbers = {'priority': PRIORITY, 'jpeg_quality': (1, 100)}
    choices = {'camera_info': BOOLEAN, 'format': ('jpeg', 'png')}

    def _node(self, stream: Stream, role: str, codec: str = '') -> NodeSpec:
        options = dict(stream.options)
        codec = options.pop('format', 'jpeg')
        if 'jpeg_quality' in options:
            options['jpeg_quality'] = int(options['jpeg_quality'])
        return super()._node(dataclasses.replace(stream, options=options), role, codec)


class PointCloud(Raw):
    """Send ``/points`` as ``/points/pointcloud``."""

    camera_info = False
    options = frozenset(
        'drop_fields lossless max_bytes max_rate priority resolution'.split())
    numbers = {'priority': PRIORITY, 'max_bytes': (1, LARGEST), 'max_rate': MAX_RATE,
               'resolution': (0, 1000)}
    choices = {'lossless': BOOLEAN}

    def check(self) -> None:
        """Check for NumPy and zstandard."""
        check_modules('point_cloud_stream', 'point clouds')

    def _node(self, stream: Stream, role: str, codec: str = '') -> NodeSpec:
        return node(
            stream, role=role, name='pointcloud', package='point_cloud_stream', topic='points',
            options=('max_bytes',), parameters={
                name: value for name, value in stream.options.items() if name == 'max_bytes'})

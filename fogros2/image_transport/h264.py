# SPDX-License-Identifier: Apache-2.0
"""Send images as H.264 by ``image_transport_h264``; doc/h264.md describes its options."""

from __future__ import annotations

from fogros2.image_transport import ImageTransport
from fogros2.image_transport.topics import check_modules, node, OPTIONS
from fogros2.model import NodeSpec, Stream


class H264(ImageTransport):
    """Send ``/camera`` as ``/camera/h264``."""

    camera_info = True
    options = OPTIONS | {'adapt', 'bitrate', 'encoder', 'gop', 'lossless', 'max_rate', 'preset',
                         'quality'}

    def check(self) -> None:
        """Check for PyAV, OpenCV and NumPy."""
        check_modules()

    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the encoder."""
        return node(stream, role='encoder', codec='h264', machine=stream.source, name='h264')

    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the decoder."""
        return node(stream, role='decoder', codec='h264', machine=stream.target, name='h264')

# SPDX-License-Identifier: Apache-2.0
"""H.264, through ``image_transport_h264``: see doc/h264.md for its options."""

from __future__ import annotations

from fogros2.image_transport import ImageTransport
from fogros2.image_transport.topics import check_modules, node, OPTIONS
from fogros2.model import NodeSpec, Stream


class H264(ImageTransport):
    """``/camera`` crosses as ``/camera/h264``."""

    camera_info = True
    options = OPTIONS | {'adapt', 'bitrate', 'encoder', 'gop', 'lossless', 'max_rate', 'preset',
                         'quality'}

    def check(self) -> None:
        """Look for PyAV, OpenCV and NumPy."""
        check_modules()

    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the encoder."""
        return node(stream, role='encoder', codec='h264', machine=stream.source, name='h264')

    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the decoder."""
        return node(stream, role='decoder', codec='h264', machine=stream.target, name='h264')

# SPDX-License-Identifier: Apache-2.0
"""Images as they are: for comparison, and for links that have room."""

from __future__ import annotations

from fogros2.image_transport import ImageTransport
from fogros2.image_transport.topics import check_modules, node, OPTIONS
from fogros2.model import NodeSpec, Stream


class Raw(ImageTransport):
    """``/camera`` crosses as ``/camera/raw``, while a subscriber is there."""

    camera_info = True
    options = OPTIONS

    def check(self) -> None:
        """Look for PyAV, OpenCV and NumPy."""
        check_modules()

    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the node that passes images on."""
        return node(stream, role='encoder', codec='raw', machine=stream.source, name='raw')

    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the node that takes them."""
        return node(stream, role='decoder', codec='raw', machine=stream.target, name='raw')

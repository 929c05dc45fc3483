# SPDX-License-Identifier: Apache-2.0
"""Send images unencoded: for comparison, and for fast links."""

from __future__ import annotations

from fogros2.image_transport import ImageTransport
from fogros2.image_transport.topics import check_modules, node, OPTIONS
from fogros2.model import NodeSpec, Stream


class Raw(ImageTransport):
    """Send ``/camera`` as ``/camera/raw``, while there is a subscriber."""

    camera_info = True
    options = OPTIONS

    def check(self) -> None:
        """Check for PyAV, OpenCV and NumPy."""
        check_modules()

    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the node that sends images."""
        return node(stream, role='encoder', codec='raw', machine=stream.source, name='raw')

    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the node that receives images."""
        return node(stream, role='decoder', codec='raw', machine=stream.target, name='raw')

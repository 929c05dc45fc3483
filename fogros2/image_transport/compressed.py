# SPDX-License-Identifier: Apache-2.0
"""Send each image as JPEG or PNG: options ``format``, and ``jpeg_quality`` (default 80)."""

from __future__ import annotations

import dataclasses

from fogros2.errors import ConfigurationError
from fogros2.image_transport import ImageTransport
from fogros2.image_transport.topics import check_modules, node, OPTIONS
from fogros2.model import NodeSpec, Stream


class Compressed(ImageTransport):
    """Send ``/camera`` as ``/camera/compressed``, like ROS's own transport of that name."""

    camera_info = True
    options = OPTIONS | {'format', 'jpeg_quality'}

    def check(self) -> None:
        """Check for PyAV, OpenCV and NumPy."""
        check_modules()

    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the encoder."""
        return self._node(stream, 'encoder', stream.source)

    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the decoder."""
        return self._node(stream, 'decoder', stream.target)

    def _node(self, stream: Stream, role: str, machine: str | None) -> NodeSpec:
        options = dict(stream.options)
        codec = options.pop('format', 'jpeg')
        if codec not in ('jpeg', 'png'):
            raise ConfigurationError(f"format '{codec}' of {stream.topic} is unknown",
                                     'there are jpeg and png')
        return node(dataclasses.replace(stream, options=options), role=role, codec=codec,
                    machine=machine, name='compressed')

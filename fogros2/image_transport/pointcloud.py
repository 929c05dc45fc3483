# SPDX-License-Identifier: Apache-2.0
"""Send point clouds by ``point_cloud_stream``; doc/point_clouds.md describes its options."""

from __future__ import annotations

from typing import Optional

from fogros2.host import modules
from fogros2.image_transport import ImageTransport
from fogros2.image_transport.topics import check_modules, python_node
from fogros2.model import NodeSpec, Stream


class PointCloud(ImageTransport):
    """Send ``/points`` as ``/points/pointcloud``."""

    options = frozenset(
        'drop_fields lossless max_bytes max_rate priority resolution'.split())

    def check(self) -> None:
        """Check for NumPy and zstandard."""
        check_modules(modules.CLOUDS, 'point clouds')

    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the encoder."""
        return self._node(stream, 'encoder', stream.source)

    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the decoder."""
        return self._node(stream, 'decoder', stream.target)

    def _node(self, stream: Stream, role: str, machine: Optional[str]) -> NodeSpec:
        return python_node(
            stream, role=role, machine=machine, name='pointcloud', package='point_cloud_stream',
            topic='points', options=('max_bytes',), parameters={})

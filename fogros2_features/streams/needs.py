# SPDX-License-Identifier: Apache-2.0
"""The Python modules that the nodes of streams import besides ROS 2."""

from __future__ import annotations

from fogros2.host.modules import Module, NUMPY, OPENCV

# 16 converts bgr8 with a wrong colour range, 14 damages depth images of a few pixels
_IMAGES = (NUMPY, Module('av', ('av',), (17,)), OPENCV)
_CLOUDS = (NUMPY, Module('zstandard', ('zstandard',)))
#: Of the executables of ``image_transport_h264``, and of ``point_cloud_stream``.
IMAGES = {'encoder': _IMAGES, 'decoder': _IMAGES}
CLOUDS = {'encoder': _CLOUDS, 'decoder': _CLOUDS}

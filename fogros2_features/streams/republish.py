# SPDX-License-Identifier: Apache-2.0
"""Use C++ ``image_transport`` and ``point_cloud_transport`` through their ``republish``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import ClassVar, Optional

from fogros2.errors import PrerequisiteError
from fogros2.model import NodeSpec
from fogros2.ros_names import local_topic
from fogros2_features.streams.topics import names_of
from fogros2_features.streams.transport import ImageTransport, Stream


class Republish(ImageTransport):
    """
    A transport whose C++ plugin is installed on both sides.

    The stream's options are the plugin's parameters, such as ``quality=31`` for Theora, which
    ``republish`` calls ``out.theora.quality``. An option with a dot is taken as such a full name.
    """

    plugin: ClassVar[str]
    #: The package of ``republish``; the plugin's package is ``<plugin>_<package>``.
    package: ClassVar[str] = 'image_transport'
    #: What to use where the plugin is not installed.
    instead: ClassVar[str] = 'h264'

    def check(self) -> None:
        """
        Check that AMENT_PREFIX_PATH contains the two packages.

        :raises PrerequisiteError: a package is missing.
        """
        prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
        for package in (self.package, f'{self.plugin}_{self.package}'):
            if not any(Path(prefix, 'share/ament_index/resource_index/packages', package).exists()
                       for prefix in prefixes if prefix):
                apt = f"ros-jazzy-{package.replace('_', '-')}"
                raise PrerequisiteError(
                    f'streams by {self.plugin} need the package {package}, which is not here',
                    f"apt install {apt}, here and on the machine; or stream by '{self.instead}'")

    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the ``republish`` node from raw."""
        return self._node(stream, 'encoder', stream.source, 'in', 'out')

    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the ``republish`` node to raw."""
        return self._node(stream, 'decoder', stream.target, 'out', 'in')

    def _node(
        self, stream: Stream, role: str, machine: Optional[str], raw: str, encoded: str,
    ) -> NodeSpec:
        """Return a node; ``raw`` and ``encoded`` are its sides, 'in' or 'out'."""
        label, full, between = names_of(stream, role, self.plugin)
        image = local_topic(stream.topic, machine)
        words = ['--ros-args', '-r', f'__node:={full}', '-p', f'{raw}_transport:=raw',
                 '-p', f'{encoded}_transport:={self.plugin}', '-r', f'{raw}:={image}',
                 '-r', f'{encoded}/{self.plugin}:={between}']
        if role == 'encoder':
            # cameras often publish best effort, which a reliable subscription would not receive
            words += ['-p', f'qos_overrides.{image}.subscription.reliability:=best_effort']
            for key, value in stream.options.items():
                if key != 'camera_info':
                    name = key if '.' in key else f'{self._prefix(between)}.{key}'
                    words += ['-p', f'{name}:={value}']
        return NodeSpec(
            id=f"{machine or 'robot'}/{label}", name=label, package=self.package,
            executable='republish', arguments=tuple(words), respawn=True, respawn_delay=1.0)

    def _prefix(self, between: str) -> str:
        """Return the beginning of the names of the plugin's parameters."""
        return f'out.{self.plugin}'


class Theora(Republish):
    """``theora_image_transport``."""

    plugin = 'theora'


class Ffmpeg(Republish):
    """``ffmpeg_image_transport``."""

    plugin = 'ffmpeg'


class RepublishedCompressed(Republish):
    """``compressed_image_transport``, for users who prefer the C++ implementation."""

    plugin = 'compressed'


class Draco(Republish):
    """``draco_point_cloud_transport``, for point clouds."""

    plugin, package, instead = 'draco', 'point_cloud_transport', 'pointcloud'

    def _prefix(self, between: str) -> str:
        """Return the remapped topic's name, unlike ``image_transport``."""
        return between.strip('/').replace('/', '.')


class Zlib(Draco):
    """``zlib_point_cloud_transport``, for point clouds."""

    plugin = 'zlib'


class Zstd(Draco):
    """``zstd_point_cloud_transport``, for point clouds."""

    plugin = 'zstd'

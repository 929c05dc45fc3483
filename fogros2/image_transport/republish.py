# SPDX-License-Identifier: Apache-2.0
"""Use the transports of C++ ``image_transport`` through its program ``republish``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import ClassVar, Optional

from fogros2.errors import PrerequisiteError
from fogros2.image_transport import ImageTransport
from fogros2.image_transport.topics import check, local_topic, names_of
from fogros2.model import NodeSpec, Stream


class Republish(ImageTransport):
    """
    A transport whose C++ plugin is installed on both sides.

    The stream's options are the plugin's parameters, such as ``quality=31`` for Theora, which
    ``republish`` calls ``out.theora.quality``. An option with a dot is taken as such a full name.
    """

    plugin: ClassVar[str]

    def check(self) -> None:
        """
        Check that AMENT_PREFIX_PATH contains the two packages.

        :raises PrerequisiteError: a package is missing.
        """
        prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
        for package in ('image_transport', f'{self.plugin}_image_transport'):
            if not any(Path(prefix, 'share/ament_index/resource_index/packages', package).exists()
                       for prefix in prefixes if prefix):
                apt = f"ros-jazzy-{package.replace('_', '-')}"
                raise PrerequisiteError(
                    f'streams by {self.plugin} need the package {package}, which is not here',
                    f"apt install {apt}, here and on the machine; or stream by 'h264'")

    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the ``republish`` node from raw."""
        image = local_topic(stream.topic, stream.source)
        return self._node(stream, 'encoder', stream.source, 'raw', self.plugin, 'out', {
            'in': image})

    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the ``republish`` node to raw."""
        image = local_topic(stream.topic, stream.target)
        return self._node(stream, 'decoder', stream.target, self.plugin, 'raw', 'in', {
            'out': image})

    def _node(
        self, stream: Stream, role: str, machine: Optional[str], source: str, target: str,
        side: str, names: dict[str, str],
    ) -> NodeSpec:
        check(stream)
        label, full, between = names_of(stream, role, self.plugin)
        words = ['--ros-args', '-r', f'__node:={full}', '-p', f'in_transport:={source}',
                 '-p', f'out_transport:={target}']
        for old, new in {**names, f'{side}/{self.plugin}': between}.items():
            words += ['-r', f'{old}:={new}']
        if role == 'encoder':
            # cameras often publish best effort, which a reliable subscription would not receive
            words += ['-p', f"qos_overrides.{names['in']}.subscription.reliability:=best_effort"]
            for key, value in stream.options.items():
                if key != 'camera_info':
                    name = key if '.' in key else f'out.{self.plugin}.{key}'
                    words += ['-p', f'{name}:={value}']
        return NodeSpec(
            id=f"{machine or 'robot'}/{label}", name=label, package='image_transport',
            executable='republish', arguments=tuple(words), respawn=True, respawn_delay=1.0)


class Theora(Republish):
    """``theora_image_transport``."""

    plugin = 'theora'


class Ffmpeg(Republish):
    """``ffmpeg_image_transport``."""

    plugin = 'ffmpeg'


class RepublishedCompressed(Republish):
    """``compressed_image_transport``, for users who prefer the C++ implementation."""

    plugin = 'compressed'

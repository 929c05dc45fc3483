# SPDX-License-Identifier: Apache-2.0
"""
Streams: topics that cross the VPN encoded, by ``stream_topics`` and ``<stream_topic>``.

In reading order: ``transport`` is the plugin interface of transports, ``topics`` names the topics
of streams, ``nodes`` and ``republish`` have the transports, ``entries`` converts what a launch
file says, ``collection`` has the streams of a launch, ``uncompressed`` warns of images that
should be streamed, ``part`` acts in the launch, ``parsing`` reads the element of XML and YAML, and
``elements`` registers it with launch.
"""

from __future__ import annotations

import re
from typing import Optional, TYPE_CHECKING

from fogros2.errors import ConfigurationError
from fogros2.feature import Feature, LaunchPart, RunningLaunch

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

_PREFIXES = {'': 1.0, 'k': 1e3, 'M': 1e6, 'G': 1e9}


class Streaming(Feature):
    """``stream_topics=[('/camera', 'h264')]`` of nodes, ``bandwidth='10Mbit/s'`` of machines."""

    node_list = ('stream_topics', 'stream_topic')

    @staticmethod
    def options(bandwidth: Optional[SomeSubstitutionsType] = None) -> float:
        """
        Return the bits per second that streams may use in each direction, 0 for no limit.

        :param bandwidth: such as '10Mbit/s'.
        """
        if bandwidth is None:
            return 0.0
        match = re.fullmatch(r'(\d+(?:\.\d+)?) ?([kMG]?)bit/s|(\d+(?:\.\d+)?)',
                             str(bandwidth).strip())
        bits = 0.0 if match is None else (
            float(match[1] or match[3]) * _PREFIXES[match[2] or ''])
        if not 1e5 <= bits <= 1e12:
            raise ConfigurationError(
                f'bandwidth={bandwidth!r} is no bandwidth from 100 kbit/s to 1 Tbit/s',
                "write '500kbit/s', '10Mbit/s' or '1Gbit/s'")
        return bits

    def in_launch(self, launch: RunningLaunch) -> LaunchPart:
        """Return what the streams of a launch do."""
        from fogros2_features.streams.part import Part
        return Part(launch)

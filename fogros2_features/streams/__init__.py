# SPDX-License-Identifier: Apache-2.0
"""
What crosses the VPN: topics encoded, by ``stream_topics``; at a limited rate; or not at all.

In reading order: ``policy`` has the limits of a machine's link, ``transport`` is the plugin
interface of transports, ``topics`` names the topics of streams, ``needs`` has the Python modules
of their nodes, ``nodes`` and ``republish`` have the transports, ``entries`` converts what a launch
file says, ``collection`` has the streams of a launch, ``uncompressed`` warns of images that should
be streamed, ``part`` acts in the launch, ``parsing`` reads the element of XML and YAML, and
``elements`` registers it with launch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Optional, TYPE_CHECKING

from fogros2.errors import ConfigurationError
from fogros2.feature import Feature, LaunchPart, RunningLaunch
from fogros2.model import MachineSpec
from fogros2_features.streams.policy import Policy, policy

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import Scalar


class Streaming(Feature):
    """``stream_topics=[('/camera', 'h264')]`` of nodes; of machines, what their link may carry."""

    node_list = ('stream_topics', 'stream_topic')

    @staticmethod
    def options(
        bandwidth: Optional[SomeSubstitutionsType] = None,
        deny_topics: Sequence[SomeSubstitutionsType] = (),
        limit_topics: Mapping[str, Scalar] = MappingProxyType({}),
    ) -> Policy:
        """
        Return the policy of the machine's link.

        :param bandwidth: that streams may use in each direction, such as '10Mbit/s'.
        :param deny_topics: topics that do not cross.
        :param limit_topics: the rate at which a topic crosses, such as '20 Hz', by topic.
        """
        return policy(bandwidth, deny_topics, limit_topics)

    def check(self, spec: MachineSpec, own: Policy) -> None:
        """Check that the machine shares no topic that is denied or limited."""
        shared = spec.features.get('share', {}).get('share', ())
        if both := sorted({*shared} & {*own.names(spec.name)}):
            raise ConfigurationError(
                f"'{spec.name}' has {', '.join(both)} in share= and in deny_topics or "
                'limit_topics',
                'leave one of the two out: all of the launch hears what is shared')

    def in_launch(self, launch: RunningLaunch) -> LaunchPart:
        """Return what the streams of a launch do."""
        from fogros2_features.streams.part import Part
        return Part(launch)

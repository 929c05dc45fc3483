# SPDX-License-Identifier: Apache-2.0
"""What the launches of ``test/launch`` have in common."""

from __future__ import annotations

import dataclasses
from typing import Any

from fogros2.model import NodeSpec
from fogros2_features.streams.nodes import H264
from fogros2_features.streams.transport import Stream


class Harmless(H264):
    """H.264's decisions, carried out by the talker of package ``demo``."""

    def encoder(self, stream: Stream) -> NodeSpec:
        return dataclasses.replace(super().encoder(stream), package='demo', executable='talker')

    def decoder(self, stream: Stream) -> NodeSpec:
        return dataclasses.replace(super().decoder(stream), package='demo', executable='talker')


def ends(machine: Any, node: NodeSpec) -> None:
    """Have a node of a FakeMachine exit as soon as it started, so that the launch ends."""
    machine.say('exited', node, returncode=0, respawns=False)

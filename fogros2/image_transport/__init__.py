# SPDX-License-Identifier: Apache-2.0
"""The seam to image transports: the pair of nodes that carries a topic across the VPN encoded."""

from __future__ import annotations

import abc

from fogros2.model import NodeSpec, Stream


class ImageTransport(abc.ABC):
    """A way to encode a topic on one side and decode it on the other; pure."""

    @abc.abstractmethod
    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the node beside the publisher: takes the topic, publishes the stream."""

    @abc.abstractmethod
    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the node beside the subscriber: takes the stream, publishes the topic."""

# SPDX-License-Identifier: Apache-2.0
"""The seam to image transports: the pair of nodes that carries a topic across the VPN encoded."""

from __future__ import annotations

import abc
from typing import ClassVar, Optional

from fogros2.model import NodeSpec, Stream


class ImageTransport(abc.ABC):
    """A way to encode a topic on one side and decode it on the other; pure but for ``check``."""

    #: Whether the pair carries camera info too, for streams that ask for it. Where it doesn't,
    #: camera info keeps its name, and crosses the VPN as it is.
    camera_info: ClassVar[bool] = False
    #: The options that a stream may have, None for any.
    options: ClassVar[Optional[frozenset[str]]] = None

    def check(self) -> None:
        """
        Hold what this computer has against what a node of the pair needs; costs next to nothing.

        :raises PrerequisiteError: something isn't installed.
        """

    @abc.abstractmethod
    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the node beside the publisher: takes the topic, publishes the stream."""

    @abc.abstractmethod
    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the node beside the subscriber: takes the stream, publishes the topic."""

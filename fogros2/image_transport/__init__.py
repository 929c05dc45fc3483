# SPDX-License-Identifier: Apache-2.0
"""The plugin interface of image transports: a pair of nodes that sends a topic over the VPN."""

from __future__ import annotations

import abc
from typing import ClassVar, Optional

from fogros2.model import NodeSpec, Stream


class ImageTransport(abc.ABC):
    """Encode a topic on one side of the VPN and decode it on the other; pure except ``check``."""

    #: Whether the pair also carries camera info, for streams that request it. Otherwise camera
    #: info keeps its name and crosses the VPN as an ordinary topic.
    camera_info: ClassVar[bool] = False
    #: The valid options of a stream, None for any.
    options: ClassVar[Optional[frozenset[str]]] = None

    def check(self) -> None:
        """
        Check that this computer has what a node of the pair needs; cheap.

        :raises PrerequisiteError: something is not installed.
        """

    @abc.abstractmethod
    def encoder(self, stream: Stream) -> NodeSpec:
        """Return the publisher's node: it subscribes to the topic and publishes the stream."""

    @abc.abstractmethod
    def decoder(self, stream: Stream) -> NodeSpec:
        """Return the subscriber's node: it subscribes to the stream and publishes the topic."""

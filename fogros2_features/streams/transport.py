# SPDX-License-Identifier: Apache-2.0
"""The plugin interface of image transports: a pair of nodes that sends a topic over the VPN."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
import dataclasses
from typing import Any, ClassVar, Optional

from fogros2.model import NodeSpec

#: The group of entry points.
GROUP = 'fogros2.image_transport'


@dataclasses.dataclass(frozen=True)
class Stream:
    """
    A topic that crosses the VPN encoded.

    :param topic: full topic name, which publisher and subscriber use.
    :param transport: name of an entry point in the group ``fogros2.image_transport``.
    :param source: machine name of the publisher's side, None for the robot.
    :param target: machine name of the subscriber's side, None for the robot.
    :param links: topics of the links with a limited bandwidth that it crosses, and their bits per
        second.
    """

    topic: str
    transport: str
    source: Optional[str] = None
    target: Optional[str] = None
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    links: Mapping[str, float] = dataclasses.field(default_factory=dict)


class ImageTransport(abc.ABC):
    """Encode a topic on one side of the VPN and decode it on the other; pure except ``check``."""

    #: Whether the pair also carries camera info, for streams that request it. Otherwise camera
    #: info keeps its name and crosses the VPN as an ordinary topic.
    camera_info: ClassVar[bool] = False
    #: The valid options of a stream, None for any.
    options: ClassVar[Optional[frozenset[str]]] = None
    #: The least and the largest value of options that are numbers, and all values of others.
    numbers: ClassVar[Mapping[str, tuple[float, float]]] = {}
    choices: ClassVar[Mapping[str, Sequence[object]]] = {}

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

# SPDX-License-Identifier: Apache-2.0
"""The seam to DDS: which interfaces and peers a launch's nodes use, as the middleware wants it."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import ClassVar

from fogros2.model import DdsInterface


class DdsVendor(abc.ABC):
    """A ROS middleware that can be told its interfaces and peers; pure."""

    #: Value of RMW_IMPLEMENTATION.
    rmw: ClassVar[str]

    @abc.abstractmethod
    def render(self, interfaces: Sequence[DdsInterface], peers: Sequence[str]) -> str:
        """
        Return the configuration file's text.

        :param interfaces: those the nodes use.
        :param peers: addresses asked for participants, ours (127.0.0.1) not among them.
        """

    @abc.abstractmethod
    def environment(self, path: str, user: Mapping[str, str]) -> Mapping[str, str]:
        """
        Return the variables that make nodes read the file at ``path``.

        :param user: the environment as the user has it; what it configures is kept, ours after it.
        """

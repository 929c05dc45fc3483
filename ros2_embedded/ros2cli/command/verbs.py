# SPDX-License-Identifier: Apache-2.0
"""The commands ``ros2 node|param|pkg|service|topic``, all of whose work their verbs do."""
from __future__ import annotations

from ros2cli.command import VerbsCommand


class NodeCommand(VerbsCommand):
    """Various node related sub-commands."""


class ParamCommand(VerbsCommand):
    """Various param related sub-commands."""


class PkgCommand(VerbsCommand):
    """Various package related sub-commands."""


class ServiceCommand(VerbsCommand):
    """Various service related sub-commands."""


class TopicCommand(VerbsCommand):
    """Various topic related sub-commands."""

# SPDX-License-Identifier: Apache-2.0
"""What a launch file says of the interruption of a machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import dataclasses
from typing import Any, Literal

from fogros2.describe.values import check_folder, choice, parse_duration
from fogros2.errors import ConfigurationError
from fogros2.model import NodeSpec

#: The name of the entry point.
NAME = 'replacement'
OnInterrupt = Literal['shutdown', 'robot', 'replace']


@dataclasses.dataclass(frozen=True)
class Options:
    """
    What a launch file says of the interruption of a machine.

    :param on_interrupt: when the provider reclaims the machine while its nodes run: end the
        launch, run the nodes on the robot, or run them on a replacement of the machine.
    :param on_loss_after: seconds of silence after which a machine is replaced; at least
        ``robot_timeout``, 0 for as long as that.
    :param max_replacements: the number of replacements in one launch.
    :param checkpoint: a folder that a replacement takes over, '' for none.
    :param checkpoint_interval: seconds between two copies of that folder to the robot.
    """

    on_interrupt: OnInterrupt = 'shutdown'
    on_loss_after: float = 0.0
    max_replacements: int = 3
    checkpoint: str = ''
    checkpoint_interval: float = 30.0

    @property
    def replaces(self) -> bool:
        """Whether a new machine continues the nodes."""
        return self.on_interrupt == 'replace'


def _count(what: str, value: object) -> int:
    text = str(value)
    if not text.isdecimal() or not 0 < int(text) < 1000:
        raise ConfigurationError(f'{what}={value!r} is no number of machines',
                                 'use a whole number from 1')
    return int(text)


_CHECKS: Mapping[str, Callable[[str, Any], Any]] = {
    'on_interrupt': choice(OnInterrupt), 'on_loss_after': parse_duration,
    'max_replacements': _count, 'checkpoint': check_folder, 'checkpoint_interval': parse_duration}


def read(given: Mapping[str, Any]) -> Options:
    """
    Read the values of keywords.

    :raises ConfigurationError: a value is wrong.
    """
    return Options(**{name: _CHECKS[name](name, value) for name, value in given.items()})


def read_folder(checkpoint: object) -> str:
    """
    Read the keyword of a node, '' for none.

    :raises ConfigurationError: it is no folder.
    """
    return check_folder('checkpoint', checkpoint) if checkpoint else ''


def folder_of(node: NodeSpec) -> str:
    """Return the folder of a node that a replacement takes over, '' for none."""
    return read_folder(node.features.get(NAME, {}).get('checkpoint'))

# SPDX-License-Identifier: Apache-2.0
"""Add the option of ``ros2 launch ... --machine planner=container``."""

from __future__ import annotations

import argparse
import contextlib
from typing import Any, Optional, TYPE_CHECKING

from ros2fog_cli.verb import add_overrides

if TYPE_CHECKING:
    from launch import LaunchDescription


class MachineOption:
    """
    Run machines elsewhere than the launch file says; entry point group ``ros2launch.option``.

    The class does not derive from ros2launch's OptionExtension, which the embedded default lacks;
    ``ros2 launch`` needs only the methods.
    """

    NAME: Optional[str] = None
    EXTENSION_POINT_VERSION = '0.1'

    def __init__(self) -> None:
        self._overrides: Any = None

    def add_arguments(
        self, parser: argparse.ArgumentParser, cli_name: str, *, argv: Any = None,
    ) -> None:
        """Add ``--machine``."""
        add_overrides(parser)

    def reading(self) -> contextlib.AbstractContextManager[None]:
        """Prepare for ``-s`` and ``-p`` to read the launch file; ros2launch does not ask."""
        from fogros2.launch_internals import hints
        from fogros2.runtime import log_files
        hints.of_actions()
        return log_files.none()

    def preview(
        self, launch_description: LaunchDescription, args: argparse.Namespace,
        arguments: dict[str, str],
    ) -> str:
        """
        Return what ``-s`` and ``-p`` show of the machines; ROS 2's own ros2launch does not ask.

        :param arguments: launch arguments.
        :raises ConfigurationError: a value of ``--machine`` is invalid.
        """
        from fogros2.describe.overrides import Overrides
        from ros2fog_cli.api.preview import Preview
        overrides = Overrides(args.machine) if args.machine else None
        preview = Preview(launch_description, arguments, overrides)
        if all(machine.spec is None and not machine.note for machine in preview.machines):
            return ''
        return '\n'.join(['', 'Machines (ros2 fog plan asks for their prices):',
                          *(f'    {line}' for line in preview.lines()), ''])

    def prestart(self, args: argparse.Namespace) -> None:
        """
        Parse the arguments, and make launch's log folder, before the launch starts.

        :raises ConfigurationError: an argument is invalid, or the folder cannot be made.
        """
        from fogros2.launch_internals import environment, hints
        from fogros2.runtime import log_files
        log_files.prepare()
        hints.of_actions()
        # the launch file may set variables before it includes one that imports FogROS2
        environment.record()
        self._overrides = None
        if args.machine:
            from fogros2.describe.overrides import Overrides
            self._overrides = Overrides(args.machine)

    def prelaunch(
        self, launch_description: LaunchDescription, args: argparse.Namespace,
    ) -> tuple[LaunchDescription]:
        """Return the launch description, wrapped so that the overrides apply to its machines."""
        if self._overrides is None:
            return (launch_description,)
        from launch import LaunchDescription

        from fogros2.actions.override import OverrideMachines
        return (LaunchDescription([OverrideMachines(self._overrides, [launch_description])]),)

    def postlaunch(self, launch_return_code: int, args: argparse.Namespace) -> None:
        """Do nothing."""

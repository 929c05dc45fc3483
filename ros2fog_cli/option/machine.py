# SPDX-License-Identifier: Apache-2.0
"""Add the option of ``ros2 launch ... --machine planner=container``."""

from __future__ import annotations

import argparse
from typing import Any, Optional, TYPE_CHECKING

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
        argument = parser.add_argument(
            '--machine', action='append', default=[], metavar='NAME=PROVIDER[,KEYWORD=VALUE...]',
            help="Run a cloud machine of the launch elsewhere, such as planner=container, "
                 "planner=aws,region=eu-west-1, planner=ssh:user@host, or '*=robot': all of them "
                 'on this computer, without the cloud')
        argument.completer = complete  # type: ignore[attr-defined]

    def prestart(self, args: argparse.Namespace) -> None:
        """
        Parse the arguments, and make launch's log folder, before the launch starts.

        :raises ConfigurationError: an argument is invalid, or the folder cannot be made.
        """
        from fogros2.launch_internals import hints
        from fogros2.runtime import log_files
        log_files.prepare()
        hints.of_actions()
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


def complete(prefix: str, **_: object) -> list[str]:
    """
    Return the completions of an argument that begins with ``prefix``.

    First come the names of machines that this computer knows, then providers, then the keywords
    of the provider. The completion reads no launch file.
    """
    name, equals, rest = prefix.partition('=')
    if not equals:
        from ros2fog_cli.verb import machine_names
        return [f'{one}=' for one in [*machine_names(), '*'] if one.startswith(name)]
    from fogros2.describe import keywords
    before, comma, last = rest.rpartition(',')
    if not comma:
        return [f'{name}={one}' for one in keywords.providers() if one.startswith(last)]
    provider = before.partition(',')[0].partition(':')[0]
    if '=' in last or provider not in keywords.providers():
        return []
    return [f'{name}={before},{one}=' for one in keywords.keywords(
        keywords.machine_class(provider)) if one.startswith(last) and one != 'name']

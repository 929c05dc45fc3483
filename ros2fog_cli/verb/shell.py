# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog shell``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_command, add_name, command_of, VerbExtension


class ShellVerb(VerbExtension):
    """Open a shell on this computer whose ROS 2 commands see a machine's launch."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        add_command(parser, 'a shell')

    def main(self, *, args: argparse.Namespace) -> int:
        """Replace this process by the shell."""
        from ros2fog_cli.api import terminals
        terminals.run(args.name, command_of(args, 'shell'))

# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog shell``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_name, VerbExtension


class ShellVerb(VerbExtension):
    """Open a shell on this computer whose ROS 2 commands see a machine's launch."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        self._parser = parser
        add_name(parser)
        parser.add_argument('command', nargs=argparse.REMAINDER,
                            help='-- and a command to run instead of a shell')

    def main(self, *, args: argparse.Namespace) -> int:
        """Replace this process by the shell."""
        if args.command[:1] in (['-h'], ['--help']):
            # argparse takes options after the name for a part of the command
            self._parser.print_help()
            return 0
        from ros2fog_cli.api import joining
        words = args.command[1:] if args.command[:1] == ['--'] else args.command
        joining.run(args.name, words)

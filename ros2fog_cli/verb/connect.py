# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog connect``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_name, add_region, VerbExtension, warn


class ConnectVerb(VerbExtension):
    """Open a session on a machine, or run a command there."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        add_region(parser)
        parser.add_argument('--user', '-u', help='another user than the one nodes run as')
        parser.add_argument('command', nargs=argparse.REMAINDER,
                            help='-- and a command, instead of a login shell')

    def main(self, *, args: argparse.Namespace) -> int:
        """Hand the terminal over; the exit status is that of the session."""
        from fogros2.model import Command
        from ros2fog_cli.api import reach
        words = args.command[1:] if args.command[:1] == ['--'] else args.command
        entry = reach.find(args.name, warn, regions=args.region)
        shell = reach.shell(entry, args.user)
        try:
            return shell.interactive(Command(tuple(words)) if words else None)
        finally:
            shell.close()

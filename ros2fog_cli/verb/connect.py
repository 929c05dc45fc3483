# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog connect``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import (
    add_command,
    add_name,
    add_region,
    command_of,
    VerbExtension,
    warn,
)


class ConnectVerb(VerbExtension):
    """Open a session on a machine, or run a command there."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        _add_options(parser)
        add_command(parser, 'a login shell')

    def main(self, *, args: argparse.Namespace) -> int:
        """Connect the terminal to the session; return the exit status of the session."""
        from fogros2.model import Command
        from ros2fog_cli.api import reach
        words = command_of(args, 'connect', _add_options)
        entry = reach.find(args.name, warn, regions=args.region)
        with reach.session(entry, args.user) as shell:
            return shell.interactive(Command(tuple(words)) if words else None)


def _add_options(parser: argparse.ArgumentParser) -> None:
    add_region(parser)
    parser.add_argument('--user', '-u', help='login user (default: the user of the nodes)')

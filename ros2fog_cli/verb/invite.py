# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog invite``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_name, VerbExtension, warn


class InviteVerb(VerbExtension):
    """Admit another computer to a machine, and print its invitation."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        parser.add_argument('--key', required=True,
                            help='what `ros2 fog key` prints on the other computer')
        parser.add_argument('--for', dest='seconds', default='1h', metavar='TIME',
                            help='how long it may join, such as 10m or 2h (default: 1h)')
        parser.add_argument('--address', metavar='HOST',
                            help='where it reaches the machine (default: as the provider says)')

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the invitation, which only the other computer can open."""
        from fogros2.describe.values import parse_duration
        from ros2fog_cli.api import guests
        print(guests.invite(args.name, args.key, parse_duration('--for', args.seconds), warn,
                            host=args.address))
        return 0

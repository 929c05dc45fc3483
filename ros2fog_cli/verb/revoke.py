# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog revoke``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_name, VerbExtension, warn


class RevokeVerb(VerbExtension):
    """Remove a computer that was invited from a machine; without WHO, all of them."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        parser.add_argument('who', nargs='?', metavar='WHO',
                            help='name, VPN address or key, as `ros2 fog status` shows them')

    def main(self, *, args: argparse.Namespace) -> int:
        """Print who was removed."""
        from ros2fog_cli.api import guests
        names = guests.revoke(args.name, args.who, warn)
        for each in names:
            print(f'revoked {each}')
        if not names:
            print(f"'{args.name}' has no guests")
        return 0

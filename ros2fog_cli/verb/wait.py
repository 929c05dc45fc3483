# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog wait``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_name, add_region, number, VerbExtension, warn


class WaitVerb(VerbExtension):
    """Wait until a machine is up and its nodes start, or until it is gone."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        add_region(parser)
        parser.add_argument('--gone', action='store_true', help='wait until it is deleted')
        parser.add_argument('--timeout', type=number, default=600.0, metavar='SECONDS',
                            help='fail after this time (default: 600)')

    def main(self, *, args: argparse.Namespace) -> int:
        """Return 0 when the machine is as wanted."""
        from ros2fog_cli.api import awaiting
        if args.gone:
            awaiting.gone(args.name, args.timeout, warn, regions=args.region)
        else:
            awaiting.up(args.name, args.timeout)
        return 0

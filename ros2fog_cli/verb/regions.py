# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog regions``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import (
    add_json,
    complete,
    print_json,
    provider_names,
    region_names,
    VerbExtension,
)


class RegionsVerb(VerbExtension):
    """List a provider's regions by the time of a connection from here."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        complete(parser.add_argument('region', nargs='*', help='only these regions'), region_names)
        parser.add_argument('--all', action='store_true',
                            help='also list regions that an account has to enable first')
        complete(parser.add_argument(
            '--provider', metavar='PROVIDER',
            help='provider to ask (default: the first one that is set up)'), provider_names)
        add_json(parser)

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the table."""
        from ros2fog_cli.api import machines, table
        provider = machines.load(args.provider or machines.able('regions'))
        regions = provider.regions(args.region, every=args.all)
        if args.json:
            print_json(regions=[{
                'region': one.region, 'place': one.place, 'median_ms': one.milliseconds,
                'distance_km': one.distance_km} for one in regions])
            return 0
        measured = any(one.milliseconds is not None for one in regions)
        print(table.table(
            ('REGION', 'PLACE', 'MEDIAN' if measured else 'DISTANCE'),
            [(one.region, one.place, _far(one.milliseconds, one.distance_km)) for one in regions]))
        if not measured:
            print('no region answers: these are distances from where this computer seems to be')
        return 0


def _far(milliseconds: float | None, kilometres: float | None) -> str:
    from ros2fog_cli.api import table
    if milliseconds is not None:
        return table.milliseconds(milliseconds)
    return 'no answer' if kilometres is None else f'{kilometres:.0f} km'

# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog price``."""

from __future__ import annotations

import argparse
from typing import Any, TYPE_CHECKING

from ros2fog_cli.verb import (
    add_json,
    complete,
    number,
    print_json,
    region_names,
    VerbExtension,
    warn,
)

if TYPE_CHECKING:
    from fogros2_features.prices.offers import Offer


class PriceVerb(VerbExtension):
    """List the machine types of all clouds that match, cheapest first."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        parser.add_argument('--min-cpu', type=int, metavar='N', help='vCPUs (default: 2)')
        parser.add_argument('--min-memory', type=float, metavar='GB', help='memory (default: 4)')
        parser.add_argument('--gpu', nargs='?', const='1', metavar='N|NAME',
                            help='number of NVIDIA GPUs, or the name of a GPU, such as L4')
        parser.add_argument('--gpu-memory', type=float, metavar='GB', help='memory of each GPU')
        parser.add_argument('--arch', help="x86_64, arm64 or any (default: this computer's)")
        parser.add_argument('--cpu-type', choices=('intel', 'amd', 'aws'),
                            help='maker of the processor')
        parser.add_argument('--max-price', metavar='DOLLARS', help='maximum price of an hour')
        parser.add_argument('--max-round-trip', type=float, metavar='MS',
                            help='search all regions within this time from here')
        parser.add_argument('--spot', action='store_true', help='include spot prices')
        region = parser.add_argument(
            '--region', nargs='*', metavar='REGION',
            help="of any cloud, 'all' for every one, 'nearest' for that of each cloud (default: "
            'the configured region of each)')
        complete(region, region_names)
        parser.add_argument('--limit', type=number, default=10, metavar='N',
                            help='rows to show, 0 for all (default: 10)')
        parser.add_argument('--refresh', action='store_true',
                            help='do not use prices of the last 24 hours')
        provider = parser.add_argument(
            '--provider', metavar='PROVIDER', default='all',
            help="provider of the prices (default: 'all' that are set up)")
        complete(provider, cloud_names)
        add_json(parser)

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the table; a launch would use the first row."""
        from fogros2.provider.vm.provider import ALL
        from fogros2_features.prices import clouds, offers
        from ros2fog_cli.api import table
        from ros2fog_cli.api.interrupts import interruptible
        wanted = offers.wants(
            arch=args.arch, min_cpu=args.min_cpu, min_memory_gb=args.min_memory,
            cpu_type=args.cpu_type, gpu=args.gpu, gpu_memory_gb=args.gpu_memory,
            max_price=args.max_price, spot=args.spot)
        every = args.provider == ALL
        with interruptible() as cancel:
            choice = clouds.compare(
                wanted, () if every else (args.provider,), args.region or (), measure=True,
                max_round_trip_ms=args.max_round_trip, refresh=args.refresh, cancel=cancel)
        regions = choice.regions
        shown = choice.offers[:int(args.limit) or None]
        if args.json:
            print_json(offers=list(map(to_json, shown)))
        else:
            where = ', '.join(regions) if len(regions) < 4 else f'{len(regions)} regions'
            print(f'{wanted}, in {where}')
            print(table.table(
                ('TYPE', 'PROVIDER', 'REGION', 'CPUS', 'MEMORY', 'GPU', 'ARCH', 'CPU', 'PRICE/H',
                 'SPOT/H', 'ROUND TRIP'),
                [(one.type.name, one.provider, one.region, str(one.type.vcpus),
                  f'{one.type.memory_gb:g} GB',
                  _gpus(one.type.gpus, one.type.gpu, one.type.gpu_memory_gb), one.type.arch,
                  one.type.cpu or table.NONE, table.cost(one.price), table.cost(one.spot_price),
                  table.milliseconds(one.round_trip_ms)) for one in shown],
                width=table.terminal_width(), optional=(
                    'CPU', 'ARCH', *(('REGION',) if len(regions) == 1 else ()), 'GPU',
                    'ROUND TRIP')))
            rest = len(choice.offers) - len(shown)
            if rest:
                print(f"{rest} more {'cost' if rest > 1 else 'costs'} as much or more (--limit 0)")
        for who, reason in choice.left_out:
            warn(f'{who}: {reason}')
        others = clouds.clouds()[1]
        if every and others:
            warn(f"not set up here: {', '.join(others)}")
        return 0


def to_json(offer: Offer) -> dict[str, Any]:
    """Return an offer as JSON values: prices in US dollars an hour."""
    kind = offer.type
    return {
        'provider': offer.provider, 'region': offer.region, 'type': kind.name,
        'vcpus': kind.vcpus, 'memory_gb': kind.memory_gb, 'arch': kind.arch, 'cpu': kind.cpu,
        'gpus': kind.gpus, 'gpu': kind.gpu, 'gpu_memory_gb': kind.gpu_memory_gb,
        'zones': offer.zones,
        'price': None if offer.price is None else float(offer.price),
        'spot_price': None if offer.spot_price is None else float(offer.spot_price),
        'round_trip_ms': offer.round_trip_ms,
    }


def cloud_names() -> list[str]:
    """Return 'all' and the providers with prices."""
    from fogros2_features.prices.clouds import clouds
    return ['all', *sum(clouds(), [])]


def _gpus(number: int, name: str, memory: float) -> str:
    return f'{number} x {name} {memory:g} GB' if number else '-'

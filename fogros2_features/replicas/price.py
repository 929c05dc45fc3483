# SPDX-License-Identifier: Apache-2.0
"""The option ``--replicas`` of ``ros2 fog price``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from fogros2.errors import ConfigurationError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the option."""
    parser.add_argument('--replicas', type=int, metavar='N',
                        help='compare the cost of N machines with one on demand')


def line(offers: Sequence[Any], args: argparse.Namespace) -> str:
    """
    Compare the cost of several machines, the cheapest offers, with that of one on demand.

    :raises ConfigurationError: there are not enough offers, or none on demand.
    """
    number, spot = args.replicas, args.spot
    if number is None:
        return ''
    costs = sorted(cost for one in offers if (cost := one.cost(spot)) is not None)[:number]
    alone = min((one.price for one in offers if one.price is not None), default=None)
    if number < 2 or len(costs) < number or alone is None:
        raise ConfigurationError(f'--replicas {number}: {len(costs)} offers match',
                                 'give 2 or more, and search more regions: --region all')
    return (f"{number} replicas{' on spot machines' if spot else ''} ${sum(costs):.4f} an hour, "
            f'one machine on demand ${alone:.4f}: {sum(costs) / alone:.2f} times')

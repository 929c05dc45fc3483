# SPDX-License-Identifier: Apache-2.0
"""Format the cost of a launch, for its last log lines; pure."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal


def lines(machines: Sequence[tuple[str, Decimal, float]]) -> list[str]:
    """
    Return a line for each machine, and a line with the sum of several.

    :param machines: name, US dollars per hour, seconds.
    """
    costs = []
    total = Decimal(0)
    for name, price, seconds in machines:
        hours = Decimal(seconds) / 3600
        total += price * hours
        costs.append(f'{name}: {short(hours)} h at ${price.normalize():f} an hour, '
                     f'${short(price * hours)}')
    if len(costs) > 1:
        costs.append(f'all machines: ${short(total)}')
    return costs


def short(value: Decimal) -> str:
    """Format hours or US dollars with two decimals; a small value with two significant digits."""
    # without an exponent
    return f'{Decimal(f"{value:.2g}"):f}' if 0 < value < Decimal('0.1') else f'{value:.2f}'

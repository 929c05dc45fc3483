# SPDX-License-Identifier: Apache-2.0
"""Format the cost of a launch, for its last log lines; pure."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal

from fogros2.feature import Cost


def lines(machines: Sequence[Cost]) -> list[str]:
    """Return a line for each machine with a price, and a line with the sum of several."""
    costs = []
    total = Decimal(0)
    for one in machines:
        if one.price and one.seconds:
            total += one.spent
            costs.append(
                f'{one.spec.name}: {short(Decimal(one.seconds) / 3600)} h at '
                f'${one.price.normalize():f} an hour, ${short(one.spent)}')
    if len(costs) > 1:
        costs.append(f'all machines: ${short(total)}')
    return costs


def short(value: Decimal) -> str:
    """Format hours or US dollars with two decimals; a small value with two significant digits."""
    # without an exponent
    return f'{Decimal(f"{value:.2g}"):f}' if 0 < value < Decimal('0.1') else f'{value:.2f}'

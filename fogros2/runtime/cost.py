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
    found = []
    total = Decimal(0)
    for name, price, seconds in machines:
        cost = price * Decimal(seconds) / 3600
        total += cost
        found.append(f'{name}: {hours(seconds)} at ${price.normalize():f} an hour, '
                     f'${dollars(cost)}')
    if len(found) > 1:
        found.append(f'all machines: ${dollars(total)}')
    return found


def hours(seconds: float) -> str:
    """Format a time in hours, the unit of prices; a short time with two significant digits."""
    return f'{_plain(Decimal(seconds) / 3600, below=Decimal("0.1"))} h'


def dollars(cost: Decimal) -> str:
    """Format US dollars with two decimals; a small sum with two significant digits."""
    return _plain(cost, below=Decimal('0.1'))


def _plain(value: Decimal, *, below: Decimal) -> str:
    # two significant digits, without an exponent
    return f'{Decimal(f"{value:.2g}"):f}' if 0 < value < below else f'{value:.2f}'

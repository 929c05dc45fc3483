# SPDX-License-Identifier: Apache-2.0
"""What a launch has cost, as its last words; pure."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal


def lines(machines: Sequence[tuple[str, Decimal, float]]) -> list[str]:
    """
    Return a line for each machine, and for several one with the sum.

    :param machines: name, US dollars an hour, seconds.
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
    """Return a time in hours, as prices are for hours, with what is worth telling of it."""
    return f'{seconds / 3600:.2f} h' if seconds >= 360 else f'{seconds / 3600:.4f} h'


def dollars(cost: Decimal) -> str:
    """Return US dollars to the cent, or to what is worth telling of less than ten."""
    return f'{cost:.2f}' if cost >= Decimal('0.095') else f'{cost:.4f}'

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
    """Return a time in hours, as prices are for hours; of a short one what is worth telling."""
    return f'{_plain(Decimal(seconds) / 3600, below=Decimal("0.1"))} h'


def dollars(cost: Decimal) -> str:
    """Return US dollars to the cent; of a few cents what is worth telling."""
    return _plain(cost, below=Decimal('0.1'))


def _plain(value: Decimal, *, below: Decimal) -> str:
    # two digits that aren't zero, and no exponent
    return f'{Decimal(f"{value:.2g}"):f}' if 0 < value < below else f'{value:.2f}'

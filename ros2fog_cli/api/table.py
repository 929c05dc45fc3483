# SPDX-License-Identifier: Apache-2.0
"""Text for people: tables, durations, bytes."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal
from typing import Optional


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return rows in columns as wide as their longest word, two spaces apart."""
    lines = [header, *rows]
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    return '\n'.join(
        '  '.join(word.ljust(width) for word, width in zip(line, widths)).rstrip()
        for line in lines)


def duration(seconds: Optional[float]) -> str:
    """Return seconds in at most two units, ``-`` for None."""
    if seconds is None:
        return '-'
    if seconds < 0:
        return 'over'
    if seconds < 120:
        return f'{seconds:.0f} s'
    minutes = round(seconds / 60)
    if minutes < 120:
        return f'{minutes} min'
    if minutes < 48 * 60:
        return f'{minutes // 60} h {minutes % 60:02} min'
    return f'{minutes // 1440} d {minutes % 1440 // 60} h'


def size(number: float) -> str:
    """Return bytes with a decimal unit."""
    for unit in ('B', 'kB', 'MB', 'GB'):
        if number < 1000:
            return f'{number:.0f} {unit}' if unit == 'B' else f'{number:.1f} {unit}'
        number /= 1000
    return f'{number:.1f} TB'


def cost(dollars: Optional[Decimal]) -> str:
    """Return US dollars an hour, ``-`` where unknown."""
    return '-' if dollars is None else f'${dollars.quantize(Decimal("0.0001"))}'

# SPDX-License-Identifier: Apache-2.0
"""Format text for users: tables, durations, sizes in bytes, costs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
import shutil
import sys
from typing import Any, Optional

from fogros2.report import size
from fogros2.untrusted import one_line

#: Columns of :func:`nodes`.
NODES = ('NODE', 'STATE', 'PID', 'EXIT', 'RESTARTS')
#: Columns of :func:`crossing`.
CROSSING = ('TOPIC', 'FROM', 'TO', 'HZ', 'BANDWIDTH', 'SHARE', 'LATENCY')
#: Shown for a missing value.
NONE = '-'


def link(vpn: Mapping[str, Any], age: Optional[float]) -> Iterator[tuple[str, str]]:
    """
    Yield rows about a VPN link, each a name and a text.

    :param age: seconds since its last handshake, None before the first one.
    """
    handshake = 'none yet' if age is None else f'{duration(age)} ago'
    latency = NONE if vpn['latency'] is None else f"{vpn['latency']:.2f} ms"
    yield 'VPN', (f"{vpn['address']} on {vpn['interface']}, handshake {handshake}, "
                  f'round trip {latency}')
    yield 'traffic', (f"received {size(vpn['received'])}{_rate(vpn.get('receiving'))}, "
                      f"sent {size(vpn['sent'])}{_rate(vpn.get('sending'))}")


def agent(age: float, memory: float, heartbeat: Optional[float]) -> tuple[str, str]:
    """
    Return the row about an agent, a name and a text.

    :param age: seconds for which it runs; ``heartbeat`` those since the last one, None before it.
    :param memory: in bytes.
    """
    return 'agent', (f'since {duration(max(0.0, age))}, {size(memory)}, heartbeat '
                     + (NONE if heartbeat is None else f'{duration(heartbeat)} ago'))


def crossing(
    machine: str, streams: Sequence[Mapping[str, Any]], topics: Sequence[Mapping[str, Any]] = (),
) -> list[tuple[str, ...]]:
    """Return a row for each topic that crosses the VPN to or from a machine."""
    rows = [(f"{one['topic']} ({one['transport']})", [one['source']], [one['target']], one)
            for one in streams]
    rows += [(one['topic'], one['from'], one['to'], one) for one in topics]
    return [
        (name, _hosts(sources), _hosts(targets),
         one.get('note') or (NONE if one['rate'] is None else f"{one['rate']:.1f}"),
         NONE if one['bandwidth'] is None else f"{size(one['bandwidth'])}/s",
         NONE if one.get('share') is None else f"{one['share'] / 1e6:.1f} Mbit/s",
         NONE if one.get('latency') is None else f"{1e3 * one['latency']:.0f} ms")
        for name, sources, targets, one in rows if machine in (*sources, *targets)]


def _hosts(names: Sequence[str]) -> str:
    return ', '.join(name or 'robot' for name in names)


def _rate(rate: Optional[float]) -> str:
    return '' if rate is None else f' ({size(rate)}/s)'


def nodes(status: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return the rows of nodes in an agent's status, for the columns ``NODES``."""
    return [(node['name'], node['state'], str(node['pid'] or NONE),
             NONE if node['returncode'] is None else str(node['returncode']),
             str(node['restarts'])) for node in status]


def table(
    header: Sequence[str], rows: Sequence[Sequence[str]], *, width: int = 0,
    optional: Sequence[str] = (),
) -> str:
    """
    Return rows as text, in columns as wide as their longest word, two spaces apart.

    :param width: maximum characters of a line; 0: no maximum.
    :param optional: columns that may be omitted. They are omitted in this order until a line fits
        into ``width``. A column without any value is always omitted.
    """
    empty = {name for column, name in enumerate(header) if name in optional
             and all(row[column] in ('', NONE) for row in rows)}
    omissible = [name for name in optional if name not in empty]
    while True:
        keep = [column for column, name in enumerate(header) if name not in empty]
        text = _columns([[one_line(row[column]) for column in keep] for row in [header, *rows]])
        if not width or not omissible or max(map(len, text)) <= width:
            return '\n'.join(text)
        empty.add(omissible.pop(0))


def terminal_width() -> int:
    """Return the characters in a line of the terminal, 0 if stdout is no terminal."""
    return shutil.get_terminal_size((0, 0)).columns if sys.stdout.isatty() else 0


def _columns(lines: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[column]) for row in lines) for column in range(len(lines[0]))]
    return ['  '.join(word.ljust(width) for word, width in zip(row, widths)).rstrip()
            for row in lines]


def duration(seconds: Optional[float]) -> str:
    """Return seconds as text with at most two units, ``-`` for None."""
    if seconds is None:
        return NONE
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


def milliseconds(time: Optional[float]) -> str:
    """Return a round trip as text, ``-`` for None."""
    return NONE if time is None else f'{time:.{0 if time >= 10 else 1}f} ms'


def cost(dollars: Optional[Decimal], places: int = 4) -> str:
    """Return US dollars with ``places`` decimal places, ``-`` for None."""
    return NONE if dollars is None else f'${dollars.quantize(Decimal(1).scaleb(-places))}'

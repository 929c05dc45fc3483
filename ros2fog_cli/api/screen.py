# SPDX-License-Identifier: Apache-2.0
"""Draw a machine's state in the terminal, or print it as lines where no terminal is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import contextlib
from decimal import Decimal
import os
from typing import Any, TextIO

from fogros2 import feature
from fogros2.report import redraws, size
from fogros2.untrusted import one_line
from ros2fog_cli.api.output import uncleaned
from ros2fog_cli.api.table import (
    agent,
    cost,
    CROSSING,
    crossing,
    duration,
    link,
    NODES,
    nodes,
    table,
)

#: Enter and leave the alternate screen; meanwhile the cursor is hidden and long lines are cut,
#: as the number of characters is no limit (a character may be two columns wide).
_ENTER, _LEAVE = '\x1b[?1049h\x1b[?25l\x1b[?7l', '\x1b[?7h\x1b[?25h\x1b[?1049l'
_HOME, _REST, _LINE = '\x1b[H', '\x1b[J', '\x1b[K'
#: SGR codes: bold, dim, and the colours of states.
_STYLES = {'bold': '1', 'dim': '2', 'good': '32', 'busy': '36', 'warning': '33', 'bad': '31'}
_OF_STATE = {
    'running': 'good', 'done': 'good', 'coming': 'busy', 'starting': 'busy', 'ending': 'busy',
    'exited': 'dim', 'gone': 'dim', 'failed': 'bad', 'refused': 'bad', 'live': 'good',
    'left out': 'busy', 'died': 'bad'}
_WORDS = {'coming': 'coming up'}

Paint = Callable[[str, str], str]


def painter(stream: TextIO) -> Paint:
    """Return a function that adds a style to a text, if the stream and the user allow colours."""
    if not redraws(stream) or os.environ.get('NO_COLOR'):
        return plain

    def paint(text: str, style: str) -> str:
        return f'\x1b[{_STYLES[style]}m{text}\x1b[0m' if style in _STYLES else text

    return paint


def plain(text: str, style: str) -> str:
    """Return the text without a style."""
    return text


def frame(
    machine: dict[str, Any], lines: Sequence[dict[str, Any]], now: float, *, columns: int = 80,
    rows: int = 24, paint: Paint = plain,
) -> list[str]:
    """
    Return at most ``rows`` lines of at most ``columns`` characters.

    :param machine: data of :func:`ros2fog_cli.api.shown.machine_json`, and ``streams`` and
        ``topics`` of its launch if they are known.
    :param lines: the machine's log, of which the last lines are shown.
    :param now: the time in seconds since the epoch.
    """
    parts: list[tuple[str, str]] = [
        (f"{machine['name']} ({machine['provider']} {(machine['id'] or '-')[:20]})  "
         f'{_word(machine["phase"])}{_more(machine, now)}', 'bold')]
    parts += [(f'{name:10}  {text}', '') for name, text in _about(machine, now)]
    parts += [(f'! {text}', 'bad') for text in (
        *machine['problems'], *([machine['trouble']] if machine['trouble'] else []))]
    if machine['steps']:
        parts.append(('', ''))
        parts += _table(('STEP', 'STATE', 'SECONDS', ''), [
            (step['step'], step['state'], _seconds(step, now), _detail(step))
            for step in machine['steps']], column=1)
    if machine['nodes']:
        parts.append(('', ''))
        parts += _table(NODES, nodes(machine['nodes']), column=1)
    for name, each in feature.tables().items():
        if machine.get(name):
            parts.append(('', ''))
            parts += _table(each.headings, list(map(each.row, machine[name])), column=1)
    topics = crossing(machine['name'], machine.get('streams', ()), machine.get('topics', ()))
    if topics:
        parts.append(('', ''))
        parts += _table(CROSSING, topics, column=0)
    room = rows - len(parts) - 1
    if lines and room > 0:
        parts.append(('', ''))
        parts += [(f"[{each['node']}] {each['text']}" if each['node'] else each['text'], 'dim')
                  for each in lines[-room:]]
    # Clean and cut the text before it is painted: escape sequences take no columns.
    return [paint(one_line(text)[:columns], style) for text, style in parts[:rows]]


def _more(machine: dict[str, Any], now: float) -> str:
    text = ''
    if machine['created'] is not None:
        text += f"  {duration(max(0.0, (machine['ended'] or now) - machine['created']))}"
    if machine['cost_per_hour'] is not None and machine['created'] is not None:
        rate = Decimal(machine['cost_per_hour'])
        spent = rate * Decimal(max(0.0, now - machine['created'])) / 3600
        text += f'  {cost(spent, 4)} so far'
    return text


def _about(machine: dict[str, Any], now: float) -> Iterator[tuple[str, str]]:
    where = '  '.join(machine[key] for key in ('address', 'place', 'kind') if machine[key])
    if where:
        yield 'address', where
    launch = f"{machine['launch']}, process {machine['launch_pid']}" \
        if machine['launch_alive'] else f"{machine['launch'] or '-'} (over)"
    remaining = '' if machine['expires'] is None \
        else f", {duration(machine['expires'] - now)} left"
    yield 'launch', launch + remaining
    vpn, state = machine['vpn'], machine['agent']
    if vpn is not None:
        yield from link(vpn, None if vpn['handshake'] is None
                        else max(0.0, now - vpn['handshake']))
    if machine['clock'] is not None:
        yield 'clock', machine['clock']['text']
    if state is not None:
        yield agent(now - (state['since'] or now), state['rss'] or 0, state['heartbeat_age'])


def _word(state: str) -> str:
    return _WORDS.get(state, state)


def _seconds(step: dict[str, Any], now: float) -> str:
    if step['seconds'] is not None:
        return f"{step['seconds']:.2f}"
    return f"{max(0.0, now - step['begin']):.1f}" if step['state'] == 'running' else '-'


def _detail(step: dict[str, Any]) -> str:
    if step['state'] == 'running' and step['done']:
        return f"{size(step['done'])}" + (f" of {size(step['total'])}" if step['total'] else '')
    return str(step['detail'])


def _table(
    header: Sequence[str], rows: Sequence[Sequence[str]], *, column: int,
) -> list[tuple[str, str]]:
    styles = ['dim', *(_OF_STATE.get(row[column], '') for row in rows)]
    return list(zip(table(header, rows).split('\n'), styles))


def summary(machine: dict[str, Any]) -> str:
    """Return a line with the rarely changing parts of the state, for a file or a pipe."""
    parts = [_word(machine['phase'])]
    parts += [f"{step['step']} {step['state']}"
              + (f" after {step['seconds']:.2f} s" if step['seconds'] is not None else '')
              for step in machine['steps'][-1:]]
    parts += [f"{node['name']} {node['state']}"
              + (f", {node['restarts']} restarts" if node['restarts'] else '')
              for node in machine['nodes']]
    return one_line(f"{machine['name']}: " + '; '.join([*parts, *machine['problems']]))


@contextlib.contextmanager
def alternate(stream: TextIO) -> Iterator[Callable[[Sequence[str]], None]]:
    """Yield a function that draws lines in the alternate screen; leave that screen at the end."""
    stream = uncleaned(stream)
    stream.write(_ENTER)

    def draw(lines: Sequence[str]) -> None:
        stream.write(_HOME + '\r\n'.join(f'{each}{_LINE}' for each in lines) + _REST)
        stream.flush()

    try:
        yield draw
    finally:
        stream.write(_LEAVE)
        stream.flush()

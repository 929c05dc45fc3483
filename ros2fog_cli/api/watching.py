# SPDX-License-Identifier: Apache-2.0
"""Show a machine's state until Ctrl-C, for ``ros2 fog status --watch``."""

from __future__ import annotations

import contextlib
import select
import shutil
import sys
import time
from typing import Any, Optional

from fogros2.errors import DeadlineExceeded
from fogros2.report import redraws
from fogros2.store import check_name
from fogros2.waiting import wait_until
from ros2fog_cli.api import output, screen
from ros2fog_cli.api.live import Live, PRESENT

#: Seconds between two drawings, and time-out of the measurement of stream rates.
INTERVAL, TIMEOUT = 1.0, 10.0
_WAITING = 'no such machine yet'


def watch(
    name: str, *, regions: Optional[list[str]] = None, as_json: bool = False, topics: bool = False,
) -> int:
    """
    Show a machine's state every second; print only changes to a pipe or a file.

    :param as_json: print a line of JSON for each change instead.
    :param topics: whether a node joins the launch to measure the rates of topics.
    :raises ConfigurationError: ``name`` is no valid machine name.
    """
    check_name(name)
    live = Live(name=name, regions=regions, topics=topics)
    live.start()
    try:
        if as_json or not redraws(sys.stdout):
            _lines(live, name, as_json)
        else:
            _screen(live, name)
    except (KeyboardInterrupt, BrokenPipeError):
        pass  # the user ends the watch
    finally:
        live.close()
    return 0


def streams(name: str, *, regions: Optional[list[str]] = None) -> list[dict[str, Any]]:
    """
    Return the streams to and from a machine, with the data of the dashboard.

    A node joins the launch for a few seconds to measure the rates.
    """
    live = Live(name=name, regions=regions, topics=True)
    rows: list[dict[str, Any]] = []
    begin = time.monotonic()

    def measured() -> bool:
        rows[:] = [one for one in live.state().get('streams', [])
                   if name in (one['source'], one['target'])]
        # Discovery takes time: a stream without subscribers may have one that is not known yet.
        settled = time.monotonic() - begin > TIMEOUT / 2
        return bool(rows) and all(
            one['rate'] is not None or settled and one['note'] for one in rows)

    live.start()
    try:
        with contextlib.suppress(DeadlineExceeded):
            wait_until(measured, timeout=TIMEOUT, what='the rates of streams')
    finally:
        live.close()
    # these are for the dashboard's pictures
    return [{key: value for key, value in one.items() if key not in ('id', 'picture')}
            for one in rows]


def _machine(state: dict[str, Any], name: str) -> Optional[dict[str, Any]]:
    # Of several machines of one name, prefer the one that a launch uses.
    machine = max((one for one in state.get('machines', []) if one['name'] == name),
                  key=lambda one: bool(one['launch_alive']), default=None)
    return None if machine is None else {
        **machine, **{key: state[key] for key in ('streams', 'topics') if key in state},
        'problems': [*machine['problems'], *state.get('graph_trouble', [])]}


def _lines(live: Live, name: str, as_json: bool) -> None:
    last: Optional[str] = None
    version = -1
    while True:
        # Often enough to count as present.
        state = live.state(version, PRESENT / 20)
        version = state['version']
        machine = _machine(state, name)
        if as_json:
            text = output.as_json({'machine': machine}, indent=None)
        else:
            text = screen.summary(machine) if machine is not None else f'{name}: {_WAITING}'
        if text != last and version > 0:
            last = text
            print(text if as_json else f'{time.strftime("%H:%M:%S")} {text}', flush=True)
        if _unheard():
            raise BrokenPipeError


def _unheard() -> bool:
    """Return whether the reader of the pipe is gone; without changes, no write would notice it."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))


def _screen(live: Live, name: str) -> None:
    paint = screen.painter(sys.stdout)
    with screen.alternate(sys.stdout) as draw:
        while True:
            begin = time.monotonic()
            state = live.state()
            columns, rows = shutil.get_terminal_size()
            machine = _machine(state, name)
            if machine is None:
                shown = [f'{name}: {_WAITING}']
            else:
                shown = screen.frame(machine, live.log(machine['key'], 0), state['now'],
                                     columns=columns, rows=rows - 1, paint=paint)
            foot = f'{time.strftime("%H:%M:%S")}; Ctrl-C leaves'
            draw([*shown, *[''] * (rows - 1 - len(shown)), paint(foot[:columns], 'dim')])
            time.sleep(max(0.05, INTERVAL - (time.monotonic() - begin)))

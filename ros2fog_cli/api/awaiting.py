# SPDX-License-Identifier: Apache-2.0
"""Wait for a state of a machine."""

from __future__ import annotations

from collections.abc import Sequence
import functools
from typing import Optional

from fogros2 import journal
from fogros2.errors import ConfigurationError
from fogros2.store import check_name, launch_process, Store
from fogros2.waiting import wait_until
from ros2fog_cli.api import machines, shown


def up(name: str, timeout: float) -> None:
    """
    Wait until a launch of this robot has brought a machine up; it need not exist yet.

    :param timeout: in seconds.
    :raises ConfigurationError: its launch ended meanwhile.
    :raises DeadlineExceeded: after ``timeout`` seconds.
    """
    store, seen = Store(), ''
    check_name(name)

    def probe() -> bool:
        nonlocal seen
        record = machines.recorded(store, name).get(name)
        if record is None or not record.launch or not record.launch_alive:
            # the record is away for a moment while the launch replaces the machine
            if seen and not launch_process(store.root / 'launches' / seen)[1]:
                raise ConfigurationError(f"the launch of '{name}' ended before it was up",
                                         'its own output says why')
            return False
        seen = record.launch
        steps = journal.read(store.root / 'launches' / record.launch).steps
        return shown.phase(tuple(step for step in steps if step.machine == name)) == 'running'

    wait_until(probe, timeout=timeout, interval=0.1, what=f"'{name}'",
               hint=f'ros2 fog status {name} shows its state')


def gone(
    name: str, timeout: float, warn: machines.Warn, *, regions: Optional[Sequence[str]] = None,
) -> None:
    """
    Wait until neither this robot nor a provider that answers knows a machine of that name.

    :param timeout: in seconds.
    :param warn: receives the error of a provider that cannot be asked, once.
    :raises DeadlineExceeded: after ``timeout`` seconds.
    """
    store = Store()
    check_name(name)
    once = functools.lru_cache(maxsize=None)(warn)

    def probe() -> bool:
        if store.exists(name):
            return False
        entries = machines.survey(once, name=name, regions=regions, store=store)
        return not any(entry.own and not entry.gone for entry in entries)

    wait_until(probe, timeout=timeout, interval=0.2, longest=10.0, what=f"the end of '{name}'",
               hint=f'ros2 fog delete {name} ends it')

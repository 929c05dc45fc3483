# SPDX-License-Identifier: Apache-2.0
"""
Give the other modules access to private parts of launch, and say why each is needed.

launch has no seam for "start the process elsewhere": ``ExecuteLocal.execute`` resolves the
action, registers its handlers and then creates a task from its private method
``__execute_process``. That method is the seam here. A cloud process overrides it and sets
``_subprocess_transport`` and ``_subprocess_protocol``; a robot process that waits for the cloud
runs it later. All the rest (substitutions, handlers, output, ``on_exit``, signals) stays launch's
own code. The options that the method reads have no getters.

Three other modules use private parts directly: ``remote`` and ``carriers`` override
``_ExecuteLocal__execute_process``, ``remote`` also ``_shutdown_process``, in classes derived from
ExecuteLocal; ``census`` goes through the event handlers of the context. ``wrapping`` and
``components`` replace public methods of single objects.

The names are those of Jazzy (launch 3.4) and the same in its embedded default;
``test/unit/test_actions_private.py`` looks for each.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
import dataclasses
import functools
from typing import Any, Optional

from launch import LaunchContext, LaunchDescription, LaunchDescriptionSource
from launch.actions import ExecuteLocal, TimerAction
from launch.utilities import AsyncSafeSignalManager

#: The method of ExecuteLocal that starts the process and awaits its end.
EXECUTE_PROCESS = '_ExecuteLocal__execute_process'
#: The coroutine method of TimerAction that waits, then fires.
WAIT_TO_FIRE = '_wait_to_fire_event'

Waiting = Callable[[LaunchContext], Coroutine[Any, Any, None]]


@dataclasses.dataclass(frozen=True)
class Options:
    """What an ExecuteLocal was told and keeps to itself."""

    respawn: bool
    respawn_delay: float
    respawn_max_retries: int
    log_cmd: bool


def options(action: ExecuteLocal) -> Options:
    """Return a prepared action's options (``prepare`` resolves ``respawn`` to a bool)."""
    return Options(
        respawn=bool(_private(action, 'respawn')),
        respawn_delay=_private(action, 'respawn_delay') or 0.0,
        respawn_max_retries=_private(action, 'respawn_max_retries'),
        log_cmd=_private(action, 'log_cmd'))


def prefix_output(action: ExecuteLocal, machine: str) -> None:
    """Put the machine's name before the process's where the output format names the process."""
    name = '{this.process_description.final_name}'
    before: str = _private(action, 'output_format')
    # a name has no braces, so it is safe in a format
    vars(action)['_ExecuteLocal__output_format'] = before.replace(name, f'{machine}.{name}')


def unprefix_output(action: ExecuteLocal, machine: str) -> None:
    """Take the machine's name away again."""
    name = '{this.process_description.final_name}'
    before: str = _private(action, 'output_format')
    vars(action)['_ExecuteLocal__output_format'] = before.replace(f'{machine}.{name}', name)


def _private(action: ExecuteLocal, name: str) -> Any:
    return getattr(action, f'_ExecuteLocal__{name}')


def completed(action: ExecuteLocal) -> Optional[asyncio.Future[Any]]:
    """Return what is done once the process has ended, None before the action's execution."""
    future: Optional[asyncio.Future[Any]] = _private(action, 'completed_future')
    return future


def execute_process(action: ExecuteLocal) -> Waiting:
    """Return the bound method that starts the process and awaits its end."""
    bound: Waiting = getattr(action, EXECUTE_PROCESS)
    return bound


def set_transport(action: ExecuteLocal, process: object) -> None:
    """
    Make ``process`` what the action takes for its subprocess.

    launch calls ``send_signal``, ``kill``, ``get_returncode`` and looks at ``complete``.
    """
    vars(action).update(_subprocess_transport=process, _subprocess_protocol=process)


def transport(action: ExecuteLocal) -> Any:
    """Return what the action takes for its subprocess, None before it has one."""
    return action._subprocess_transport


def replace(entity: Any, method: str, replacement: Waiting) -> None:
    """Replace a method of one object, not of its class."""
    if not hasattr(type(entity), method):
        raise AttributeError(f'{type(entity).__name__} of this launch has no {method}')
    setattr(entity, method, replacement)


def wait_to_fire(timer: TimerAction) -> Waiting:
    """Return the bound method that waits for the timer's period."""
    bound: Waiting = getattr(timer, WAIT_TO_FIRE)
    return bound


def replace_reader(
    source: LaunchDescriptionSource,
    reader: Callable[[Callable[[str], LaunchDescription], str], LaunchDescription],
) -> None:
    """
    Have a source of a launch description read its launch file with a function.

    :param reader: called with the function that read the file before, and the file's path.
    """
    vars(source)['_get_launch_description'] = functools.partial(
        reader, source._get_launch_description)


def components(action: Any) -> list[Any]:
    """Return the descriptions of the nodes that a LoadComposableNodes loads."""
    found: list[Any] = list(vars(action)['_LoadComposableNodes__composable_node_descriptions'])
    return found


def set_remappings(component: Any, rules: Any) -> None:
    """Give a ComposableNode other remappings, in launch_ros's normal form; it reads them alone."""
    names = [name for name in vars(component) if name.endswith('remappings')]
    vars(component)[names[0]] = rules


def kept_environments(context: LaunchContext) -> list[dict[str, str]]:
    """
    Return the copies of the environment that launch comes back to, to be changed in place.

    A scoped group returns to one at its end, ResetEnvironment to another; what the launch as a
    whole needs has to be in them.
    """
    found: list[dict[str, str]] = []
    for name, value in vars(context).items():
        if 'environment' in name:
            found += [kept for kept in (value if isinstance(value, list) else [value])
                      if isinstance(kept, dict)]
    return found


def signal_manager() -> Optional[AsyncSafeSignalManager]:
    """
    Return the manager in which the running LaunchService handles signals.

    Its handler for SIGTERM cancels the service on the spot; there is no public way to replace it.
    """
    name = '_AsyncSafeSignalManager__current'
    manager: Optional[AsyncSafeSignalManager] = getattr(AsyncSafeSignalManager, name)
    return manager

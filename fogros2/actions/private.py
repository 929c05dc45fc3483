# SPDX-License-Identifier: Apache-2.0
"""
Give the other modules access to private parts of launch, and say why each is needed.

launch has no public extension point to start a process elsewhere. ``ExecuteLocal.execute``
resolves the action, registers its handlers and then creates a task from its private method
``__execute_process``. FogROS2 extends launch at that method. A cloud process overrides it and
sets ``_subprocess_transport`` and ``_subprocess_protocol``; a robot process that waits for the
cloud calls it later. Everything else (substitutions, handlers, output, ``on_exit``, signals)
stays launch's own code. The options that the method reads have no getters.

Other modules use private parts directly. ``remote`` and ``carriers`` override
``_ExecuteLocal__execute_process``, ``remote`` also ``_shutdown_process``, in classes derived from
ExecuteLocal. ``census`` reads the event handlers of the context. ``wrapping`` and
``components`` replace public methods of single objects.

The names are those of Jazzy (launch 3.4), which the embedded default shares;
``test/unit/test_actions_private.py`` checks each name.
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
    """Options of an ExecuteLocal that have no getter."""

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
    """Put the machine's name before the process's name in the output format."""
    name = '{this.process_description.final_name}'
    before: str = _private(action, 'output_format')
    # a machine's name contains no braces, so it is safe in a format string
    vars(action)['_ExecuteLocal__output_format'] = before.replace(name, f'{machine}.{name}')


def unprefix_output(action: ExecuteLocal, machine: str) -> None:
    """Remove the machine's name from the output format."""
    name = '{this.process_description.final_name}'
    before: str = _private(action, 'output_format')
    vars(action)['_ExecuteLocal__output_format'] = before.replace(f'{machine}.{name}', name)


def _private(action: ExecuteLocal, name: str) -> Any:
    return getattr(action, f'_ExecuteLocal__{name}')


def completed(action: ExecuteLocal) -> Optional[asyncio.Future[Any]]:
    """Return the future of the process's end, None before the action's execution."""
    future: Optional[asyncio.Future[Any]] = _private(action, 'completed_future')
    return future


def execute_process(action: ExecuteLocal) -> Waiting:
    """Return the bound method that starts the process and awaits its end."""
    bound: Waiting = getattr(action, EXECUTE_PROCESS)
    return bound


def set_transport(action: ExecuteLocal, process: object) -> None:
    """
    Make an action use ``process`` as its subprocess.

    launch calls ``send_signal``, ``kill``, ``get_returncode`` and reads ``complete``.
    """
    vars(action).update(_subprocess_transport=process, _subprocess_protocol=process)


def transport(action: ExecuteLocal) -> Any:
    """Return the object that the action uses as its subprocess, None if there is none yet."""
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
    Make a source of a launch description read its launch file by a function.

    :param reader: called with the function that read the file before, and the file's path.
    """
    vars(source)['_get_launch_description'] = functools.partial(
        reader, source._get_launch_description)


def components(action: Any) -> list[Any]:
    """Return the descriptions of the nodes that a LoadComposableNodes loads."""
    found: list[Any] = list(vars(action)['_LoadComposableNodes__composable_node_descriptions'])
    return found


def set_remappings(component: Any, rules: Any) -> None:
    """Set the remappings of a ComposableNode, in launch_ros's normal form."""
    names = [name for name in vars(component) if name.endswith('remappings')]
    vars(component)[names[0]] = rules


def kept_environments(context: LaunchContext) -> list[dict[str, str]]:
    """
    Return the saved environments that launch restores, so that callers can change them.

    A scoped group restores one at its end, ResetEnvironment another. Variables of the whole
    launch have to be in all of them.
    """
    found: list[dict[str, str]] = []
    for name, value in vars(context).items():
        if 'environment' in name:
            found += [kept for kept in (value if isinstance(value, list) else [value])
                      if isinstance(kept, dict)]
    return found


def signal_manager() -> Optional[AsyncSafeSignalManager]:
    """
    Return the signal manager of the running LaunchService.

    Its SIGTERM handler cancels the service at once; launch has no public way to replace it.
    """
    name = '_AsyncSafeSignalManager__current'
    manager: Optional[AsyncSafeSignalManager] = getattr(AsyncSafeSignalManager, name)
    return manager

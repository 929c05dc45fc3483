# SPDX-License-Identifier: Apache-2.0
"""Each private part of launch that is used is there, and does what it is used for."""

from __future__ import annotations

import ast
import asyncio
import inspect
from pathlib import Path

from launch import LaunchContext, LaunchService
from launch.actions import ExecuteLocal, ExecuteProcess, TimerAction
from launch.utilities import AsyncSafeSignalManager
import pytest

from fogros2.actions import private


def test_methods():
    assert inspect.iscoroutinefunction(getattr(ExecuteLocal, private.EXECUTE_PROCESS))
    assert inspect.iscoroutinefunction(getattr(TimerAction, private.WAIT_TO_FIRE))
    assert list(inspect.signature(ExecuteLocal._shutdown_process).parameters) == [
        'self', 'context', 'send_sigint']


def test_options():
    action = ExecuteProcess(
        cmd=['true'], respawn=True, respawn_delay=2.0, respawn_max_retries=3, log_cmd=True)
    action.prepare(LaunchContext())
    assert private.options(action) == private.Options(True, 2.0, 3, True)
    assert private.transport(action) is None


def test_completed():
    loop = asyncio.new_event_loop()
    context = LaunchContext()
    context._set_asyncio_loop(loop)
    action = ExecuteProcess(cmd=['true'])
    assert private.completed(action) is None
    private.replace(action, private.EXECUTE_PROCESS, _do_nothing)
    action.execute(context)
    assert private.completed(action) is action.get_asyncio_future() is not None
    loop.run_until_complete(asyncio.gather(*asyncio.all_tasks(loop)))
    loop.close()


async def _do_nothing(context: LaunchContext) -> None:
    """Start no process."""


def test_output_format():
    action = ExecuteProcess(cmd=['true'])
    private.prefix_output(action, 'planner')
    assert vars(action)['_ExecuteLocal__output_format'] == (
        '[planner.{this.process_description.final_name}] {line}')


def test_a_missing_method_is_noticed():
    with pytest.raises(AttributeError, match='__no_such'):
        private.replace(ExecuteProcess(cmd=['true']), '__no_such', None)


def test_kept_environments():
    context = LaunchContext()
    before = len(private.kept_environments(context))
    assert before >= 1  # what ResetEnvironment returns to
    context._push_environment()
    assert len(private.kept_environments(context)) == before + 1
    context._pop_environment()


def test_the_signal_manager():
    assert private.signal_manager() is None
    loop = asyncio.new_event_loop()
    with AsyncSafeSignalManager(loop) as manager:
        assert private.signal_manager() is manager
    assert private.signal_manager() is None
    loop.close()


def test_handlers_of_the_context_can_be_gone_through():
    context = LaunchService().context
    assert len(tuple(context._event_handlers)) >= 2


def test_remappings_of_components():
    pytest.importorskip('launch_ros', reason='launch_ros is not installed')
    from launch_ros.actions import LoadComposableNodes
    from launch_ros.descriptions import ComposableNode
    node = ComposableNode(package='demo', plugin='demo::View', remappings=[('a', 'b')])
    load = LoadComposableNodes(target_container='/box', composable_node_descriptions=[node])
    assert private.components(load) == [node]
    before = node.remappings
    private.set_remappings(node, None)
    assert node.remappings is None
    private.set_remappings(node, before)
    assert node.remappings is before


def test_other_users_of_private_parts_are_named():
    objects = (LaunchContext(), ExecuteProcess(cmd=['true']), TimerAction(period=1.0, actions=[]))
    parts = {name for thing in objects for name in dir(thing)
             if name.startswith('_') and not name.startswith('__')}
    users = set()
    for path in Path(private.__file__).parent.rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            if {getattr(node, 'attr', None), getattr(node, 'name', None)} & parts:
                users.add(path.stem)
    assert users == {'private', 'remote', 'carriers', 'census'}
    assert all(f'``{user}``' in private.__doc__ for user in users - {'private'})

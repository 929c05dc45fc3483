# SPDX-License-Identifier: Apache-2.0
"""Each private part of launch that is used is there, and does what it is used for."""

from __future__ import annotations

import ast
import asyncio
import inspect
from pathlib import Path

from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import ExecuteLocal, ExecuteProcess, RegisterEventHandler, TimerAction
from launch.event_handlers import OnProcessExit, OnProcessIO, OnProcessStart
import pytest

from fogros2.launch_internals import components, private


def test_methods():
    assert inspect.iscoroutinefunction(getattr(ExecuteLocal, private.EXECUTE_PROCESS))
    assert inspect.iscoroutinefunction(getattr(TimerAction, private.WAIT_TO_FIRE))
    assert list(inspect.signature(ExecuteLocal._shutdown_process).parameters) == [
        'self', 'context', 'send_sigint']


@pytest.mark.parametrize('begins', [True, False])
def test_delayed_process_starts_only_if_allowed(begins):
    loop = asyncio.new_event_loop()
    context = LaunchContext()
    context._set_asyncio_loop(loop)
    action = ExecuteProcess(cmd=['true'])
    started = []

    async def start(context):
        started.append(context)

    async def until():
        return begins

    setattr(action, private.EXECUTE_PROCESS, start)
    private.delay_start(action, until)
    action.execute(context)
    loop.run_until_complete(asyncio.gather(*asyncio.all_tasks(loop)))
    assert (bool(started), private.completed(action).done()) == (begins, not begins)
    loop.close()


def test_kept_environments():
    context = LaunchContext()
    before = len(private.kept_environments(context))
    assert before >= 1  # what ResetEnvironment returns to
    context._push_environment()
    assert len(private.kept_environments(context)) == before + 1
    context._pop_environment()


def test_remappings_of_components():
    pytest.importorskip('launch_ros', reason='launch_ros is not installed')
    from launch_ros.actions import LoadComposableNodes
    from launch_ros.descriptions import ComposableNode
    node = ComposableNode(package='demo', plugin='demo::View', remappings=[('a', 'b')])
    load = LoadComposableNodes(target_container='/box', composable_node_descriptions=[node])
    assert components.of(load) == [node]
    before = node.remappings
    components.set_remappings(node, None)
    assert node.remappings is None
    components.set_remappings(node, before)
    assert node.remappings is before


def test_other_packages_use_no_private_parts():
    objects = (LaunchContext(), ExecuteProcess(cmd=['true']), TimerAction(period=1.0, actions=[]))
    parts = {name for thing in objects for name in dir(thing)
             if name.startswith('_') and not name.startswith('__')}
    fogros2 = Path(private.__file__).parents[1]
    for path in fogros2.rglob('*.py'):
        if path.parent.name != 'launch_internals':
            used = {getattr(node, 'attr', None) or getattr(node, 'name', None)
                    for node in ast.walk(ast.parse(path.read_text()))} & parts
            # a class may have private parts of its own
            assert not {name for name in used if f'self.{name}' not in path.read_text()}, path


@pytest.mark.parametrize('ends_by', ['INT', 'TERM'])
def test_a_stay_ends_without_notice(ends_by, tmp_path):
    """The launch sees neither an exit nor a new start, and still waits for the process."""
    ignored = "trap '' INT; " if ends_by == 'TERM' else ''
    action = ExecuteProcess(
        cmd=['sh', '-c', f'{ignored}echo begun; while :; do sleep 0.05; done'], respawn=True)
    service = LaunchService(noninteractive=True)
    context = service.context
    stay = private.Stay(action, context)
    start = getattr(action, private.EXECUTE_PROCESS)
    setattr(action, private.EXECUTE_PROCESS, lambda given: start(stay))
    seen = []

    async def leave():
        future = private.completed(action)
        await stay.leave(0.3, 5.0)
        assert private.completed(action) is future and not future.done()
        assert stay.is_shutdown and not context.is_shutdown
        future.set_result(None)

    service.include_launch_description(LaunchDescription([
        RegisterEventHandler(OnProcessIO(on_stdout=lambda event: context.asyncio_loop.create_task(
            leave()) and None)),
        RegisterEventHandler(OnProcessStart(on_start=lambda event, context: seen.append('start'))),
        RegisterEventHandler(OnProcessExit(on_exit=lambda event, context: seen.append('exit'))),
        action]))
    assert service.run() == 0 and seen == ['start']

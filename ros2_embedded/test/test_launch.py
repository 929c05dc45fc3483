# SPDX-License-Identifier: Apache-2.0
"""launch's events, actions and handlers, through ROS 2's public API alone."""

import asyncio
import importlib.util
import inspect
import os
import re
import sys
import textwrap

import launch
from launch import LaunchContext, LaunchDescription, LaunchIntrospector, LaunchService
from launch.actions import (
    AppendEnvironmentVariable,
    DeclareLaunchArgument,
    EmitEvent,
    ExecuteProcess,
    GroupAction,
    IncludeLaunchDescription,
    LogInfo,
    OpaqueFunction,
    PopEnvironment,
    PopLaunchConfigurations,
    PushEnvironment,
    PushLaunchConfigurations,
    RegisterEventHandler,
    ResetLaunchConfigurations,
    SetEnvironmentVariable,
    SetLaunchConfiguration,
    Shutdown,
    TimerAction,
    UnsetEnvironmentVariable,
    UnsetLaunchConfiguration,
)
from launch.conditions import (
    evaluate_condition_expression,
    IfCondition,
    InvalidConditionExpressionError,
    UnlessCondition,
)
from launch.event_handlers import event_named, OnProcessExit, OnShutdown
from launch.launch_description_sources import (
    AnyLaunchDescriptionSource,
    InvalidLaunchFileError,
    PythonLaunchDescriptionSource,
)
from launch.substitutions import (
    LaunchConfiguration,
    TextSubstitution,
    ThisLaunchFile,
    ThisLaunchFileDir,
)
import pytest

pytestmark = pytest.mark.usefixtures('own_log')


def run(*entities, service=None):
    service = service or LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription(entities))
    return service.run()


def note(notes, what):
    """Return an action that appends a value, or the values of configurations, to a list."""
    return OpaqueFunction(function=lambda context: notes.append(
        what(context) if callable(what) else what))


def configuration(name):
    return lambda context: context.launch_configurations.get(name)


class Asked(launch.Event):
    name = 'test.Asked'


def test_entities_are_visited_depth_first_and_in_order():
    notes = []
    nested = OpaqueFunction(function=lambda context: [note(notes, 2), note(notes, 3)])
    assert run(note(notes, 1), nested, GroupAction([note(notes, 4)]), note(notes, 5)) == 0
    assert notes == [1, 2, 3, 4, 5]


def test_condition_is_evaluated_at_the_visit():
    notes = []

    def conditional(what, condition):
        return OpaqueFunction(function=lambda context: notes.append(what), condition=condition)

    assert run(
        SetLaunchConfiguration('a', 'TRUE'),
        conditional(1, IfCondition(LaunchConfiguration('a'))),
        conditional(2, UnlessCondition(LaunchConfiguration('a'))),
        conditional(3, UnlessCondition('0'))) == 0
    assert notes == [1, 3]


@pytest.mark.parametrize('text, value', [('true', True), (' True', True), ('1', True),
                                         ('FALSE', False), ('0', False)])
def test_condition_text_is_true_or_false(text, value):
    assert evaluate_condition_expression(
        LaunchContext(), [TextSubstitution(text=text)]) is value


def test_unknown_condition_text_is_refused():
    with pytest.raises(InvalidConditionExpressionError, match="expected one of .* got 'maybe'"):
        evaluate_condition_expression(LaunchContext(), [TextSubstitution(text='maybe')])


def test_scoped_group_restores_configurations_and_environment(monkeypatch):
    monkeypatch.setenv('FOG_TEST', 'outer')
    notes = []
    everything = note(notes, lambda context: (
        context.launch_configurations.get('a'), context.launch_configurations.get('b'),
        context.environment.get('FOG_TEST')))

    def inner(**kwargs):
        return GroupAction([
            everything, SetLaunchConfiguration('a', 'inner'),
            SetEnvironmentVariable('FOG_TEST', 'inner')],
            launch_configurations={'b': LaunchConfiguration('a', default='none')}, **kwargs)

    assert run(
        SetLaunchConfiguration('a', 'outer'), inner(), everything,
        inner(forwarding=False), everything, inner(scoped=False), everything) == 0
    assert notes == [
        ('outer', 'outer', 'outer'), ('outer', None, 'outer'),
        (None, 'outer', 'outer'), ('outer', None, 'outer'),
        ('outer', 'outer', 'outer'), ('inner', 'outer', 'inner')]


def test_actions_change_environment_and_configurations(monkeypatch):
    monkeypatch.setenv('FOG_PATH', 'b')
    monkeypatch.setenv('FOG_GONE', 'x')
    monkeypatch.delenv('FOG_NEW', raising=False)
    notes = []
    state = note(notes, lambda context: [
        context.environment.get(name) for name in ('FOG_PATH', 'FOG_GONE', 'FOG_NEW')])
    assert run(
        PushEnvironment(), AppendEnvironmentVariable('FOG_PATH', 'c'),
        AppendEnvironmentVariable('FOG_PATH', 'a', prepend=True, separator='-'),
        AppendEnvironmentVariable('FOG_NEW', 'n'), UnsetEnvironmentVariable('FOG_GONE'),
        state, PopEnvironment(), state,
        SetLaunchConfiguration('a', '1'), PushLaunchConfigurations(),
        UnsetLaunchConfiguration('a'), UnsetLaunchConfiguration('never'),
        note(notes, configuration('a')), PopLaunchConfigurations(),
        ResetLaunchConfigurations({'b': LaunchConfiguration('a')}),
        note(notes, lambda context: dict(context.launch_configurations))) == 0
    assert notes == [['a-b:c', None, 'n'], ['b', 'x', None], None, {'b': '1'}]


def test_declared_arguments_are_checked(capsys):
    notes = []
    assert run(
        SetLaunchConfiguration('given', 'g'),
        DeclareLaunchArgument('given', default_value='d'),
        DeclareLaunchArgument('default', default_value=['d', LaunchConfiguration('given')]),
        note(notes, lambda context: dict(context.launch_configurations))) == 0
    assert notes == [{'given': 'g', 'default': 'dg'}]
    assert run(DeclareLaunchArgument('needed', description='what for')) == 1
    assert run(SetLaunchConfiguration('one', 'c'),
               DeclareLaunchArgument('one', choices=['a', 'b'])) == 1
    out = capsys.readouterr().out
    assert 'Required launch argument "needed" (description: "what for") was not provided' in out
    assert ('Argument "one" provided value "c" is not valid. '
            "Valid options are: ['a', 'b']") in out
    with pytest.raises(RuntimeError, match='is not in provided choices'):
        DeclareLaunchArgument('one', choices=['a', 'b'], default_value='c')
    assert DeclareLaunchArgument('one', choices=['a']).description == "One of: ['a']"


def test_exception_is_logged_in_one_line_and_ends_with_status_1(capsys):
    def fail(context):
        raise ValueError('no good')

    notes = []
    assert run(
        RegisterEventHandler(OnShutdown(on_shutdown=lambda event, context: notes.append(
            event.reason))),
        OpaqueFunction(function=fail), note(notes, 'never')) == 1
    text = 'Caught exception in launch (see debug for traceback): no good'
    assert f'[ERROR] [launch]: {text}' in capsys.readouterr().out.splitlines()
    assert notes == [text]


def test_newest_event_handler_is_called_first():
    notes = []

    def handler(what, **kwargs):
        return launch.EventHandler(
            matcher=event_named(Asked.name), entities=[note(notes, what)], **kwargs)

    gone = handler('gone')
    assert run(
        RegisterEventHandler(handler('first')), RegisterEventHandler(gone),
        OpaqueFunction(function=lambda context: context.unregister_event_handler(gone)),
        RegisterEventHandler(handler('once', handle_once=True)),
        EmitEvent(event=Asked()), EmitEvent(event=Asked())) == 0
    assert notes == ['once', 'first', 'first']


def test_context_locals_end_with_their_event():
    notes = []

    def look(context):
        notes.append((type(context.locals.event).__name__, hasattr(context.locals, 'mine')))
        context.extend_locals({'mine': 1})
        context.extend_globals({'ours': context.get_locals_as_dict().get('ours', 0) + 1})
        notes.append((context.locals.mine, context.locals.ours))

    assert run(
        RegisterEventHandler(launch.EventHandler(
            matcher=event_named(Asked.name), entities=OpaqueFunction(function=look))),
        EmitEvent(event=Asked()), EmitEvent(event=Asked())) == 0
    assert notes == [('Asked', False), (1, 1), ('Asked', False), (1, 2)]
    with pytest.raises(AttributeError, match="does not contain attribute 'nothing'"):
        _ = LaunchContext().locals.nothing


def test_timer_action_runs_and_is_cancelled():
    notes = []
    assert run(
        TimerAction(period=60.0, actions=[note(notes, 'never')]),
        TimerAction(period=TextSubstitution(text='0.05'), actions=[
            note(notes, 'first'), Shutdown(reason='enough')]),
        RegisterEventHandler(OnShutdown(on_shutdown=[note(
            notes, lambda context: context.locals.event.reason)]))) == 0
    assert notes == ['first', 'enough']
    cancelled = TimerAction(period=60.0, actions=[])
    assert run(cancelled, OpaqueFunction(function=lambda context: cancelled.cancel())) == 0
    with pytest.raises(TypeError, match="'TimerAction' expected 'actions'"):
        TimerAction(period=1.0, actions=None)


def test_service_runs_twice_and_takes_events_of_threads():
    service = LaunchService(noninteractive=True)
    notes = []
    assert service.event_loop is None and service.shutdown() is None
    for number in (1, 2):
        asked = launch.EventHandler(
            matcher=event_named(Asked.name), entities=[note(notes, number)], handle_once=True)

        def emit(context):
            context.add_completion_future(context.asyncio_loop.run_in_executor(
                None, service.emit_event, Asked()))

        assert run(RegisterEventHandler(asked), OpaqueFunction(function=emit),
                   service=service) == 0
    assert notes == [1, 2]


def test_launch_runs_and_ends_in_the_loop_of_others():
    """Also where the loop is paused before the shutdown."""
    service = LaunchService(noninteractive=True)

    async def begin():
        service.include_launch_description(LaunchDescription([LogInfo(msg='in loop')]))
        task = asyncio.get_running_loop().create_task(
            service.run_async(shutdown_when_idle=False))
        while service.task is None:
            await asyncio.sleep(0.01)
        assert service.task is task and service.event_loop is not None
        return task

    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    try:
        task = loop.run_until_complete(begin())
        loop.run_until_complete(service.shutdown())
        assert loop.run_until_complete(task) == 0
    finally:
        loop.close()
        asyncio.set_event_loop(asyncio.new_event_loop())


PYTHON_FILE = '''
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetLaunchConfiguration
from launch.substitutions import LaunchConfiguration, ThisLaunchFileDir
def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument('word'),
        SetLaunchConfiguration('said', ['says ', LaunchConfiguration('word')]),
        SetLaunchConfiguration('dir', ThisLaunchFileDir())])
'''


def test_included_launch_file_gets_its_arguments(tmp_path, capsys):
    path = tmp_path / 'inner.launch.py'
    path.write_text(PYTHON_FILE)
    notes = []
    state = note(notes, lambda context: (
        context.launch_configurations['said'], context.launch_configurations['dir']))
    for source in (PythonLaunchDescriptionSource(str(path)), AnyLaunchDescriptionSource(
            [str(tmp_path), '/inner.launch.py']), str(path)):
        assert run(IncludeLaunchDescription(
            source, launch_arguments={'word': 'hello'}.items()), state) == 0
    assert notes == [('says hello', str(tmp_path))] * 3
    assert run(IncludeLaunchDescription(str(path))) == 1
    assert ("Included launch description missing required argument 'word' (description: "
            "'no description given'), given: []") in capsys.readouterr().out


def test_launch_file_knows_its_own_path(tmp_path):
    path = tmp_path / 'a.launch.py'
    path.write_text('import launch\ndef generate_launch_description():\n'
                    '    return launch.LaunchDescription()\n')
    context = LaunchContext()
    with pytest.raises(RuntimeError, match='ThisLaunchFile used outside of a launch file'):
        ThisLaunchFile().perform(context)
    IncludeLaunchDescription(str(path)).execute(context)
    assert ThisLaunchFile().perform(context) == str(path)
    assert ThisLaunchFileDir().perform(context) == str(tmp_path)


@pytest.mark.skipif('path' not in inspect.signature(InvalidLaunchFileError).parameters,
                    reason='ROS 2 reports the errors of all loaders')
@pytest.mark.parametrize('name, content, expected', [
    ('a.py', 'def broken(:', ': SyntaxError: .*line 1'),
    ('a.py', 'x = 1', ": .* required function 'generate_launch_description()'"),
    ('a.py', '\nimport nothing_of_it', ", line 2: ModuleNotFoundError: .* 'nothing_of_it'"),
    ('a.yaml', 'launch:\n- log: {message: a\n', ': ParserError: .*line 3, column 1'),
    ('a.yaml', 'launch:\n\t- log', ': ScannerError: .*line 2, column 1'),
    ('a.yaml', 'launch: []\nother: []', ': RuntimeError: Expected only one root'),
    ('a.yaml', 'launch:\n- log: {message: a}\n- lo: {}', ', line 3: RuntimeError: .*: lo'),
    ('a.yaml', 'launch:\n- group:\n  - log: {mesage: a}', ", line 3: AttributeError: .*'message'"),
    ('a.yaml', 'launch:\n- log: {message: a}\n- log:\n  message: b', ', line 3: .* only one key'),
    ('a.yaml', 'launch:\n- log: {message: $(va a)}', ', line 2: RuntimeError: .*: va'),
    ('a.xml', '<launch>\n</lauch>', ': ParseError: mismatched tag: line 2, column 2'),
    ('a.xml', '<launch><log/></launch>', ": AttributeError: .*'message'")])
def test_mistake_in_launch_file_is_one_line_with_place(tmp_path, name, content, expected, capsys):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InvalidLaunchFileError) as caught:
        AnyLaunchDescriptionSource(str(path)).get_launch_description(LaunchContext())
    text = str(caught.value)
    assert re.fullmatch(re.escape(str(path)) + expected.replace('()', r'\(\)') + '.*', text), text
    assert run(IncludeLaunchDescription(str(path))) == 1
    assert f'{text}\n' in capsys.readouterr().out


def test_circular_include_is_reported(tmp_path, capsys):
    path = tmp_path / 'loop.launch.xml'
    path.write_text('<launch><include file="$(dirname)/loop.launch.xml"/></launch>')
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(300)  # a thousand take seconds
    try:
        assert run(IncludeLaunchDescription(str(path))) == 1
    finally:
        sys.setrecursionlimit(limit)
    assert 'maximum recursion depth exceeded' in capsys.readouterr().out


@pytest.mark.skipif(importlib.util.find_spec('embedded_default') is None, reason='ROS 2 has them')
@pytest.mark.parametrize('name, content, part', [
    ('py', 'from launch.actions import OpaqueCoroutine', 'launch.actions.OpaqueCoroutine'),
    ('py', 'from launch.conditions import LaunchConfigurationEquals', 'LaunchConfigurationEquals'),
    ('py', 'from launch.substitutions import AnonName', 'launch.substitutions.AnonName'),
    ('py', 'from launch.event_handlers import OnExecutionComplete', 'OnExecutionComplete'),
    ('py', 'from launch.events import ExecutionComplete', 'launch.events.ExecutionComplete'),
    ('py', 'from launch_ros.actions import SetUseSimTime', 'launch_ros.actions.SetUseSimTime'),
    ('py', 'from launch_ros.substitutions import Parameter', 'launch_ros.substitutions.Parameter'),
    ('py', 'from launch_ros.parameter_descriptions import Parameter', 'Parameter'),
    ('py', 'from rosidl_runtime_py import message_to_csv', 'rosidl_runtime_py.message_to_csv'),
    ('py', 'import launch.actions.opaque_coroutine', 'launch.actions.OpaqueCoroutine'),
    ('py', 'import launch_ros.actions.ros_timer', 'launch_ros.actions.ROSTimer'),
    *(('py', f'import {module}', module) for module in (
        'composition_interfaces', 'launch_ros.parameters_type', 'launch_testing', 'launch_pytest',
        'rosidl_runtime_py.get_interfaces')),
    ('xml', '<launch><set_use_sim_time value="true"/></launch>', "the action 'set_use_sim_time'"),
    ('xml', '<launch><log message="$(anon x)"/></launch>', "the substitution 'anon'")])
def test_missing_part_names_ros2(tmp_path, name, content, part):
    path = tmp_path / f'asks.launch.{name}'
    path.write_text(content)
    with pytest.raises(InvalidLaunchFileError) as error:
        AnyLaunchDescriptionSource(str(path)).get_launch_description(LaunchContext())
    assert re.search(f'{part}.* is not part of the embedded default; ROS 2 Jazzy has it',
                     str(error.value))


def test_nested_launch_arguments_are_listed(tmp_path):
    path = tmp_path / 'inner.launch.py'
    path.write_text(PYTHON_FILE)
    description = LaunchDescription([
        DeclareLaunchArgument('a'), GroupAction([DeclareLaunchArgument('b')]),
        GroupAction([DeclareLaunchArgument('c')], condition=IfCondition('true')),
        IncludeLaunchDescription(str(path)),
        RegisterEventHandler(OnShutdown(on_shutdown=[])), DeclareLaunchArgument('a')])
    arguments = description.get_launch_arguments()
    assert [(argument.name, argument._conditionally_included) for argument in arguments] == [
        ('a', False), ('b', False), ('c', True), ('word', False)]


def test_deprecated_launch_description_is_reported(capsys):
    description = LaunchDescription(deprecated_reason='old')
    assert (description.deprecated, description.deprecated_reason) == (True, 'old')
    assert run(description) == 0
    assert 'deprecated launch description: old' in capsys.readouterr().out


def test_launch_description_is_printed_as_a_tree():
    process = ExecuteProcess(cmd=['ls', LaunchConfiguration('what')], cwd='/')
    text = LaunchIntrospector().format_launch_description(LaunchDescription([
        LogInfo(msg=['a', 'b']), process, EmitEvent(event=Asked()),
        RegisterEventHandler(OnProcessExit(target_action=process, on_exit=[
            LogInfo(msg='bye')]))]))
    lines = [line.lstrip('│├└─ ') for line in text.splitlines()]
    assert lines[1:4] == [
        "LogInfo('a' + 'b')",
        "ExecuteProcess(cmd=['ls', LaunchConfig('what')], cwd=''/'', env=None, shell=False)",
        "EmitEvent(event='test.Asked')"]
    assert lines[4].startswith("RegisterEventHandler('<launch.event_handlers.")
    assert lines[5].startswith('OnProcessExit(') and lines[6:] == ["LogInfo('bye')"]


def test_module_paths_of_ros2_can_be_imported():
    code = textwrap.dedent('''
        import launch_ros.actions.push_ros_namespace, launch.actions.shutdown_action
        import launch.conditions.if_condition, launch.event_handlers.on_process_io
        import launch.events.process.process_started, launch_ros.substitutions.find_package
        import launch.utilities.class_tools_impl, launch_ros.actions.load_composable_nodes
        import launch_ros.utilities.namespace_utils, launch_ros.utilities.track_node_names
        from launch.actions.execute_process import ExecuteProcess
        from launch.substitutions.launch_configuration import LaunchConfiguration
        import launch
        assert ExecuteProcess is launch.actions.ExecuteProcess
        assert launch.actions.shutdown_action.Shutdown is launch.actions.Shutdown
        try:
            import launch.actions.never_heard_of
        except ModuleNotFoundError:
            pass
        assert not hasattr(launch.actions, 'NeverHeardOf')
    ''')
    assert os.spawnl(os.P_WAIT, sys.executable, sys.executable, '-c', code) == 0


def test_modules_are_found_while_a_thread_imports():
    """As an import would, the name puts another one into the package while it is looked at."""
    class Importing(str):
        def replace(self, *args):
            setattr(launch.actions, f'fogt_{len(seen)}', seen.append(self))
            return str(self)

    seen = []
    names = vars(launch.actions)
    before = set(names)
    names[Importing('fogt')] = None
    try:
        assert importlib.util.find_spec('launch.actions.never_heard_of') is None
    finally:
        for name in names.keys() - before:
            del names[name]

# SPDX-License-Identifier: Apache-2.0
"""A cloud node runs on its machine wherever in the launch it stands, and nowhere else."""

from __future__ import annotations

import functools
import threading

from launch import Action, events, LaunchDescription, LaunchDescriptionSource
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    ExecuteProcess,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
    RegisterEventHandler,
    SetLaunchConfiguration,
    TimerAction,
)
from launch.conditions import IfCondition, UnlessCondition
from launch.event_handlers import OnProcessExit, OnProcessStart
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node, PushROSNamespace, SetParameter
import pytest
import yaml

from fogros2 import CloudGroup, CloudNode, ContainerInstance, FogROSLaunchDescription
from rigs.launching import ends


def cloud_node(planner, **kwargs):
    return CloudNode(machine=planner, package='demo', executable='talker', **kwargs)


def node(**kwargs):
    return Node(package='demo', executable='talker', **kwargs)


DEPTHS = {
    'directly': lambda make: make(),
    'group': lambda make: GroupAction([make()]),
    'condition': lambda make: GroupAction(
        [GroupAction([make()], condition=IfCondition('true'))],
        condition=UnlessCondition('false')),
    'include': lambda make: IncludeLaunchDescription(
        LaunchDescriptionSource(LaunchDescription([make()]), location='included')),
    'function': lambda make: OpaqueFunction(function=lambda context: [make()]),
    'timer': lambda make: TimerAction(period=0.01, actions=[make()]),
    'timer in function': lambda make: OpaqueFunction(
        function=lambda context: [TimerAction(period=0.01, actions=[GroupAction([make()])])]),
    'handler': lambda make: GroupAction([
        RegisterEventHandler(OnProcessExit(
            target_action=lambda action: 'robot' in action.name, on_exit=[make()])),
    ]),
    'handler with a function': lambda make: RegisterEventHandler(OnProcessExit(
        target_action=lambda action: 'robot' in action.name,
        on_exit=lambda event, context: [make()])),
}


def robot_process():
    return ExecuteProcess(cmd=['true'], name='robot')


def at_all_depths(make, **kwargs):
    """Return an entity for each depth, whose process has the depth's name."""
    return [within(functools.partial(make, exec_name=depth, **kwargs))
            for depth, within in DEPTHS.items()]


def depths(fake):
    return sorted(name.rpartition('-')[0] for _, name in fake.noted('start'))


@pytest.mark.parametrize('description', [LaunchDescription, FogROSLaunchDescription])
def test_cloud_node_is_found_at_any_depth(run, fake, planner, description):
    fake.on_start = ends
    assert run(description([*at_all_depths(cloud_node, planner=planner), robot_process()])) == 0
    assert depths(fake) == sorted(DEPTHS)
    assert fake.noted('up') == [('planner',)] and len(fake.noted('down')) == 1


@pytest.mark.parametrize('description', [LaunchDescription, FogROSLaunchDescription])
def test_cloud_group_finds_nodes_at_any_depth(run, fake, planner, description, capfd):
    fake.on_start = ends
    assert run(description([CloudGroup(planner, at_all_depths(node)), robot_process()])) == 0
    assert depths(fake) == sorted(DEPTHS)
    assert 'here' not in capfd.readouterr().out


@pytest.mark.parametrize('depth', DEPTHS)
def test_only_node_of_a_launch_is_found(run, fake, planner, depth):
    """Where nothing else makes the launch engage its machine, or wait."""
    fake.on_start = ends
    assert run(FogROSLaunchDescription([
        DEPTHS[depth](functools.partial(cloud_node, planner)), robot_process()])) == 0
    assert len(fake.noted('start')) == 1


def test_false_conditions_cost_nothing(run, fake, planner):
    description = FogROSLaunchDescription([
        DeclareLaunchArgument('cloud', default_value='false'),
        cloud_node(planner, condition=IfCondition(LaunchConfiguration('cloud'))),
        CloudGroup(planner, [node()], condition=IfCondition(LaunchConfiguration('cloud'))),
        ExecuteProcess(cmd=['true']),
    ])
    assert run(description) == 0
    assert fake.notes == []


def test_on_exit_of_a_group_process_stays_on_the_machine(run, fake, planner):
    fake.on_start = ends
    first = node(on_exit=[node()], exec_name='first')
    assert run(LaunchDescription([CloudGroup(planner, [first])])) == 0
    assert [name.split('-')[0] for _, name in fake.noted('start')] == ['first', 'talker']


def test_timer_beside_a_group_stays_on_the_robot(run, fake, planner, capfd):
    """The timers of a launch share an event handler, which any of them may have registered."""
    fake.on_start = ends
    assert run(LaunchDescription([
        CloudGroup(planner, [TimerAction(period=0.01, actions=[node()])]),
        TimerAction(period=0.02, actions=[ExecuteProcess(
            cmd=['echo', 'on', 'the', 'robot'], output='screen')]),
    ])) == 0
    assert len(fake.noted('start')) == 1
    assert 'on the robot' in capfd.readouterr().out


def test_nested_machines_are_kept(run, fake, planner):
    fake.on_start = ends
    other = ContainerInstance(name='other', ros_workspace='')
    third = ContainerInstance(name='third', ros_workspace='')
    assert run(LaunchDescription([CloudGroup(planner, [
        node(exec_name='a'), cloud_node(other, exec_name='b'),
        GroupAction([CloudGroup(third, [TimerAction(
            period=0.01, actions=[node(exec_name='c')])])]),
    ])])) == 0
    assert sorted((machine, name[0]) for machine, name in fake.noted('start')) == [
        ('other', 'b'), ('planner', 'a'), ('third', 'c')]


def test_group_sends_nodes_of_a_fogros_description(run, fake, planner, capfd):
    fake.on_start = ends
    assert run(LaunchDescription([CloudGroup(planner, [IncludeLaunchDescription(
        LaunchDescriptionSource(FogROSLaunchDescription(at_all_depths(node)), location='x')),
    ]), robot_process()])) == 0
    assert depths(fake) == sorted(DEPTHS)
    assert 'here' not in capfd.readouterr().out


def test_timer_of_a_group_waits_for_the_cloud(run, fake, planner):
    fake.on_start = ends
    fake.waits['planner'] = go = threading.Event()
    other = ContainerInstance(name='other', ros_workspace='')
    assert run(FogROSLaunchDescription([
        cloud_node(planner),
        CloudGroup(other, [TimerAction(period=0.01, actions=[
            OpaqueFunction(function=lambda context: fake.note('fires'))])]),
        OpaqueFunction(function=lambda context: context.asyncio_loop.call_later(0.2, go.set)
                       and None)])) == 0
    assert [note[0] for note in fake.notes if note[0] in ('is up', 'fires')] == ['is up', 'fires']


def test_timer_beside_nested_groups_stays_on_the_robot(run, fake, planner, capfd):
    fake.on_start = ends
    other = ContainerInstance(name='other', ros_workspace='')
    assert run(LaunchDescription([
        CloudGroup(other, [CloudGroup(planner, [TimerAction(period=0.01, actions=[node()])])]),
        TimerAction(period=0.02, actions=[ExecuteProcess(
            cmd=['echo', 'on', 'the', 'robot'], output='screen')]),
    ])) == 0
    assert [machine for machine, _ in fake.noted('start')] == ['planner']
    assert 'on the robot' in capfd.readouterr().out


def test_components_of_an_inner_group_need_no_outer_machine(run, fake, planner):
    class LoadComposableNodes(Action):
        def execute(self, context):
            pass

    other = ContainerInstance(name='other', ros_workspace='')
    assert run(LaunchDescription([CloudGroup(other, [
        CloudGroup(planner, [LoadComposableNodes()])])])) == 0
    assert fake.noted('up') == [('planner',)]


def test_settings_of_a_group_reach_its_nodes(run, fake, planner):
    fake.on_start = ends
    assert run(LaunchDescription([
        CloudGroup(planner, [
            PushROSNamespace('arm'), SetParameter('use_sim_time', True),
            SetLaunchConfiguration('speed', '3'),
            node(name='mover', parameters=[{'speed': LaunchConfiguration('speed')}],
                 remappings=[('in', 'out')], arguments=['--fast'])]),
    ])) == 0
    spec = fake.machines['planner'].nodes['talker']
    words = [word for word in spec.arguments if isinstance(word, str)]
    assert words[0] == '--fast'
    assert '__node:=mover' in words and '__ns:=/arm' in words
    # written as Python's or as YAML's
    assert any(word.lower().split()[:1] == ['use_sim_time:=true'] for word in words)
    assert 'in:=out' in words
    (key, content), = spec.files.items()
    assert spec.arguments[words_index(spec.arguments, '--params-file') + 1] == ({'file': key},)
    assert yaml.safe_load(content) == {'/arm/mover': {'ros__parameters': {'speed': 3}}}


def words_index(arguments, word):
    return [index for index, argument in enumerate(arguments) if argument == word][0]


def test_the_users_handlers_work_with_cloud_nodes(run, fake, planner):
    seen = []
    fake.on_start = ends
    talker = cloud_node(planner)

    def note(event, context):
        seen.append((type(event).__name__, event.action, event.pid))

    assert run(LaunchDescription([
        RegisterEventHandler(OnProcessStart(target_action=talker, on_start=note)),
        RegisterEventHandler(OnProcessExit(target_action=talker, on_exit=note)),
        talker,
    ])) == 0
    assert seen == [('ProcessStarted', talker, 4001), ('ProcessExited', talker, 4001)]


def include(*entities):
    return events.IncludeLaunchDescription(LaunchDescription(entities))


def test_emitted_include_runs_its_cloud_node(run, fake, planner):
    fake.on_start = ends
    assert run(LaunchDescription([EmitEvent(event=include(cloud_node(planner)))])) == 0
    assert len(fake.noted('start')) == 1


def test_include_emitted_from_a_group_runs_on_its_machine(run, fake, planner, capfd):
    fake.on_start = ends
    assert run(LaunchDescription([CloudGroup(planner, [
        EmitEvent(event=include(node())),
        OpaqueFunction(function=lambda context: context.emit_event_sync(
            include(node(on_exit=lambda event, context: context.emit_event_sync(
                include(node())))))),
    ])])) == 0
    assert len(fake.noted('start')) == 3
    assert 'here' not in capfd.readouterr().out


def test_describing_a_launch_asks_nobody(fake, planner, monkeypatch):
    """``ros2 launch -s`` and ``--print-description`` only look."""
    from fogros2.runtime.coordinator import Coordinator

    def refuse(*args, **kwargs):
        raise AssertionError('nothing is to be executed')

    monkeypatch.setattr(Coordinator, '__init__', refuse)
    monkeypatch.setattr(ContainerInstance, 'spec', refuse)
    description = FogROSLaunchDescription([
        DeclareLaunchArgument('speed', default_value='1', description='how fast'),
        cloud_node(planner),
        CloudGroup(planner, [DeclareLaunchArgument('inner', default_value='2'), node()]),
    ])
    assert [a.name for a in description.get_launch_arguments()] == ['speed', 'inner']
    for entity in description.describe_sub_entities():
        assert entity.describe()

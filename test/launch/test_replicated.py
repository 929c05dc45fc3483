# SPDX-License-Identifier: Apache-2.0
"""Replicated nodes: what runs where, under which names, and what is refused."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import os
import threading

from launch import LaunchDescription
from launch.actions import (
    GroupAction,
    OpaqueFunction,
    RegisterEventHandler,
    Shutdown,
    TimerAction,
)
from launch.event_handlers import OnProcessExit, OnProcessStart
from launch.frontend import Parser
from launch_ros.actions import LifecycleNode, LoadComposableNodes, Node, PushROSNamespace
import pytest

from fogros2 import (
    CloudGroup,
    CloudNode,
    ContainerInstance,
    FogROSLaunchDescription,
    Replicated,
    StreamTopic,
)
from fogros2.actions.override import OverrideMachines
from fogros2.describe.overrides import Overrides
from fogros2.model import NodeSpec
from fogros2_features.replicas import starting
from fogros2_testing.plugins import instead
from rigs.launching import Harmless

NAMES = ('one', 'two', 'three')


@pytest.fixture(autouse=True)
def first(monkeypatch):
    """Replace the program of ``first_answer`` by one that only sleeps; return its settings."""
    found = []

    def spec(**given):
        found.append(json.loads(given['arguments'][0]))
        return NodeSpec(**{**given, 'package': 'demo', 'executable': 'talker'})

    monkeypatch.setattr(starting, 'NodeSpec', spec)
    return found


def machines(*names, **kwargs):
    return [ContainerInstance(name=name, ros_workspace='', **kwargs) for name in names or NAMES]


def talker(**kwargs):
    return Node(package='demo', executable='talker', **kwargs)


def ends_when_started(fake, count):
    """Have the machines' nodes end when so many have started; return the nodes."""
    lock, started = threading.Lock(), []

    def on_start(machine, node):
        with lock:
            if 'decoder' in node.name:
                return
            started.append((machine, node))
            if len(started) == count:
                for one, its in started:
                    one.say('exited', its, returncode=0, respawns=False)

    fake.on_start = on_start
    return started


def rules(node):
    return [word for before, word in zip(node.arguments, node.arguments[1:]) if before == '-r']


def test_each_machine_runs_a_copy_under_its_own_names(run, fake, first):
    started = ends_when_started(fake, 3)
    assert run(FogROSLaunchDescription([Replicated(
        machines(), [talker(name='planner', remappings=[('out', '/detections')])],
        services=['/plan'], topics=[('/image', '/detections')], hedge_after='p95')])) == 0
    assert sorted(machine.spec.name for machine, _ in started) == sorted(NAMES)
    for machine, node in started:
        prefix = f'/fogros2/{machine.spec.name}'
        assert rules(node) == [
            '__node:=planner', f'out:={prefix}/detections', f'/plan:={prefix}/plan',
            f'/image:={prefix}/image', f'/detections:={prefix}/detections']
    settings, = first
    assert settings.pop('folder') == str(fake.store.launch_folder('abcdef'))
    assert settings == {
        'name': 'first_answer_plan', 'services': ['/plan'], 'hedge_after': 'p95',
        'topics': [['/image', '/detections', False]],
        'replicas': {name: f'/fogros2/{name}' for name in NAMES}}


@pytest.mark.parametrize('robot', [None, 'robot'])
def test_robot_runs_a_copy_under_a_name_of_its_own(run, fake, first, robot):
    commands = []

    def started(event, context):
        commands.append(event.cmd)
        return Shutdown() if len(commands) == 3 else None

    assert run(FogROSLaunchDescription([
        RegisterEventHandler(OnProcessStart(on_start=started)),
        Replicated([*machines('one'), robot],
                   [talker(name='planner', remappings=[('out', '/plan')])],
                   services=['/plan'], deadline=0.2)])) == 0
    command, = (one for one in commands if 'out:=/fogros2/robot/plan' in one)
    assert command[0].endswith('/lib/demo/talker') and '/plan:=/fogros2/robot/plan' in command
    settings, = first
    assert (settings['last'], settings['deadline']) == ('robot', 0.2)
    assert settings['replicas'] == {'one': '/fogros2/one', 'robot': '/fogros2/robot'}


def test_robot_keeps_its_copy_in_a_group_of_a_machine(run, fake):
    started = ends_when_started(fake, 2)
    outer, one, two = machines('outer', 'one', 'two')
    assert run(LaunchDescription([CloudGroup(outer, [FogROSLaunchDescription([
        Replicated([one, two, None], [talker()], services=['/plan'], deadline=0.2),
        RegisterEventHandler(OnProcessExit(on_exit=[Shutdown()]))])])])) == 0
    assert sorted(machine.spec.name for machine, _ in started) == ['one', 'two']


def test_names_are_relative_to_their_namespace(run, fake, first):
    ends_when_started(fake, 2)
    assert run(LaunchDescription([GroupAction([PushROSNamespace('arm'), Replicated(
        machines('one', 'two'), [talker()], services=['plan'])])])) == 0
    assert first[0]['services'] == ['/arm/plan']


def test_end_and_start_of_a_node_are_reported(run, fake, tmp_path):
    """In the pipe of the launch's folder, as lines."""
    read, killed = [], []

    def reader(context):
        # before any node starts: a line that nobody reads is lost
        read.append(os.open(fake.store.launch_folder('abcdef') / 'first_answer_plan.events',
                            os.O_RDWR | os.O_NONBLOCK))

    def on_start(machine, node):
        if machine.spec.name == 'two' and not killed:
            killed.append(node)
            machine.say('exited', node, returncode=-9, respawns=True)
            machine.say('started', node, pid=77, cmd=['/there/program'])

    fake.on_start = on_start
    lines = []

    def look(context):
        with contextlib.suppress(BlockingIOError):
            lines.append(os.read(read[0], 4096).decode())
        return [Shutdown()] if ''.join(lines).count('two') >= 3 else [
            TimerAction(period=0.1, actions=[OpaqueFunction(function=look)])]

    assert run(FogROSLaunchDescription([
        Replicated(machines('one', 'two'), [talker(respawn=True)], services=['/plan']),
        OpaqueFunction(function=reader),
        OpaqueFunction(function=look),
    ])) == 0
    os.close(read[0])
    said = [line for line in ''.join(lines).splitlines() if line.endswith('two')]
    assert said[:3] == ['started two', 'died two', 'started two']


def test_lost_machine_does_not_end_the_launch(run, fake, caplog):
    count = itertools.count(1)

    def on_start(machine, node):
        if next(count) == 2:
            fake.machines['one'].say('lost', reason='taken away')
            other = fake.machines['two']
            other.say('exited', other.all[0], returncode=0, respawns=False)

    fake.on_start = on_start
    assert run(FogROSLaunchDescription([
        Replicated(machines('one', 'two'), [talker()], services=['/plan'])])) == 0
    assert "the machine 'one' is gone: taken away; the other replicas go on" in caplog.text


def test_streamed_input_is_not_forwarded_again(run, fake, first, monkeypatch):
    instead(monkeypatch, 'fogros2.image_transport', {'h264': Harmless})
    ends_when_started(fake, 2)
    assert run(FogROSLaunchDescription([Replicated(
        machines('one', 'two'), [talker(exec_name='own')], topics=[('/image', '/seen')],
        stream_topics=[('/image', 'h264')])])) == 0
    assert first[0]['topics'] == [['/image', '/seen', True]]


def test_on_the_robot_the_nodes_run_once_with_their_own_names(run, fake, first):
    replicated = Replicated(machines('one', 'two'), [talker()],
                            services=['/plan'])
    starts = []

    def seen(event, context):
        starts.append(event.process_name)
        return [Shutdown()]

    assert run(LaunchDescription([
        RegisterEventHandler(OnProcessStart(on_start=seen)),
        OverrideMachines(Overrides(['*=robot']), [replicated])])) == 0
    assert len(starts) == 1 and first == [] and fake.machines == {}


@pytest.mark.parametrize(('given', 'said'), [
    ({'machines': ['one']}, 'need two machines or more, not 1'),
    ({'machines': ['one', 'one']}, "have the machine 'one' twice"),
    ({'services': ['/plan', 'plan']}, "have the name '/plan' twice"),
    ({'topics': [('/a', '/plan')]}, "have the name '/plan' twice"),
    ({'services': []}, 'need a service or a pair of topics'),
    ({'services': ['/go/_action/send_goal']}, 'belongs to a ROS action'),
    ({'services': ['/a b']}, "'/a b' is not the full name"),
    ({'topics': [('/a',)]}, 'is no pair of topics'),
    ({'hedge_after': -1}, 'hedge_after=-1 is no time'),
    ({'hedge_after': 'soon'}, "'soon' is no number"),
    ({'deadline': 0.2}, 'the robot answers last'),
    ({'machines': ['one', 'two', None]}, 'the robot answers last'),
    ({'machines': ['one', None], 'deadline': float('inf')}, 'the robot answers last'),
    ({'machines': ['one', None, 'robot'], 'deadline': 0.2}, "the machine 'robot' twice"),
    ({'topics': [('/image', '/seen')],
      'stream_topics': [StreamTopic('/seen', 'h264', 'to_robot')]},
     '/seen is an output of replicas and in stream_topics='),
    ({'machines': [ContainerInstance(name='one', on_interrupt='robot'), 'two']},
     'replicas cannot move to the robot'),
    ({'actions': lambda: LifecycleNode(
        package='demo', executable='talker', name='x', namespace='')},
     'LifecycleNode cannot be replicated'),
    ({'actions': lambda: LoadComposableNodes(
        target_container='/box', composable_node_descriptions=[])},
     'LoadComposableNodes cannot be replicated'),
    ({'actions': lambda: CloudNode('own', package='demo', executable='talker')},
     'a part of replicas has a machine of its own'),
])
def test_bad_input_is_refused_before_a_machine_is_made(
        run, fake, caplog, monkeypatch, given, said):
    instead(monkeypatch, 'fogros2.image_transport', {'h264': Harmless})
    given = {'machines': ['one', 'two'], 'services': ['/plan'], 'actions': talker, **given}
    given['machines'] = [machines(one)[0] if one in NAMES else one for one in given['machines']]
    assert run(LaunchDescription([Replicated(actions=[given.pop('actions')()], **given)])) == 1
    assert said in caplog.text and fake.noted('up') == []


def test_two_groups_with_the_same_name_are_refused(run, caplog):
    both = machines('one', 'two')
    assert run(LaunchDescription([
        Replicated(both, [talker()], services=['/plan']),
        Replicated(both, [talker()], services=['/plan'])])) == 1
    assert "two groups of replicas have '/plan'" in caplog.text


@pytest.mark.parametrize('order', [1, -1])
def test_other_node_on_a_machine_of_replicas_is_refused(run, fake, caplog, order):
    """Its topics would be renamed, and nobody would miss it."""
    ends_when_started(fake, 3)
    both = machines('one', 'two')
    assert run(LaunchDescription([
        CloudNode(both[0], package='demo', executable='talker', exec_name='own'),
        Replicated(both, [talker()], services=['/plan'])][::order])) == 1
    assert "can't run on 'one': topics are renamed there, and if that machine is lost, " in (
        caplog.text)
    assert fake.noted('up') == []


XML = """
<launch>
  <arg name="second" default="two"/>
  <fog_machine name="one" provider="container" ros_workspace=""/>
  <fog_machine name="$(var second)" provider="container" ros_workspace=""/>
  <replicated machines="one, $(var second)" services="/plan" topics="/image:/seen"
              hedge_after="50">
    <node pkg="demo" exec="talker" name="planner"/>
  </replicated>
</launch>
"""


def test_xml_is_the_same_plan(run, fake, first):
    source = io.StringIO(XML.strip())
    source.name = 'test.launch.xml'
    entity, parser = Parser.load(source)
    started = ends_when_started(fake, 2)
    assert run(parser.parse_description(entity)) == 0
    assert sorted(machine.spec.name for machine, _ in started) == ['one', 'two']
    assert [first[0][key] for key in ('services', 'topics', 'hedge_after')] == [
        ['/plan'], [['/image', '/seen', False]], 50]
    assert all('/seen:=/fogros2/' in ' '.join(rules(node)) for _, node in started)

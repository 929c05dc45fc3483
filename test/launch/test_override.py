# SPDX-License-Identifier: Apache-2.0
"""``--machine``: machines that run elsewhere than their launch file says."""

from __future__ import annotations

import argparse
import dataclasses

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    RegisterEventHandler,
    SetLaunchConfiguration,
    Shutdown,
    TimerAction,
)
from launch.event_handlers import OnProcessExit, OnProcessStart
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
import pytest

from fogros2 import (
    AWSCloudInstance,
    CloudGroup,
    CloudNode,
    ContainerInstance,
    FogROSLaunchDescription,
    SSHInstance,
    StreamTopic,
)
from fogros2.actions.override import OverrideMachines
from fogros2.describe.overrides import Overrides, parse
from fogros2.errors import ConfigurationError
from fogros2_testing.plugins import instead
from rigs.launching import ends, Harmless
from ros2fog_cli.option.machine import MachineOption
from ros2fog_cli.verb import overrides as complete

AWS = {'name': 'planner', 'region': 'eu-west-3', 'ec2_instance_type': 't3.large', 'spot': True,
       'ros_workspace': '', 'on_exit': 'stop', 'environment': {'A': 'b'}}


def spec(text, machine):
    context = LaunchContext()
    return Overrides([text]).of(machine.name).instead(machine.spec(context), context)


def talker(machine, **kwargs):
    return CloudNode(machine=machine, package='demo', executable='talker', **kwargs)


def elsewhere(description, *texts):
    """Return a launch as ``ros2 launch --machine TEXT`` runs it."""
    option = MachineOption()
    parser = argparse.ArgumentParser()
    option.add_arguments(parser, 'ros2 launch')
    args = parser.parse_args([word for text in texts for word in ('--machine', text)])
    option.prestart(args)
    (found,) = option.prelaunch(description, args)
    return found


def test_container_machine_instead_may_run_containers():
    machine = AWSCloudInstance(name='planner', ros_workspace='')
    machine.add_docker_container('docker run redis')
    made = spec('planner=container', machine)
    assert made.options['containers'] and made.features == {
        'containers': {'docker_containers': ['docker run redis']}}


# -- what is made instead ------------------------------------------------------------------------

def test_another_provider_keeps_what_holds_for_any_machine():
    before = AWSCloudInstance(**AWS)
    assert spec('planner=container,memory=2g,ports=[1:2,3:4]', before) == dataclasses.replace(
        AWSCloudInstance(**AWS).spec(LaunchContext()), provider='container',
        options={'memory': '2g', 'ports': ['1:2', '3:4']})


def test_same_provider_keeps_settings_that_are_not_named():
    found = spec('planner=aws,region=eu-west-1,tags={team: slam}', AWSCloudInstance(**AWS))
    assert found.options == {'region': 'eu-west-1', 'ec2_instance_type': 't3.large', 'spot': True,
                             'tags': {'team': 'slam'}}


def test_container_moves_to_another_computer_and_back():
    found = spec('planner=container,on={host: box, user: lab},memory=2g',
                 AWSCloudInstance(**AWS))
    assert (found.provider, found.options) == (
        'hosted', {'on': {'host': 'box', 'user': 'lab'}, 'memory': '2g'})
    there = ContainerInstance(name='planner', on=SSHInstance('box'), memory='2g')
    assert spec('planner=container,cpus=2', there).options == {'cpus': 2}
    assert spec('planner=container,on={host: other}', there).options == {
        'on': {'host': 'other'}, 'memory': '2g'}


def test_what_holds_for_any_machine_can_be_said_too():
    found = spec('planner=aws,on_exit=keep,lifetime=2h,launch_foxglove=true,ros_workspace=/ws',
                 AWSCloudInstance(**AWS))
    assert (found.on_exit, found.lifetime, found.features, found.workspace) == (
        'keep', 7200.0, {'monitor': {'launch_foxglove': True}}, '/ws')
    assert found.environment == {'A': 'b'}


@pytest.mark.parametrize('text, options', [
    ('p=ssh:robot@planner.local:2222', {'host': 'planner.local', 'user': 'robot', 'port': 2222}),
    ('p=ssh:planner.local', {'host': 'planner.local'}),
    ('p=ssh:me@[2001:db8::1],key=/k', {'host': '2001:db8::1', 'user': 'me', 'key': '/k'}),
])
def test_a_computer_by_its_address(text, options):
    assert parse(text).machine('p').spec(LaunchContext()).options == options


def test_a_name_beats_a_pattern_and_the_last_one_counts():
    overrides = Overrides(['planner=aws', '*=container', 'map*=robot', 'map*=ssh,host=h'])
    assert [overrides.of(name).provider for name in ('planner', 'slam', 'mapper')] == [
        'aws', 'container', 'ssh']


@pytest.mark.parametrize('text, words', [
    ('planner', ["'planner'", 'planner=container',
                 'aws, azure, cheapest, container, gcp, joined, kubernetes, robot, ssh']),
    ('planner=', ['lacks the name']),
    ('planner=contaner', ["'contaner'", "did you mean 'container'? there are: aws"]),
    ('planner=aws,regoin=x', ["'regoin'", "did you mean 'region'"]),
    ('planner=aws,spot', ["'spot'", 'keyword=value']),
    ('planner=aws,spot=perhaps', ['spot:', 'neither']),
    ('planner=aws,name=other', ['keeps its name']),
    ('planner=ssh', ['needs host']),
    ('planner=aws,tags=team', ['tags:', '{name: value}']),
])
def test_wrong_argument_is_refused_with_a_hint(text, words):
    with pytest.raises(ConfigurationError) as error:
        Overrides([text])
    for word in words:
        assert word in str(error.value), error.value


# -- in a launch ---------------------------------------------------------------------------------

def test_a_launch_makes_the_other_machine(run, fake):
    fake.on_start = ends
    assert run(elsewhere(LaunchDescription([
        talker(AWSCloudInstance(**AWS)),
        talker(ContainerInstance(name='mapper', ros_workspace=''))]), 'planner=container')) == 0
    assert {name: machine.spec.provider for name, machine in fake.machines.items()} == {
        'planner': 'container', 'mapper': 'container'}
    assert fake.machines['planner'].spec.options == {}


def machines_late(machine):
    """Return content that mentions a machine in ways that come late, or never."""
    ends_never = Node(package='demo', executable='talker')
    return [
        TimerAction(period=60.0, actions=[talker(machine)]),
        RegisterEventHandler(OnProcessExit(
            target_action=ends_never, on_exit=[CloudGroup(machine, [talker(machine)])])),
    ]


@pytest.mark.parametrize('description', [
    lambda machine: [talker(machine)],
    lambda machine: [GroupAction([GroupAction([talker(machine)])])],
    lambda machine: [FogROSLaunchDescription([talker(machine)])],
    lambda machine: machines_late(machine)[:1],
    lambda machine: machines_late(machine)[1:],
])
def test_an_unknown_machine_is_refused_before_anything_is_made(run, fake, capfd, description):
    content = description(ContainerInstance(name='planner', ros_workspace=''))
    assert run(elsewhere(LaunchDescription(content), 'planer=robot')) == 1
    said = capfd.readouterr().out
    assert '--machine planer=' in said and "did you mean 'planner'? there are: planner" in said
    assert fake.noted('prepare') == fake.noted('up') == []


@pytest.mark.parametrize('late', [0, 1])
def test_a_machine_that_comes_late_is_known_all_the_same(run, fake, late):
    content = machines_late(ContainerInstance(name='planner', ros_workspace=''))[late]
    assert run(elsewhere(LaunchDescription([
        content, TimerAction(period=0.2, actions=[Shutdown()])]), 'planner=container')) == 0


@pytest.mark.parametrize('text', ['left=container', '*=robot'])
@pytest.mark.parametrize('outer', [[], [SetLaunchConfiguration('name', 'other')]])
def test_override_knows_machines_by_names_of_includes(run, fake, tmp_path, program, text, outer):
    fake.on_start = ends
    path = tmp_path / 'inner.launch.py'
    path.write_text("""
from launch import LaunchDescription
from launch.substitutions import LaunchConfiguration
from fogros2 import AWSCloudInstance, CloudNode

def generate_launch_description():
    machine = AWSCloudInstance(name=LaunchConfiguration('name'), ros_workspace='')
    return LaunchDescription([CloudNode(machine=machine, package='demo', executable='talker')])
""")
    assert run(elsewhere(LaunchDescription([*outer, *(GroupAction([IncludeLaunchDescription(
        AnyLaunchDescriptionSource(str(path)), launch_arguments={'name': name}.items())])
        for name in ('left', 'right'))]), text)) == 0
    assert {name: machine.spec.provider for name, machine in fake.machines.items()} == (
        {} if text == '*=robot' else {'left': 'container', 'right': 'aws'})


def test_a_launch_without_machines_takes_no_override(run, fake, capfd):
    assert run(elsewhere(LaunchDescription([]), '*=container')) == 1
    assert 'it has no machine at all' in capfd.readouterr().out


# -- on the robot --------------------------------------------------------------------------------

@pytest.fixture
def program(package):
    """Have demo's talker print its arguments, and end."""
    path = package / 'lib/demo/talker'
    path.write_text('#!/bin/sh\necho "here: $0 $* [$CYCLONEDDS_URI]"\n')
    return path


@pytest.mark.parametrize('wrapped', [
    lambda content: LaunchDescription(content), lambda content: FogROSLaunchDescription(content)])
def test_nodes_run_here_and_nothing_is_made(run, fake, capfd, program, wrapped, monkeypatch):
    monkeypatch.delenv('CYCLONEDDS_URI', raising=False)
    machine = AWSCloudInstance(**{**AWS, 'name': LaunchConfiguration('name')})
    ended = []
    cloud = talker(machine, name='first', output='screen', stream_topics=[('/camera', 'h264')])
    description = wrapped([
        DeclareLaunchArgument('name', default_value='planner'),
        RegisterEventHandler(OnProcessExit(
            target_action=cloud, on_exit=lambda event, context: ended.append(event.returncode))),
        cloud,
        CloudGroup(machine, [Node(package='demo', executable='talker', name='second',
                                  output='screen')]),
    ])
    assert run(elsewhere(description, '*=robot')) == 0
    said = capfd.readouterr().out
    assert 'here: ' in said and '__node:=first' in said and '__node:=second' in said
    assert said.count(' []') == 2, 'DDS was configured for a VPN that does not exist'
    assert fake.notes == []
    assert fake.report is None, 'a VPN was to be had'
    assert ended == [0]


def test_one_machine_here_and_another_in_the_cloud(run, fake, capfd, program):
    fake.on_start = ends
    assert run(elsewhere(FogROSLaunchDescription([
        talker(ContainerInstance(name='planner', ros_workspace=''), output='screen'),
        talker(ContainerInstance(name='mapper', ros_workspace='')),
    ]), 'planner=robot')) == 0
    assert list(fake.machines) == ['mapper']
    said = capfd.readouterr().out
    assert said.count('here: ') == 1 and '<CycloneDDS/>' in said


class Once(Harmless):
    def decoder(self, stream):
        return dataclasses.replace(super().decoder(stream), respawn=False)


def test_streams_between_machines_end_or_begin_here(run, fake, monkeypatch):
    """The robot publishes what the machine that is none would have, and hears what it would."""
    instead(monkeypatch, 'fogros2.image_transport', {'h264': Once})
    started = set()

    def on_start(event, context):
        started.add(event.process_name.rpartition('-')[0])
        return [Shutdown()] if expected <= started else None

    expected = {'talker', 'a_h264_encoder', 'a_h264_decoder', 'b_h264_encoder',
                'b_h264_decoder_from_there'}
    here = ContainerInstance(name='here', ros_workspace='')
    there = ContainerInstance(name='there', ros_workspace='')
    assert run(elsewhere(FogROSLaunchDescription([
        RegisterEventHandler(OnProcessStart(on_start=on_start)),
        talker(there, stream_topics=[StreamTopic('/a', source=here)]),
        talker(here, stream_topics=[StreamTopic('/b', source=there), ('/c', 'h264')]),
    ]), 'here=robot')) == 0
    names = sorted(node.name.rpartition('-')[0] for node in fake.machines['there'].all)
    assert names == ['a_h264_decoder', 'b_h264_encoder', 'talker']
    assert started == expected


def test_an_included_file_is_looked_through(run, fake, tmp_path, program, capfd):
    path = tmp_path / 'inner.launch.xml'
    path.write_text("""<launch>
        <fog_machine name="planner" provider="aws" region="nearest"/>
        <cloud_node machine="planner" pkg="demo" exec="talker" output="screen"/></launch>""")
    outer = LaunchDescription([IncludeLaunchDescription(AnyLaunchDescriptionSource(str(path)))])
    assert run(elsewhere(outer, 'planner=robot')) == 0
    assert 'here: ' in capfd.readouterr().out
    assert fake.notes == []
    assert fake.report is None, 'a VPN was to be had'


def test_a_machine_may_be_the_robot_in_the_file_itself(run, fake, tmp_path, program, capfd):
    path = tmp_path / 'inner.launch.yaml'
    path.write_text("""
launch:
- arg: {name: where, default: robot}
- fog_machine: {name: planner, provider: $(var where)}
- fogros_launch:
  - cloud_node: {machine: planner, pkg: demo, exec: talker, output: screen}
""")
    assert run(LaunchDescription(
        [IncludeLaunchDescription(AnyLaunchDescriptionSource(str(path)))])) == 0
    assert 'here: ' in capfd.readouterr().out
    assert fake.notes == []
    assert fake.report is None, 'a VPN was to be had'


def test_a_launch_file_is_run_once(run, fake, tmp_path, program):
    path = tmp_path / 'outer.launch.py'
    path.write_text(f"""
from launch import LaunchDescription
from fogros2 import CloudNode, ContainerInstance

def generate_launch_description():
    open({str(tmp_path / 'times')!r}, 'a').write('once')
    machine = ContainerInstance(name='planner', ros_workspace='')
    return LaunchDescription([CloudNode(machine=machine, package='demo', executable='talker')])
""")
    assert run(elsewhere(LaunchDescription([IncludeLaunchDescription(
        AnyLaunchDescriptionSource(str(path)))]), 'planner=robot')) == 0
    assert (tmp_path / 'times').read_text() == 'once'


def test_what_is_described_tells_launch_what_is_in_it():
    argument = DeclareLaunchArgument('count', default_value='1')
    description = LaunchDescription([OverrideMachines(Overrides(['*=robot']), [argument])])
    assert description.get_launch_arguments() == [argument]


# -- completion ----------------------------------------------------------------------------------

def test_an_argument_completes_name_provider_and_keyword(tmp_path, monkeypatch):
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(tmp_path))
    assert complete('') == ['*=']
    assert complete('planner=') == [
        f'planner={one}' for one in (
            'aws', 'azure', 'cheapest', 'container', 'gcp', 'joined', 'kubernetes',
            'robot', 'ssh')]
    assert complete('planner=co') == ['planner=container']
    assert complete('planner=aws,reg') == ['planner=aws,region=', 'planner=aws,regions=']
    assert 'planner=aws,spot=true,disk_size=' in complete('planner=aws,spot=true,d')
    assert complete('planner=aws,region=') == []
    assert complete('planner=nonsense,re') == []

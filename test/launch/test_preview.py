# SPDX-License-Identifier: Apache-2.0
"""What ``ros2 launch -s``, ``-p`` and ``ros2 fog plan`` show of machines, without any of them."""

from __future__ import annotations

import dataclasses
from decimal import Decimal
from importlib.util import find_spec
import os
from pathlib import Path
import subprocess

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
    SetLaunchConfiguration,
    TimerAction,
)
from launch.conditions import IfCondition
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
import pytest
from ros2cli.cli import main

from fogros2 import (
    AWSCloudInstance,
    CloudGroup,
    CloudNode,
    ContainerInstance,
    FogROSLaunchDescription,
)
from fogros2.describe.overrides import Overrides
from fogros2.errors import ConfigurationError, ProviderError
from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider import Capabilities
from fogros2.store import Store
from fogros2_testing.fakes import FakeProvider
from fogros2_testing.plugins import instead
from ros2fog_cli.api.preview import arguments, Preview

XML = """\
<launch>
  <arg name="where" default="aws"/>
  <arg name="region" default="eu-west-1"/>
  <fog_machine name="planner" provider="$(var where)" region="$(var region)"/>
  <cloud_node machine="planner" pkg="fogros2_examples" exec="talker"/>
  <node pkg="fogros2_examples" exec="listener"/>
</launch>
"""


class Cloud(FakeProvider):
    """A cloud that notes what it is asked."""

    name = 'aws'
    capabilities = Capabilities(choices=True)
    asked: list[str] = []

    def check(self, spec: MachineSpec) -> None:
        self.asked.append(f'check {spec.name}')

    def resolve(self, spec: MachineSpec) -> MachineSpec:
        self.asked.append(f'resolve {spec.name}')
        if spec.name == 'c':
            raise ProviderError('no credentials', 'log in')
        return dataclasses.replace(spec, options={**spec.options, 'ec2_instance_type': 't3.large'})

    def cost_per_hour(self, spec: MachineSpec) -> Decimal:
        return Decimal('0.0416')

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        raise AssertionError


@pytest.fixture(autouse=True)
def cloud(monkeypatch: pytest.MonkeyPatch) -> type[Cloud]:
    Cloud.asked = []
    instead(monkeypatch, 'fogros2.provider', {
        'aws': Cloud, 'container': type('Local', (FakeProvider,), {'name': 'container'})})
    monkeypatch.setattr('fogros2.shell.warm', lambda kind: None)
    return Cloud


def node(machine, executable='talker', **more):
    return CloudNode(machine=machine, package='demo', executable=executable, **more)


def lines(entities, overrides=None, **given):
    kind = entities if isinstance(entities, LaunchDescription) else LaunchDescription(entities)
    return list(Preview(kind, given, Overrides(overrides) if overrides else None).lines())


def test_machines_are_shown_with_their_nodes():
    planner = AWSCloudInstance(name='planner', region='eu-west-1', ec2_instance_type='t3.large')
    assert lines(FogROSLaunchDescription([
        node(planner), TimerAction(period=1.0, actions=[node(planner, 'late')]),
        CloudGroup(machine=ContainerInstance(name='mapper', memory='2g'), actions=[
            Node(package='demo', executable='mapper'),
            ExecuteProcess(cmd=['echo', LaunchConfiguration('x')])]),
        Node(package=['de', 'mo'], executable=LaunchConfiguration('x', default='listener'))])) == [
        'planner: aws (ec2_instance_type=t3.large, region=eu-west-1)',
        '    demo talker', '    demo late',
        'mapper: container (memory=2g)', '    demo mapper',
        "    echo <LaunchConfig('x')>",
        'robot', '    demo listener']


def test_values_are_those_of_the_arguments():
    def described():
        return [
            DeclareLaunchArgument('region', default_value='eu-west-1'),
            DeclareLaunchArgument('big', default_value='false'),
            node(AWSCloudInstance(name='a', region=LaunchConfiguration('region'))),
            node(ContainerInstance(name='b'), condition=IfCondition(PythonExpression([
                ' 2 > 1 and "', LaunchConfiguration('big'), '" in ("true", "1")'])))]

    assert lines(described()) == ['a: aws (region=eu-west-1)', '    demo talker']
    assert lines(described(), region='us-east-1', big='true') == [
        'a: aws (region=us-east-1)', '    demo talker', 'b: container', '    demo talker']


def test_any_node_runs_on_a_machine_by_the_package_s_launch():
    file = Path(__file__).parents[2] / 'launch/cloud.launch.py'
    source = AnyLaunchDescriptionSource(str(file))
    described = source.try_get_launch_description_without_context()
    given = {'package': 'demo', 'executable': 'mapper'}
    assert lines(described, **given) == ['cloud: container', '    demo mapper']
    assert lines(described, ['cloud=aws,region=eu-west-1'], **given) == [
        'cloud: aws (region=eu-west-1)', '    demo mapper']


def test_what_only_a_launch_knows_is_said():
    found = lines([
        node(AWSCloudInstance(name='a', region=LaunchConfiguration('nowhere'))),
        node(ContainerInstance(name='b'), condition=IfCondition(LaunchConfiguration('x'))),
        OpaqueFunction(function=lambda context: None)])
    assert found[0].startswith('a: aws: ') and 'nowhere' in found[0]
    assert found[1:] == ['    demo talker', 'b: container', '    demo talker (under a condition)',
                         'Not shown: what functions, and files that cannot be read now, may add.']


def test_machines_run_where_the_command_line_says():
    described = [node(AWSCloudInstance(name='a')), node(AWSCloudInstance(name='b'))]
    assert lines(described, ['a=container,memory=1g', 'b=robot']) == [
        'a: container (memory=1g)', '    demo talker', 'robot', '    demo talker']


def test_included_file_has_its_own_arguments(tmp_path: Path):
    path = tmp_path / 'x.launch.xml'
    path.write_text(XML)
    included = IncludeLaunchDescription(
        AnyLaunchDescriptionSource(str(path)), launch_arguments={'region': 'us-east-1'}.items())
    assert lines([GroupAction([included]), included]) == [
        'planner: aws (region=us-east-1)', *['    fogros2_examples talker'] * 2,
        'robot', *['    fogros2_examples listener'] * 2]


@pytest.mark.parametrize('around, where', [
    (lambda first: first, 'aws'),
    (lambda first: GroupAction([first]), 'container'),
    (lambda first: GroupAction([first], scoped=False), 'aws'),
    (lambda first: GroupAction([first], scoped=False,
                               launch_configurations={'where': 'container'}), 'container'),
])
def test_preview_scopes_what_a_launch_scopes(tmp_path: Path, around, where):
    paths = [tmp_path / f'{name}.launch.xml' for name in 'ab']
    paths[0].write_text('<launch><arg name="where" default="aws"/></launch>')
    paths[1].write_text("""<launch>
        <arg name="where" default="container"/>
        <fog_machine name="b" provider="$(var where)"/></launch>""")
    first, second = (IncludeLaunchDescription(AnyLaunchDescriptionSource(str(path)))
                     for path in paths)
    assert lines([around(first), second]) == [f'b: {where}']


def test_preview_of_a_group_without_forwarding():
    def machine(name):
        return node(ContainerInstance(name=name, memory=LaunchConfiguration(
            'memory', default='none')))

    assert lines([SetLaunchConfiguration('memory', '1g'),
                  GroupAction([machine('a')], forwarding=False), machine('b')]) == [
        'a: container (memory=none)', '    demo talker',
        'b: container (memory=1g)', '    demo talker']


def test_broken_include_spoils_nothing_else(tmp_path: Path):
    path = tmp_path / 'x.launch.py'
    path.write_text('raise KeyboardError')
    included = IncludeLaunchDescription(AnyLaunchDescriptionSource(str(path)))
    assert lines([included, node(ContainerInstance(name='a'))]) == [
        'a: container', '    demo talker',
        'Not shown: what functions, and files that cannot be read now, may add.']


def test_word_that_is_no_argument_is_refused():
    assert arguments(['a:=b:=c', 'd:=']) == {'a': 'b:=c', 'd': ''}
    with pytest.raises(ConfigurationError, match='NAME:=VALUE'):
        arguments(['a=b'])


@pytest.mark.skipif(find_spec('ros2launch') is not None,
                    reason="ROS 2's own ros2launch does not show machines")
@pytest.mark.parametrize('option', ['-s', '-p'])
def test_launch_shows_machines_and_asks_nothing(option, tmp_path, capsys, cloud):
    path = tmp_path / 'x.launch.xml'
    path.write_text(XML)
    before = sorted(os.walk(Store().root))
    assert not main(argv=['launch', str(path), 'region:=us-east-1', option])
    said = capsys.readouterr().out
    assert said.endswith("""
Machines (ros2 fog plan asks for their prices):
    planner: aws (region=us-east-1)
        fogros2_examples talker
    robot
        fogros2_examples listener
""")
    assert cloud.asked == [] and sorted(os.walk(Store().root)) == before
    path.write_text('<launch><node pkg="demo" exec="talker"/></launch>')
    assert not main(argv=['launch', str(path), option])
    assert 'Machines' not in capsys.readouterr().out


def test_plan_asks_for_prices_and_creates_nothing(tmp_path, capsys, cloud):
    path = tmp_path / 'x.launch.xml'
    path.write_text("""\
<launch>
  <fog_machine name="a" provider="aws" region="eu-west-1"/>
  <fog_machine name="b" provider="aws"/>
  <fog_machine name="c" provider="aws"/>
  <fog_machine name="d" provider="container"/>
  <cloud_node machine="a" pkg="fogros2_examples" exec="talker"/>
</launch>
""")
    assert main(argv=['fog', 'plan', str(path)]) == 1
    said = capsys.readouterr()
    assert said.out == """a: aws (ec2_instance_type=t3.large, region=eu-west-1), $0.0416 an hour
    fogros2_examples talker
b: aws (ec2_instance_type=t3.large), $0.0416 an hour
c: aws
d: container
All machines: $0.0832 an hour
"""
    assert said.err == 'c: no credentials (log in)\n'
    assert cloud.asked == [f'{what} {name}' for name in 'abc' for what in ('check', 'resolve')]
    assert main(argv=['fog', 'plan', str(path), '--machine', 'c=robot']) == 0
    assert 'c: aws' not in capsys.readouterr().out


@pytest.mark.parametrize(('body', 'error'), [
    (['<fog_machine name="m" provider="container" memory="4x"/>'],
     "m: a fake machine has no option 'memory'"),
    (['<fog_machine name="m" provider="$(var where)"/>'], "m: there is no provider 'contaner'"),
    (['<cloud_node machine="q" pkg="fogros2_examples" exec="talker"/>'],
     "this launch has no machine named 'q'"),
    (['<fog_machine name="m" provider="container"/>',
      '<cloud_node machine="m" pkg="fogros2_examples" exec="talkr"/>'], "did you mean 'talker'?"),
])
def test_plan_refuses_what_a_launch_refuses(tmp_path, capsys, body, error):
    path = tmp_path / 'x.launch.xml'
    path.write_text('\n'.join(['<launch><arg name="where" default="contaner"/>', *body,
                               '</launch>']))
    assert main(argv=['fog', 'plan', str(path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert error in line and line.count('m: ') <= 1


def test_plan_refuses_two_machines_of_one_name():
    plan = Preview(LaunchDescription([
        node(ContainerInstance(name='a')), node(AWSCloudInstance(name='a'))]), {})
    (machine,) = plan.machines
    assert "two machines of this launch have the name 'a'" in str(machine.error)


def test_plan_refuses_override_without_machine():
    described = [node(ContainerInstance(name='first'))]
    with pytest.raises(ConfigurationError, match="no machine of this name.*mean 'first'"):
        lines(described, ['frist=container'])
    # the launch knows the machines of conditions that do not hold
    off = node(ContainerInstance(name='other'), condition=IfCondition('false'))
    assert lines([*described, off], ['other=container'])


def test_plan_of_a_missing_file_is_an_error(tmp_path):
    assert 'there is no file' in main(argv=['fog', 'plan', str(tmp_path / 'no.launch.py')])


@pytest.mark.skipif(find_spec('ros2launch') is not None,
                    reason="ROS 2's own ros2launch makes launch's log folder")
@pytest.mark.parametrize('words', [['launch', '-p'], ['fog', 'plan']])
def test_previews_write_no_file_and_name_the_node_with_a_machine(words, tmp_path):
    path = tmp_path / 'x.launch.py'
    path.write_text('from launch import LaunchDescription\nfrom launch.actions import LogInfo\n'
                    'from launch_ros.actions import Node\n'
                    "said = LogInfo(msg='a')\ndef generate_launch_description():\n"
                    "    return LaunchDescription([Node(executable='a', machine='m')])\n")
    done = subprocess.run(['ros2', *words, str(path)], env={
        name: value for name, value in {**os.environ, 'HOME': str(tmp_path / 'home')}.items()
        if name not in ('ROS_LOG_DIR', 'ROS_HOME')}, capture_output=True, text=True)
    assert done.returncode == 1 and 'from fogros2 import Node' in done.stderr
    assert not (tmp_path / 'home').exists()

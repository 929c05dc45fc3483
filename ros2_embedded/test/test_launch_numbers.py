# SPDX-License-Identifier: Apache-2.0
"""Parameters have the types that rcl gives them, on every way through launch."""

import importlib.util
import math
import sys

from launch import LaunchDescription, LaunchService
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    TimerAction,
)
from launch.substitutions import LaunchConfiguration
from launch.utilities.type_utils import coerce_to_type
from launch_ros.actions import Node, SetParameter
from launch_ros.descriptions import ParameterValue
import pytest

ros_yaml = pytest.importorskip(
    'launch.utilities.ros_yaml', reason="launch of ROS 2 has PyYAML's types")
A = LaunchConfiguration('a')

# rcl 9.2.8 (Jazzy) gave these types, for -p and in a file.
TYPES = [
    ('5e-06', 5e-06), ('1e-3', 0.001), ('1e20', 1e20), ('1.0e3', 1000.0), ('1E5', 1e5),
    ('.5', 0.5), ('1.', 1.0), ('+.5', 0.5), ('08', 8.0), ('99999999999999999999', 1e20),
    ('inf', math.inf), ('-.inf', -math.inf), ('.Inf', math.inf), ('infinity', math.inf),
    ('0e-400', 0.0), ('0x1p3', 8.0), ('-0X.8', -0.5), ('0x8000000000000000', 2.0 ** 63),
    ('0x1F', 31), ('010', 8), ('+0x10', 16), ('+5', 5), ('-5', -5), ('-0', 0), ('0', 0),
    ('y', True), ('Y', True), ('yes', True), ('on', True), ('TRUE', True), ('True', True),
    ('n', False), ('no', False), ('off', False), ('False', False),
    *((text, text) for text in (
        '12:30', '1_000', '2024-05-01', '2024-05-01T10:00:00Z', 'tRue', '0o17', '0b11', 'null',
        '~', '1e', 'e5', '0x', '1e400', '-1.e-400', '1e-310',
        '0x1p2000', '+.nan', '1,000', '=', 'abc def', '.', '+')),
]


pytestmark = pytest.mark.usefixtures('own_log')


@pytest.mark.parametrize('text, value', TYPES)
def test_text_without_quotes_has_the_type_that_rcl_gives(text, value):
    got = coerce_to_type(text)
    assert (type(got), got) == (type(value), value)
    assert coerce_to_type(f'"{text}"') == text == coerce_to_type(f"'{text}'")
    assert ros_yaml.load(f'{{{text}: 1}}' if text.isalnum() else f'{{"{text}": 1}}') == {text: 1}


def test_nan_is_a_number_and_lists_have_types():
    assert math.isnan(coerce_to_type('nan')) and math.isnan(coerce_to_type('.NaN'))
    assert coerce_to_type('[1e-3, 2.0]') == [0.001, 2.0]
    assert coerce_to_type('[y, no]') == [True, False]
    assert coerce_to_type('["1e-3", b]') == ['1e-3', 'b']


@pytest.mark.parametrize('value', [
    *(text for text, _ in TYPES), '', ' a ', 'a: b', '# a', '[1', '{', 'a\n "b" \\ ü \u2028 end',
    'x' * 200 + ' ' + 'y' * 200, 5e-06, 1e20, math.inf, 7, True, ['1e-3', 'y'], [1e-3, 2.0]])
def test_written_value_is_read_again_as_it_was(value):
    assert ros_yaml.load(ros_yaml.dump(value)) == value
    assert ros_yaml.load(ros_yaml.dump({'/**': {'p': value}})) == {'/**': {'p': value}}


def test_merged_mappings_are_read():
    assert ros_yaml.load('a: &a {y: 1}\nb: {<<: *a, n: 2}') == {'a': {'y': 1}, 'b': {
        'y': 1, 'n': 2}}


SHOW = f'''#!{sys.executable}
import rclpy
from rclpy.node import Node
rclpy.init()
node = Node('show', allow_undeclared_parameters=True,
            automatically_declare_parameters_from_overrides=True)
for name, parameter in node.get_parameters_by_prefix('p').items():
    print('PARAM', name, repr(parameter.value if parameter.type_.value < 5 else [
        *parameter.value]))
node.destroy_node()
rclpy.shutdown()
'''
XML = '''<launch>
  <let name="a" value="1e-3"/>
  <set_parameter name="p.global" value="5e-06"/>
  <node exec="{program}" output="screen">
    <param name="p.plain" value="5e-06"/>
    <param name="p.list" value="[1e-3, 2.0]"/>
    <param name="p.split" value="1e-3;2.5" value-sep=";"/>
    <param name="p.subst" value="$(var a)"/>
    <param name="p.text" value="123E5" type="str"/>
    <param name="p.time" value="12:30"/>
    <param name="p.under" value="1_000"/>
    <param name="p.date" value="2024-05-01"/>
    <param name="p.y" value="y"/>
  </node>
</launch>
'''
YAML = '''
launch:
- arg: {{name: a, default: 1e-3}}
- timer: {{period: 1e-3, children: []}}
- set_parameter: {{name: p.global, value: 5e-06}}
- node:
    exec: {program}
    output: screen
    param:
    - {{name: p.plain, value: 5e-06}}
    - {{name: p.list, value: [1e-3, 2.0]}}
    - {{name: p.split, value: [1e-3, 2.5]}}
    - {{name: p.subst, value: $(var a)}}
    - {{name: p.text, value: '123E5'}}
    - {{name: p.time, value: 12:30}}
    - {{name: p.under, value: 1_000}}
    - {{name: p.date, value: 2024-05-01}}
    - {{name: p.y, value: y}}
'''
READ = {'global': 5e-06, 'plain': 5e-06, 'list': [0.001, 2.0], 'split': [0.001, 2.5],
        'subst': 0.001, 'text': '123E5', 'time': '12:30', 'under': '1_000',
        'date': '2024-05-01', 'y': True}


@pytest.fixture
def show(tmp_path, capsys):
    """Return a function that runs entities, and returns the parameters that a node got."""
    if not importlib.util.find_spec('rclpy._rclpy_pybind11'):
        pytest.skip('needs rcl')
    program = tmp_path / 'show'
    program.write_text(SHOW)
    program.chmod(0o755)

    def run(*entities):
        service = LaunchService(noninteractive=True)
        service.include_launch_description(LaunchDescription(entities))
        assert service.run() == 0
        shown = [line.partition('PARAM ')[2].partition(' ')
                 for line in capsys.readouterr().out.splitlines() if 'PARAM ' in line]
        return {name: eval(value, {'inf': math.inf}) for name, _, value in shown}  # noqa: S307

    run.program = program
    return run


@pytest.mark.parametrize('name, content', [('a.launch.xml', XML), ('a.launch.yaml', YAML)])
def test_launch_file_gives_parameters_their_types(tmp_path, show, name, content):
    (tmp_path / name).write_text(content.format(program=show.program))
    assert show(IncludeLaunchDescription(tmp_path / name)) == READ


def test_python_gives_parameters_their_types(show):
    own = {'small': 5e-06, 'big': 1e20, 'inf': math.inf, 'list': [1e-3, 2.0], 'text': '123E5',
           'y': 'y', 'texts': ['1e-3', 'y'], 'odd': ' a: # "\\\n ü', 'empty': '', 'time': '12:30'}
    everywhere = {'g_text': '123E5', 'g_list': [1e-3, 2.0], 'g_texts': ['a', '1'],
                  'g_small': 5e-06, 'g_odd': 'a: b #', 'g_y': 'y'}
    substituted = {'s': A, 's_joined': ['x', A], 's_list': [[A], [A]],
                   's_text': ParameterValue(A, value_type=str)}
    assert show(
        DeclareLaunchArgument('a', default_value='1e-3'),
        GroupAction([
            *(SetParameter(f'p.{name}', value) for name, value in everywhere.items()),
            SetParameter('p.g_sub', A),
            # as in ROS 2, where only the node finds the type
            SetParameter('p.g_true', 'true'), SetParameter('p.g_one', '1'),
            TimerAction(period=A, actions=[Node(
                executable=show.program, output='screen', ros_arguments=['-p', 'p.arg:=1e-3'],
                parameters=[{'p': {**own, **substituted}}])])])
    ) == {**own, **everywhere, 'g_sub': 0.001, 'g_true': True, 'g_one': 1, 'arg': 0.001,
          's': 0.001, 's_joined': 'x1e-3', 's_list': [0.001, 0.001], 's_text': '1e-3'}

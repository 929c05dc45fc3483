# SPDX-License-Identifier: Apache-2.0
"""launch_ros: the command lines of nodes, by value, through ROS 2's public API alone."""

import importlib.util
import os
from pathlib import Path
import subprocess
import sys

from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import GroupAction, IncludeLaunchDescription, OpaqueFunction
from launch.substitutions import (
    LaunchConfiguration,
    PathJoinSubstitution,
    SubstitutionFailure,
    TextSubstitution,
)
from launch.utilities import perform_substitutions
from launch_ros.actions import (
    ComposableNodeContainer,
    LifecycleNode,
    LoadComposableNodes,
    Node,
    PushROSNamespace,
    PushRosNamespace,
    SetParameter,
    SetParametersFromFile,
    SetRemap,
    SetROSLogDir,
)
from launch_ros.descriptions import ComposableNode, ParameterFile, ParameterValue
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.events.matchers import matches_node_name
from launch_ros.substitutions import ExecutableInPackage, FindPackagePrefix, FindPackageShare
from launch_ros.utilities import (
    evaluate_parameters,
    make_namespace_absolute,
    normalize_parameters,
    normalize_remap_rule,
    prefix_namespace,
)
import pytest
import yaml

pytestmark = pytest.mark.usefixtures('own_log', 'package')


def visit(context, *entities):
    """Execute actions in order, without a launch service; start no process."""
    for entity in entities:
        if isinstance(entity, Node):
            entity._perform_substitutions(context)
        else:
            visit(context, *(entity.visit(context) or ()))


def words(action, context):
    """Return the words of a node's command behind the executable."""
    context.extend_locals({'ros_specific_arguments': {'name': '<name>', 'ns': '<ns>'}})
    return [perform_substitutions(context, word) for word in action.cmd][1:]


def command(*settings, configurations=None, **kwargs):
    context = LaunchContext()
    context.launch_configurations.update(configurations or {})
    action = Node(**{'package': 'pkg', 'executable': 'exe', **kwargs})
    visit(context, *settings, action)
    return words(action, context), action


def test_node_runs_with_its_arguments(capsys):
    action = Node(package='pkg', executable='exe', name='n', namespace='/ns',
                  arguments=['a b', LaunchConfiguration('x', default='y')],
                  ros_arguments=['--log-level', 'info'],
                  remappings=[('from', 'to')], parameters=[{'p': 1}], output='screen')
    service = LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription([action]))
    assert service.run() == 0
    got = [line.partition('] word ')[2] for line in capsys.readouterr().out.splitlines()
           if '] word ' in line]
    file = got[got.index('--params-file') + 1]
    assert got == [
        'a b', 'y', '--ros-args', '--log-level', 'info', '--ros-args', '-r', '__node:=n', '-r',
        '__ns:=/ns', '--params-file', file, '-r', 'from:=to']
    assert yaml.safe_load(Path(file).read_text()) == {'/ns/n': {'ros__parameters': {'p': 1}}}
    assert action.node_name == '/ns/n' and action.is_node_name_fully_specified()
    assert action.name.startswith('exe-')


@pytest.mark.parametrize('kwargs, expected, name', [
    ({}, ['--ros-args'], '<node_namespace_unspecified>/<node_name_unspecified>'),
    ({'name': 'n'}, ['--ros-args', '-r', '<name>'], '<node_namespace_unspecified>/n'),
    ({'name': ['n', LaunchConfiguration('i')], 'namespace': 'ns'},
     ['--ros-args', '-r', '<name>', '-r', '<ns>'], '/ns/n1'),
    ({'namespace': '/'}, ['--ros-args', '-r', '<ns>'], '/<node_name_unspecified>'),
    ({'name': 'n', 'remappings': [('a', LaunchConfiguration('i')), ('/b', 'c')]},
     ['--ros-args', '-r', '<name>', '-r', 'a:=1', '-r', '/b:=c'],
     '<node_namespace_unspecified>/n'),
])
def test_command_line_has_names_and_remappings(kwargs, expected, name):
    got, action = command(configurations={'i': '1'}, **kwargs)
    assert got == expected and action.node_name == name
    assert action.node_package == 'pkg' and action.node_executable == 'exe'


def test_node_has_no_name_before_it_executes():
    action = Node(executable='exe')
    with pytest.raises(RuntimeError, match="cannot access 'node_name' before executing action"):
        _ = action.node_name
    assert (action._Node__package, action._Node__node_executable) == (None, 'exe')


@pytest.mark.parametrize('kwargs', [
    {'name': 'a b'}, {'name': '1a'}, {'name': 'a/b'}, {'namespace': '/1'},
    {'namespace': '/a//b'}, {'name': 'x' * 300}])
def test_invalid_node_name_or_namespace_is_refused(kwargs, capsys):
    with pytest.raises(Exception, match='Invalid n'):
        command(**kwargs)
    assert 'Error while expanding or validating node name or namespace for' in (
        capsys.readouterr().out)


def test_pushed_namespace_ends_with_its_group():
    context = LaunchContext()
    nodes = [Node(executable='exe', name='n', namespace=ns) for ns in (None, 'x', '/y')]
    outer = Node(executable='exe', name='n')
    visit(context, PushROSNamespace('a'), GroupAction([
        PushRosNamespace([LaunchConfiguration('b', default='b'), '/c']), *nodes]), outer)
    assert [node.node_name for node in (*nodes, outer)] == [
        '/a/b/c/n', '/a/b/c/x/n', '/y/n', '/a/n']
    visit(context, PushROSNamespace('/d'))
    assert context.launch_configurations['ros_namespace'] == '/d'
    with pytest.raises(SubstitutionFailure, match='The resulting namespace is invalid'):
        PushROSNamespace('1').execute(context)


def test_global_parameters_and_remappings_come_first(tmp_path):
    file = tmp_path / 'global.yaml'
    file.write_text('{}')
    context_words, action = command(
        SetParameter('a', 1), SetParameter(['b', TextSubstitution(text='c')], ['x', 'y']),
        SetParameter('s', '1'), SetParameter('t', LaunchConfiguration('i')),
        SetParametersFromFile(str(file)), SetRemap('x', [LaunchConfiguration('i'), 'y']),
        configurations={'i': '2'}, remappings=[('p', 'q')], parameters=[{'own': 3}])
    own = context_words[context_words.index('--params-file', 10) + 1]
    # ROS 2 writes an array as Python does, which rcl takes for a text
    array = context_words[4]
    assert array in ("bc:=('x', 'y')", 'bc:=["x", "y"]')
    assert context_words == [
        '--ros-args', '-p', 'a:=1', '-p', array, '-p', 's:=1', '-p', 't:=2',
        '--params-file', str(file), '--params-file', own, '-r', 'x:=2y', '-r', 'p:=q']
    assert yaml.safe_load(Path(own).read_text()) == {'/**': {'ros__parameters': {'own': 3}}}
    assert action.expanded_remapping_rules == [('x', '2y'), ('p', 'q')]


def load(path):
    # Real launch_ros writes arrays with a tag of Python's, which rcl ignores.
    return yaml.load(Path(path).read_text(), yaml.FullLoader)  # noqa: S506


def plain(value):
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, (list, tuple)) else value


def test_parameter_dictionary_becomes_a_file():
    i = LaunchConfiguration('i')
    got, _ = command(name='n', configurations={'i': '7', 'empty': ''}, parameters=[{
        'int': 1, 'float': 1.5, 'bool': True, 'str': 'true', 'empty': '', 'subst': i,
        'joined': ['x', i], 'typed': ParameterValue(i, value_type=str),
        'ints': [1, 2], 'floats': [1, 2.5], 'bools': [True, False], 'strs': ['a', '1'],
        'list': [[i], [i, '0']], 'nested': {'deep': {'er': 1}, (i, 'x'): 2},
        'nothing': LaunchConfiguration('empty')}])
    [content] = [load(got[number + 1]) for number, word in enumerate(got)
                 if word == '--params-file']
    assert plain(content) == {'/**': {'ros__parameters': {
        'int': 1, 'float': 1.5, 'bool': True, 'str': 'true', 'empty': '', 'subst': 7,
        'joined': 'x7', 'typed': '7', 'ints': [1, 2], 'floats': [1.0, 2.5],
        'bools': [True, False], 'strs': ['a', '1'], 'list': [7, 70], 'nested.deep.er': 1,
        'nested.7x': 2, 'nothing': ''}}}


#: Launch files whose node has a parameter that is no ASCII, by their names' end.
ACCENTED = {
    'py': """
from launch import LaunchDescription
from launch_ros.actions import Node
def generate_launch_description():
    return LaunchDescription([
        Node(package='pkg', executable='exe', parameters=[{'p': 'caf\xe9'}])])
""",
    'xml': '<launch><node pkg="pkg" exec="exe"><param name="p" value="caf\xe9"/></node></launch>',
    'yaml': 'launch: [node: {pkg: pkg, exec: exe, param: [{name: p, value: caf\xe9}]}]',
    'file.xml': '<launch><node pkg="pkg" exec="exe"><param from="$(dirname)/p.yaml" '
                'allow_substs="true"/></node></launch>'}
RUN = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
service = LaunchService(noninteractive=True)
service.include_launch_description(LaunchDescription([IncludeLaunchDescription(sys.argv[1])]))
sys.exit(service.run())
"""


@pytest.mark.parametrize('kind', ['py', *(pytest.param(kind, marks=pytest.mark.skipif(
    not importlib.util.find_spec('embedded_default'), reason='ROS 2 reads files by the locale'))
    for kind in ('xml', 'yaml', 'file.xml'))])
def test_text_is_utf_8_in_any_locale(tmp_path, package, kind):
    (package / 'lib/pkg/exe').write_text(
        f'#!/bin/sh\nfor word; do [ ! -f "$word" ] || cat "$word" >{tmp_path}/seen; done\n')
    (tmp_path / 'p.yaml').write_text('/**: {ros__parameters: {p: caf\xe9}}', 'utf-8')
    file = tmp_path / f'a.launch.{kind}'
    file.write_text(ACCENTED[kind], 'utf-8')
    # else Python takes UTF-8 in place of ASCII, which is this locale's encoding
    subprocess.run([sys.executable, '-c', RUN, file], check=True, env={
        **os.environ, 'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'})
    seen = yaml.safe_load((tmp_path / 'seen').read_text('utf-8'))
    assert seen == {'/**': {'ros__parameters': {'p': 'caf\xe9'}}}


def test_parameter_file_is_passed_or_substituted(tmp_path, capsys):
    file = tmp_path / 'p.yaml'
    file.write_text('/**: {ros__parameters: {a: $(var i)}}')
    substituted = ParameterFile(file, allow_substs=True)
    got, action = command(configurations={'i': '7'}, parameters=[
        str(file), file, PathJoinSubstitution([str(tmp_path), 'p.yaml']), substituted,
        '/no/such/file'])
    assert got[:7] == ['--ros-args', *['--params-file', str(file)] * 3]
    assert got[7] == '--params-file' and len(got) == 9
    assert load(got[8]) == {'/**': {'ros__parameters': {'a': 7}}}
    assert 'Parameter file path is not a file: /no/such/file' in capsys.readouterr().out
    substituted.cleanup()
    assert not os.path.exists(got[8]) and file.exists()
    context = LaunchContext()
    context.launch_configurations['i'] = '8'
    assert load(substituted.evaluate(context)) == {'/**': {'ros__parameters': {'a': 8}}}


def test_invalid_parameters_are_refused():
    with pytest.raises(TypeError, match="'parameters' to be one of"):
        Node(executable='exe', parameters={'a': 1})
    with pytest.raises(TypeError, match='Expecting list of parameters'):
        normalize_parameters('text')
    context = LaunchContext()
    for bad in ({'a': []}, {'a': LaunchConfiguration('x', default='[1, a]')},
                {'a': LaunchConfiguration('x', default='{b: 1}')},
                {'a': LaunchConfiguration('x', default=': : :')}):
        with pytest.raises(TypeError):
            evaluate_parameters(context, normalize_parameters([bad]))
    with pytest.raises(TypeError, match='Unexpected type for parameter value'):
        normalize_parameters([{'a': object()}])
    with pytest.raises(TypeError, match='remap_rule must be a tuple of length 2'):
        normalize_remap_rule(('a',))


@pytest.mark.parametrize('base, name, expected', [
    (None, None, None), (None, 'a', 'a'), ('/', 'a', '/a'), ('/a', 'b/', '/a/b'),
    ('/a', '/b', '/b'), ('a', None, 'a'), ('', 'a', 'a')])
def test_namespaces_are_joined(base, name, expected):
    assert prefix_namespace(base, name) == expected
    assert make_namespace_absolute('a') == '/a' and make_namespace_absolute(None) is None


def test_substitutions_find_packages_and_executables(package):
    context = LaunchContext()
    assert FindPackagePrefix('pkg').perform(context) == str(package)
    assert FindPackageShare(['p', 'kg']).perform(context) == str(package / 'share' / 'pkg')
    executable = ExecutableInPackage(package='pkg', executable='exe')
    assert executable.perform(context) == str(package / 'lib' / 'pkg' / 'exe')
    assert executable.describe() == "ExecInPkg(pkg='pkg', exec='exe')"
    with pytest.raises(SubstitutionFailure, match="executable 'no' not found on the libexec"):
        ExecutableInPackage(package='pkg', executable='no').perform(context)
    with pytest.raises(LookupError, match="package 'no' not found"):
        FindPackageShare('no').perform(context)


def test_two_nodes_of_one_name_are_reported(capsys):
    service = LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription([
        Node(package='pkg', executable='exe', name='n', namespace='/') for _ in range(2)]))
    assert service.run() == 0
    assert ('there are now at least 2 nodes with the name /n created within this launch '
            'context') in capsys.readouterr().out


def test_log_directory_is_set(tmp_path, monkeypatch):
    context = LaunchContext()
    monkeypatch.setenv('ROS_LOG_DIR', '/somewhere')
    SetROSLogDir(['sub', LaunchConfiguration('x', default='1')]).execute(context)
    assert os.environ['ROS_LOG_DIR'] == '/somewhere/sub1'
    SetROSLogDir('/elsewhere').execute(context)
    assert os.environ['ROS_LOG_DIR'] == '/elsewhere'


XML = '''<launch>
  <push_ros_namespace namespace="a"/>
  <set_parameter name="g" value="1"/>
  <set_remap from="x" to="y"/>
  <node pkg="pkg" exec="exe" name="n" namespace="b" args="one 'two words'"
        ros_args="--log-level $(var level)" output="screen">
    <param name="nested"><param name="deep" value="$(var level)"/></param>
    <param from="$(dirname)/p.yaml" allow_substs="true"/>
    <remap from="p" to="q"/>
    <env name="X" value="Y"/>
  </node>
</launch>'''

YAML = '''
launch:
- push_ros_namespace: {namespace: a}
- set_parameter: {name: g, value: '1'}
- set_remap: {from: x, to: y}
- node:
    pkg: pkg
    exec: exe
    name: n
    namespace: b
    args: one 'two words'
    ros_args: --log-level $(var level)
    output: screen
    param:
    - {name: nested, param: [{name: deep, value: $(var level)}]}
    - {from: $(dirname)/p.yaml, allow_substs: true}
    remap: [{from: p, to: q}]
    env: [{name: X, value: Y}]
'''


@pytest.mark.parametrize('name, content', [('a.launch.xml', XML), ('a.launch.yaml', YAML)],
                         ids=['xml', 'yaml'])
def test_xml_and_yaml_describe_a_node(tmp_path, capsys, name, content):
    (tmp_path / name).write_text(content)
    (tmp_path / 'p.yaml').write_text('/**: {ros__parameters: {level: $(var level)}}')
    contents = []

    def read_files(context):
        for path in tmp_path.glob('launch_params_*'):
            contents.append(plain(load(path)))

    service = LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription([
        IncludeLaunchDescription(str(tmp_path / name), launch_arguments={'level': 'warn'}.items()),
        OpaqueFunction(function=read_files)]))
    assert service.run() == 0
    got = [line.partition('] word ')[2] for line in capsys.readouterr().out.splitlines()
           if '] word ' in line]
    assert got[:10] == ['one', 'two words', '--ros-args', '--log-level', 'warn', '--ros-args',
                        '-r', '__node:=n', '-r', '__ns:=/a/b']
    assert got[10:12] == ['-p', 'g:=1'] and got[-4:] == ['-r', 'x:=y', '-r', 'p:=q']
    merged = {key: value for content in contents for node in content.values()
              for key, value in node['ros__parameters'].items()}
    assert merged == {'nested.deep': 'warn', 'level': 'warn'}
    assert {key for content in contents for key in content} == {'/a/b/n', '/**'}


def test_composable_nodes_are_described():
    node = ComposableNode(
        package='image_tools', plugin='image_tools::Cam2Image', name=['c', 'am'], namespace='/ns',
        parameters=[{'a': 1}], remappings=[('a', 'b')],
        extra_arguments=[{'use_intra_process_comms': True}])
    context = LaunchContext()
    assert [perform_substitutions(context, part) for part in (
        node.package, node.node_name, node.node_plugin, node.node_namespace)] == [
            'image_tools', 'cam', 'image_tools::Cam2Image', '/ns']
    assert evaluate_parameters(context, [*node.parameters, *node.extra_arguments]) == (
        {'a': 1}, {'use_intra_process_comms': True})
    container = ComposableNodeContainer(
        name='c', namespace='/', package='pkg', executable='exe',
        composable_node_descriptions=[node])
    LoadComposableNodes(target_container=container, composable_node_descriptions=[node])
    visit(context, container)
    assert container.node_name == '/c'
    with pytest.raises(TypeError):
        LoadComposableNodes(target_container=5, composable_node_descriptions=[])


def test_lifecycle_events_match_their_node():
    action = LifecycleNode(package='pkg', executable='exe', name='n', namespace='')
    visit(LaunchContext(), action)
    assert matches_node_name('n')(action) and matches_node_name('/n')(action)
    event = ChangeState(lifecycle_node_matcher=matches_node_name('n'), transition_id=1)
    assert event.lifecycle_node_matcher(action) and event.transition_id == 1
    with pytest.raises(ValueError, match="given transition_id of '77', expected one of"):
        ChangeState(lifecycle_node_matcher=matches_node_name('n'), transition_id=77)
    handler = OnStateTransition(target_lifecycle_node=action, goal_state='active', entities=[])
    assert not handler.matches(event)
    with pytest.raises(RuntimeError, match="requires a 'LifecycleNode' action"):
        OnStateTransition(target_lifecycle_node=Node(executable='x'), entities=[])


@pytest.mark.skipif(importlib.util.find_spec('embedded_default') is None,
                    reason='ROS 2 leaves its parameter files')
def test_parameter_files_are_deleted_at_exit(tmp_path):
    code = '''
import glob, sys
from launch import LaunchContext
from launch_ros.actions import Node
node = Node(package='pkg', executable='exe', parameters=[{'a': 1}])
node._perform_substitutions(LaunchContext())
print(len(glob.glob(sys.argv[1] + '/launch_params_*')))
'''
    done = subprocess.run([sys.executable, '-c', code, str(tmp_path)], capture_output=True,
                          text=True, env={**os.environ, 'TMPDIR': str(tmp_path)})
    assert done.stdout.split()[-1:] == ['1'], done.stderr
    assert not list(tmp_path.glob('launch_params_*'))

# SPDX-License-Identifier: Apache-2.0
"""
What launch and launch_ros of ROS 2 Jazzy got after the end of 2024, through its public API alone.

An installation of ROS 2 that is older skips these tests.
"""

import importlib.util
from pathlib import Path
import re

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    GroupAction,
    IncludeLaunchDescription,
    LogInfo,
    OpaqueFunction,
    SetEnvironmentVariable,
    SetLaunchConfiguration,
    TimerAction,
)
from launch.launch_description_sources import AnyLaunchDescriptionSource
import launch.logging
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, ThisLaunchFileDir
from launch.utilities import perform_substitutions
from launch.utilities.type_utils import normalize_typed_substitution
from launch_ros.actions import (
    get_composable_node_load_request,
    LifecycleNode,
    Node,
    PushROSNamespace,
    SetParameter,
    SetRemap,
)
from launch_ros.descriptions import ComposableNode
from launch_ros.substitutions import FindPackageShare
import pytest
import yaml

PAGE = Path(__file__).parents[2] / 'doc/developers/ros2_embedded.md'


def matched(package):
    """Return the version of a package of ROS 2 that the embedded default matches."""
    return re.search(rf'`{package}` (\d+)\.(\d+)\.(\d+)\b', PAGE.read_text()).groups()


def installed(package):
    """Return the installed version; None for the embedded default, which has its own."""
    if importlib.util.find_spec('embedded_default'):
        return None
    manifest = Path(get_package_share_directory(package), 'package.xml').read_text()
    return re.search(r'<version>(\d+)\.(\d+)\.(\d+)</version>', manifest).groups()


@pytest.mark.parametrize('package', ['launch', 'launch_ros'])
def test_no_newer_version_of_ros2_is_installed(package):
    """If this fails, read the package's change log: what is new there is missing here."""
    found = installed(package)
    assert found is None or [*map(int, found)] <= [*map(int, matched(package))]


if not hasattr(launch.substitutions, 'PathSubstitution') or installed('launch_ros') and (
        [*map(int, installed('launch_ros'))] < [*map(int, matched('launch_ros'))]):
    pytest.skip('launch is older', allow_module_level=True)
PathSubstitution = launch.substitutions.PathSubstitution
A = LaunchConfiguration('a')


pytestmark = pytest.mark.usefixtures('own_log')


def run(*entities):
    service = LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription(entities))
    assert service.run() == 0
    return service


def note(notes, name):
    return OpaqueFunction(
        function=lambda context: notes.append(context.launch_configurations.get(name)))


# -- paths: launch 3.4.5, 3.4.9, 3.4.10, launch_ros 0.26.10 ---------------------------------------

@pytest.mark.parametrize('path, text', [
    (PathJoinSubstitution(['/a', A, Path('b/c')]), '/a/1/b/c'),
    (PathJoinSubstitution(['/a']) / A / Path('c') / 'd.x', '/a/1/c/d.x'),
    (PathSubstitution(A) / 'b', '1/b'),
    (PathSubstitution(A) / '/b', '/b'),
    (PathSubstitution(Path('/a')) / PathJoinSubstitution(['b', 'c']), '/a/b/c'),
    (ThisLaunchFileDir() / 'x.py', '/launch/x.py'),
    (FindPackageShare(['p', 'kg']) / 'launch' / Path('x.py'), '{}/share/pkg/launch/x.py'),
    (PathJoinSubstitution(['/a', [A, '.yaml']]), '/a/1.yaml'),
    (PathSubstitution('a') / ('m_', A, '.x'), 'a/m_1.x'),
    # one part each, unlike in a part of PathJoinSubstitution
    (PathSubstitution(['/a', A]), '/a/1'),
])
def test_slash_joins_paths(package, path, text):
    context = LaunchContext()
    context.launch_configurations['a'] = '1'
    context.extend_locals({'current_launch_file_directory': '/launch'})
    assert path.perform(context) == text.format(package)


def test_path_is_a_text(tmp_path, capsys):
    included = tmp_path / 'included.py'
    included.write_text('from launch import LaunchDescription\n'
                        'from launch.actions import DeclareLaunchArgument, LogInfo\n'
                        'from launch.substitutions import LaunchConfiguration\n'
                        'def generate_launch_description():\n'
                        "    return LaunchDescription([DeclareLaunchArgument('at'), LogInfo(\n"
                        "        msg=['AT ', LaunchConfiguration('at')])])\n")
    service = run(
        LogInfo(msg=tmp_path), GroupAction([
            SetEnvironmentVariable('FOG_PATH', tmp_path / 'env'),
            ExecuteProcess(cmd=[Path('/bin/sh'), '-c', ['cd ', tmp_path, '; pwd; echo $FOG_PATH']],
                           cwd=Path('/'), output='screen')]),
        IncludeLaunchDescription(included, launch_arguments={'at': Path('a/b')}.items()),
        DeclareLaunchArgument('with_default', default_value=Path('/d')))
    shown = capsys.readouterr().out
    assert all(text in shown for text in (f'{tmp_path}\n', f'{tmp_path}/env', 'AT a/b'))
    assert service.context.launch_configurations['with_default'] == '/d'
    with pytest.raises(TypeError):
        LogInfo(msg=3)


def test_path_is_a_text_for_nodes(tmp_path, package):
    file = tmp_path / 'p.yaml'
    file.write_text('{}')
    node = Node(package='pkg', executable=Path('exe'), name='n', arguments=[Path('/a b')],
                parameters=[file, FindPackageShare('pkg') / 'none.yaml'])
    run(node)
    assert node.process_details['cmd'] == [
        str(package / 'lib/pkg/exe'), '/a b', '--ros-args', '-r', '__node:=n', '--params-file',
        str(file)]


def test_path_is_a_text_as_parameter(package):
    """Only here: ROS 2 refuses a Path among the values of a dictionary."""
    if installed('launch_ros'):
        pytest.skip('ROS 2 refuses it')
    node = Node(package='pkg', executable='exe',
                parameters=[{'one': Path('/x'), 'some': [Path('/y'), 'z']}])
    run(node)
    assert yaml.safe_load(Path(node.process_details['cmd'][-1]).read_text()) == {
        '/**': {'ros__parameters': {'one': '/x', 'some': ['/y', 'z']}}}
    assert normalize_typed_substitution(Path('/x'), str) == '/x'


# -- <let> below <include>: launch 3.4.7 ----------------------------------------------------------

@pytest.mark.parametrize('name, content', [
    ('main.launch.xml',
     '<launch><include file="$(dirname)/inner.launch.xml"><let name="who" value="front"/>'
     '<arg name="how" value="well"/></include></launch>'),
    ('main.launch.yaml',
     'launch: [{include: {file: $(dirname)/inner.launch.xml, arg: [{name: how, value: well}],'
     ' let: [{name: who, value: front}]}}]')])
def test_include_passes_arguments_by_let_or_arg(tmp_path, capsys, name, content):
    (tmp_path / 'inner.launch.xml').write_text(
        '<launch><arg name="who"/><arg name="how"/>'
        '<log message="GOT $(var who) $(var how)"/></launch>')
    (tmp_path / name).write_text(content)
    run(IncludeLaunchDescription(tmp_path / name))
    assert 'GOT front well' in capsys.readouterr().out


# -- timers: launch 3.4.5, 3.4.6 ------------------------------------------------------------------

def test_timer_keeps_the_configurations_of_its_group():
    notes = []
    run(SetLaunchConfiguration('a', 'outer'),
        GroupAction([
            SetLaunchConfiguration('a', 'inner'),
            TimerAction(period=0.05, actions=[
                note(notes, 'a'), SetLaunchConfiguration('a', 'changed by the timer')])]),
        TimerAction(period=0.5, actions=[note(notes, 'a')]))
    assert notes == ['inner', 'outer']


def test_timer_takes_its_period_from_its_group():
    """Only here: launch looks it up when the group is over, and then never ends."""
    if installed('launch'):
        pytest.skip('ROS 2 looks it up too late')
    notes = []
    run(GroupAction([
        SetLaunchConfiguration('period', '0.05'),
        TimerAction(period=LaunchConfiguration('period'), actions=[note(notes, 'period')])]))
    assert notes == ['0.05']


def test_timed_node_has_namespace_and_remappings_of_its_group(package):
    """Also where something is added to their lists before the timer's period is over."""
    nodes = [Node(package='pkg', executable='exe', name='n') for _ in range(2)]
    run(SetRemap('a', 'b'),
        GroupAction([PushROSNamespace('front'), SetParameter('p', 1),
                     TimerAction(period=0.05, actions=[nodes[0]])]),
        SetRemap('c', 'd'), TimerAction(period=0.05, actions=[nodes[1]]))
    assert nodes[0].node_name == '/front/n' and 'p:=1' in nodes[0].process_details['cmd']
    assert nodes[0].expanded_remapping_rules == [('a', 'b')]
    assert nodes[1].expanded_remapping_rules == [('a', 'b'), ('c', 'd')]
    assert 'p:=1' not in nodes[1].process_details['cmd']


# -- <lifecycle_node>: launch_ros 0.26.12; autostart=: 0.26.7, see test_launch_ros_lifecycle.py ---

@pytest.mark.parametrize('name, content', [
    ('a.launch.xml', '<launch><lifecycle_node pkg="pkg" exec="exe" name="n" namespace="a" '
                     'autostart="$(var auto)"/></launch>'),
    ('a.launch.yaml', 'launch: [{lifecycle_node: {pkg: pkg, exec: exe, name: n, namespace: a, '
                      'autostart: $(var auto)}}]')])
def test_xml_and_yaml_describe_a_lifecycle_node(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    context = LaunchContext()
    context.launch_configurations['auto'] = 'true'
    [node] = AnyLaunchDescriptionSource(tmp_path / name).get_launch_description(context).entities
    assert isinstance(node, LifecycleNode)
    assert perform_substitutions(context, node.node_autostart) == 'true'


# -- wildcards of parameter files: launch_ros 0.26.8 ----------------------------------------------

WILDCARDS = '''
/**: {ros__parameters: {all: 1, last: 1, nested: {all: 1}}}
/*/eye: {ros__parameters: {token: 2, last: 2}}
/front/*: {ros__parameters: {node: 3, last: 3}}
/**/eye: {ros__parameters: {any: 4, last: 4}}
/front/eye: {ros__parameters: {exact: 5, last: 5, nested: {exact: 5}}}
/**/front/eye: {ros__parameters: {none: 7, last: 7}}
/*: {ros__parameters: {other: 8, last: 8}}
/front: {ros__parameters: {other: 8, last: 8}}
/other/**: {ros__parameters: {other: 8, last: 8}}
/front/eye/*: {ros__parameters: {other: 8, last: 8}}
/eye: {ros__parameters: {other: 8, last: 8}}
'''


def test_wildcards_of_parameter_files_match_components(tmp_path):
    """The last part of a file that means a node wins, as rcl decides for nodes of their own."""
    pytest.importorskip('composition_interfaces')
    file = tmp_path / 'params.yaml'
    file.write_text(WILDCARDS)
    request = get_composable_node_load_request(
        ComposableNode(package='p', plugin='p::Eye', name='eye', namespace='front',
                       parameters=[file]), LaunchContext())
    # of equal names the container takes the last
    assert {one.name: one.value.integer_value for one in request.parameters} == {
        'all': 1, 'token': 2, 'node': 3, 'any': 4, 'exact': 5, 'none': 7, 'last': 7,
        'nested.all': 1, 'nested.exact': 5}

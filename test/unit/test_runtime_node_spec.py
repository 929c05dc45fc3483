# SPDX-License-Identifier: Apache-2.0
"""What a resolved process action becomes on its way to a machine."""

from __future__ import annotations

import dataclasses
import os
import tempfile

from launch import LaunchContext
from launch.actions import AppendEnvironmentVariable, ExecuteProcess, SetEnvironmentVariable
from launch.substitutions import FindExecutable, LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage
import pytest
import yaml

from fogros2.errors import ConfigurationError, WorkspaceError
from fogros2.model import MachineSpec, NodeSpec
from fogros2.runtime import node_spec
from fogros2.runtime.node_spec import Texts

SPEC = MachineSpec('planner', 'container')


def make_package(prefix, name, *executables):
    marker = prefix / 'share/ament_index/resource_index/packages' / name
    marker.parent.mkdir(parents=True, exist_ok=True)
    marker.touch()
    (prefix / 'share' / name).mkdir(parents=True)
    (prefix / 'lib' / name).mkdir(parents=True)
    for executable in executables:
        (prefix / 'lib' / name / executable).touch(0o755)


@pytest.fixture
def prefix(tmp_path, monkeypatch):
    make_package(tmp_path / 'ros', 'demo', 'talker')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'ros'))
    return tmp_path / 'ros'


@pytest.fixture
def context(prefix, tmp_path, monkeypatch):
    # launch leaves the parameter files it makes
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    before = dict(os.environ)
    context = LaunchContext()
    yield context
    os.environ.clear()
    os.environ.update(before)


def convert(action, context, spec=SPEC, **more):
    base = dict(os.environ)
    return convert_with(action, context, base, spec, **more)


def convert_with(action, context, base, spec=SPEC, **more):
    node_spec.use_names_of_programs(action)
    if isinstance(action, Node):
        action._perform_substitutions(context)
        context.extend_locals({'ros_specific_arguments': {
            'name': '__node:=arm', 'ns': '__ns:=/x'}})
    action.prepare(context)
    return node_spec.from_action(action, context, base, spec, 'abcdef', **more)


def test_a_node(context):
    spec = convert(Node(
        package='demo', executable='talker', name='arm', arguments=['--fast'],
        remappings=[('a', 'b')], exec_name='worker'), context)
    assert (spec.package, spec.executable) == ('demo', 'talker')
    assert spec.arguments[:4] == ('--fast', '--ros-args', '-r', '__node:=arm')
    assert spec.arguments[-2:] == ('-r', 'a:=b')
    assert spec.name.startswith('worker-') and spec.id == f'{spec.name}.abcdef'
    assert spec.prefix == () and spec.environment == {} and spec.files == {}


def test_names_from_the_launch_configuration(context):
    context.launch_configurations.update(pkg='demo', exe='talker')
    spec = convert(Node(
        package=LaunchConfiguration('pkg'), executable=[LaunchConfiguration('exe')]), context)
    assert (spec.package, spec.executable) == ('demo', 'talker')


def test_prefix_and_time_outs(context):
    context.launch_configurations.update({'sigterm_timeout': '7', 'emulate_tty': 'true'})
    spec = convert(Node(
        package='demo', executable='talker', prefix='gdb -ex "run it"', respawn=True,
        respawn_delay=1.5, respawn_max_retries=4, sigkill_timeout='3', cwd='/somewhere'), context)
    assert spec.prefix == ('gdb', '-ex', 'run it')
    assert (spec.package, spec.executable, spec.cwd) == ('demo', 'talker', '/somewhere')
    assert (spec.respawn, spec.respawn_delay, spec.respawn_max_retries) == (True, 1.5, 4)
    assert (spec.sigterm_timeout, spec.sigkill_timeout, spec.emulate_tty) == (7.0, 3.0, True)


def test_prefix_and_working_directory_get_markers(context, prefix):
    spec = convert(Node(
        package='demo', executable='talker', prefix=f'gdb -x {prefix}/share/demo/gdb',
        cwd=f'{prefix}/share/demo'), context)
    assert spec.prefix == ('gdb', '-x', ({'share': 'demo'}, '/gdb'))
    assert spec.cwd == ({'share': 'demo'},)


def test_a_command(context):
    command = {'cmd': [[FindExecutable(name='sh'), ' -c true']], 'shell': True}
    spec = convert(ExecuteProcess(**command), context)
    # not where the robot has it
    assert (spec.package, spec.arguments, spec.shell) == ('', ('sh -c true',), True)


@pytest.mark.parametrize('command, arguments', [
    (lambda program: ['gdb', program], ('gdb', ({'prefix': 'demo'}, '/lib/demo/talker'))),
    (lambda program: [[program, ' --fast']], (({'prefix': 'demo'}, '/lib/demo/talker --fast'),)),
])
def test_program_of_a_package_among_arguments(context, prefix, command, arguments):
    program = ExecutableInPackage(package='demo', executable='talker')
    spec = convert(ExecuteProcess(cmd=command(program)), context)
    assert (spec.package, spec.arguments) == ('', arguments)


def test_parameter_files_travel(context, prefix, tmp_path):
    file = tmp_path / 'arm.yaml'
    file.write_text(f'/**:\n  ros__parameters:\n    model: {prefix}/share/demo/arm.urdf\n')
    spec = convert(Node(
        package='demo', executable='talker', parameters=[str(file), {'speed': 3}]), context)
    keys = [word[0]['file'] for word in spec.arguments if isinstance(word, tuple)]
    assert len(keys) == 2 and set(keys) == set(spec.files)
    assert keys[0].endswith('arm.yaml')
    assert spec.files[keys[0]] == (
        '/**:\n  ros__parameters:\n    model: ', {'share': 'demo'}, '/arm.urdf\n')
    # the quotes depend on the version of launch_ros
    assert yaml.safe_load(spec.files[keys[1]]) == {'/**': {'ros__parameters': {'speed': 3}}}


def test_files_in_plain_arguments_travel(context, tmp_path):
    file = tmp_path / 'log.conf'
    file.write_text('x')
    spec = convert(Node(package='demo', executable='talker',
                        ros_arguments=['--log-config-file', str(file)]), context)
    assert list(spec.files.values()) == ['x']


def test_a_file_that_cannot_be_read(context):
    with pytest.raises(ConfigurationError, match='/no/such.yaml'):
        convert(Node(package='demo', executable='talker',
                     arguments=['--ros-args', '--params-file', '/no/such.yaml']), context)


def test_environment(context):
    base = dict(os.environ)
    for name, value in {'SET': 'x', 'PATH': '/robot'}.items():
        SetEnvironmentVariable(name, value).execute(context)
    spec = convert_with(ExecuteProcess(
        cmd=['true'], additional_env={'MORE': 'y', 'PYTHONPATH': '/told/so'}), context, base)
    assert spec.environment == {'SET': 'x', 'MORE': 'y'}
    spec = convert_with(ExecuteProcess(cmd=['true'], env={'ALONE': 'z'}), context, base)
    assert spec.environment == {'ALONE': 'z'}


@pytest.mark.parametrize('contained', [False, True])
def test_folders_that_a_launch_file_adds_are_sent(context, prefix, contained):
    os.environ.update(PATH='/usr/bin:/bin', LD_LIBRARY_PATH='/robot', PYTHONPATH='')
    base = dict(os.environ)
    SetEnvironmentVariable('LD_LIBRARY_PATH', f'{prefix}/lib/demo:/robot:').execute(context)
    AppendEnvironmentVariable('PYTHONPATH', '/py').execute(context)
    spec = convert_with(ExecuteProcess(
        cmd=['true'], additional_env={'PATH': '/x:/bin'}), context, base, contained=contained)
    # in a container, a list would replace the image's own
    assert spec.folders == ({} if contained else {
        'LD_LIBRARY_PATH': ({'prefix': 'demo'}, '/lib/demo'), 'PYTHONPATH': '/py', 'PATH': '/x'})
    assert spec.environment == ({'PATH': '/x:/bin'} if contained else {})


def test_unknown_programs(context):
    with pytest.raises(WorkspaceError, match="no executable 'taker'"):
        convert(Node(package='demo', executable='taker'), context)
    spec = convert(Node(package='theirs', executable='own'), context, own_packages=True)
    assert (spec.package, spec.executable) == ('theirs', 'own')


# -- markers in texts ----------------------------------------------------------------------------


def test_paths_below_prefixes_become_markers(tmp_path):
    one, two = tmp_path / 'one', tmp_path / 'one/two'
    make_package(one, 'demo')
    make_package(two, 'tools')
    texts = Texts([str(two), f'{one}/'], None)
    assert texts.text(f'{one}/share/demo') == ({'share': 'demo'},)
    assert texts.text(rf'\n{one}/share/demo') == (r'\n', {'share': 'demo'})
    assert texts.text(f'file://{one}/share/demo/a.rviz,{two}/lib/tools/run') == (
        'file://', {'share': 'demo'}, '/a.rviz,', {'prefix': 'tools'}, '/lib/tools/run')


@pytest.mark.parametrize('text', [
    '{one}/share/doc', '{one}/share/demo-2/x', '{one}/share', '{one}/etc/demo',
    '/copy{one}/share/demo', 'nothing at all', '',
])
def test_other_paths_stay(tmp_path, text):
    make_package(tmp_path, 'demo')
    text = text.format(one=tmp_path)
    assert Texts([str(tmp_path)], None).text(text) == text


def test_paths_of_the_workspace_stay(tmp_path):
    install = tmp_path / 'ws/install/demo'
    make_package(install, 'demo')
    text = f'{install}/share/demo/x'
    assert Texts([str(install)], str(tmp_path / 'ws')).text(text) == text
    assert Texts([str(install)], None).text(text) == ({'share': 'demo'}, '/x')
    assert Texts([], None).text(text) == text


@pytest.mark.parametrize('moved', [False, True])
def test_paths_of_a_workspace_that_a_guest_sends_are_looked_up(context, tmp_path, moved):
    install = tmp_path / 'ws/install/mine'
    make_package(install, 'mine')
    map_file = f'{install}/share/mine/map.yaml'
    found = convert_with(
        ExecuteProcess(cmd=['look', map_file]), context, {'AMENT_PREFIX_PATH': str(install)},
        dataclasses.replace(SPEC, workspace=str(tmp_path / 'ws')), moved=moved)
    assert found.arguments[-1] == (({'share': 'mine'}, '/map.yaml') if moved else map_file)


@pytest.mark.parametrize(('changes', 'found'), [
    ({'arguments': ('map:=/home/me/maps/a.yaml', '/home/me', '/home/meadow/x')},
     ['/home/me', '/home/me/maps/a.yaml']),
    ({'environment': {'MAP': '/home/me/a b'}, 'cwd': '/home/me/run'},
     ['/home/me/a', '/home/me/run']),
    ({'prefix': ('gdb', '-x', '/home/me/gdb')}, ['/home/me/gdb']),
    ({'arguments': (f'file:={__file__}', f'{__file__}.new', '/usr/bin/env')}, [__file__]),
    ({'folders': {'PATH': '/bin:/home/me/bin'}}, ['/home/me/bin']),
    ({'files': {'0': ("map: '/home/me/b.pgm'", {'share': 'demo'}, '/x')}}, ['/home/me/b.pgm']),
    ({'arguments': ('/home/me/ws/install/x', 'http://host/home/me/y', ({'file': '0'},))}, []),
])
def test_paths_of_the_robot_are_found(changes, found):
    node = NodeSpec('id', 'talker', **changes)
    assert node_spec.robot_paths(node, ['/home/me/', ''], ['/home/me/ws']) == found

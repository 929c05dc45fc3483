# SPDX-License-Identifier: Apache-2.0
"""Machines as launch files write them: plain values, substitutions, mistakes."""

from __future__ import annotations

from datetime import timedelta
import os
from pathlib import Path
import subprocess
import sys

import pytest

from fogros2 import feature
from fogros2.describe.machines import (
    CloudInstance,
    ContainerInstance,
    SSHInstance,
)
from fogros2.describe.machines_cloud import AWSCloudInstance
from fogros2.describe.values import parse_duration
from fogros2.errors import ConfigurationError
from fogros2.host.workspace import find_workspaces


@pytest.fixture
def context():
    from launch import LaunchContext
    return LaunchContext()


def test_defaults(context):
    assert ContainerInstance().name != ContainerInstance().name
    spec = ContainerInstance(name='planner', ros_workspace='').spec(context)
    assert (spec.name, spec.provider, spec.workspace) == ('planner', 'container', None)
    assert (spec.on_exit, spec.lifetime, spec.robot_timeout) == ('delete', 8 * 3600, 120)
    assert (spec.bootstrap, spec.options, spec.environment) == ('auto', {}, {})


def test_machine_takes_options_and_keywords_of_features(context):
    machine = ContainerInstance(
        ros_workspace='/robot/ws', launch_foxglove=True, name='planner',
        on_exit='keep', lifetime='1h30m', robot_timeout=30, bootstrap='none',
        environment={'A': '1'}, cpus=1.5, ports=['8080:80'], isolated='true')
    machine.add_docker_container('docker run hello-world')
    spec = machine.spec(context)
    assert spec.options == {
        'cpus': 1.5, 'ports': ['8080:80'], 'isolated': True, 'containers': True}
    assert (spec.workspace, spec.on_exit, spec.lifetime) == ('/robot/ws', 'keep', 5400)
    assert (spec.robot_timeout, spec.bootstrap, spec.environment) == (30, 'none', {'A': '1'})
    assert spec.features == {
        'containers': {'docker_containers': ['docker run hello-world']},
        'monitor': {'launch_foxglove': True}}


def test_container_on_another_computer(context):
    from launch.substitutions import LaunchConfiguration
    context.launch_configurations.update(box='gpu-box')
    box = SSHInstance(LaunchConfiguration('box'), 'lab', 2222, host_key='ssh-ed25519 AAAA')
    spec = ContainerInstance(name='planner', on=box, memory='2g', gpus='all').spec(context)
    assert spec.provider == 'hosted' and box.provider == 'ssh'
    assert spec.options == {'memory': '2g', 'gpus': 'all', 'on': {
        'host': 'gpu-box', 'user': 'lab', 'port': 2222, 'host_key': 'ssh-ed25519 AAAA'}}
    text = ContainerInstance(name='planner', on={'host': 'gpu-box', 'port': '2222'}).spec(context)
    assert text.options == {'on': {'host': 'gpu-box', 'port': '2222'}}
    assert ContainerInstance(name='planner').spec(context).provider == 'container'


def test_shared_topics(context):
    from launch.substitutions import LaunchConfiguration
    context.launch_configurations.update(topic='/map')
    machine = ContainerInstance(
        name='planner', share=[LaunchConfiguration('topic'), '/tf_static', '/map'])
    given = machine.spec(context).features['share']
    assert feature.options('share', given) == ('/map', '/tf_static')
    for wrong in ('map', '/map/', '', '/a b', '/map*'):
        with pytest.raises(ConfigurationError, match='full name of a topic'):
            ContainerInstance(share=[wrong])
    with pytest.raises(ConfigurationError, match='no list'):
        ContainerInstance(share='/map')


@pytest.mark.parametrize('on', [AWSCloudInstance(), 'gpu-box', ContainerInstance()])
def test_only_ssh_hosts_have_container_machines(on):
    with pytest.raises(ConfigurationError, match='no host of container machines') as error:
        ContainerInstance(name='planner', on=on)
    assert 'SSHInstance' in error.value.hint


def test_substitutions_are_resolved_when_executed(context):
    from launch.substitutions import LaunchConfiguration
    context.launch_configurations.update(
        name='slam', memory='4g', cpus='2', exit='stop', life='2h', w='/w')
    machine = ContainerInstance(
        ros_workspace=LaunchConfiguration('w'), name=[LaunchConfiguration('name'), '-1'],
        memory=LaunchConfiguration('memory'), cpus=LaunchConfiguration('cpus'),
        on_exit=LaunchConfiguration('exit'),
        lifetime=LaunchConfiguration('life'), mounts=[['/', LaunchConfiguration('name'), ':/x']],
        environment={'NAME': LaunchConfiguration('name')})
    assert 'name' in machine.name
    spec = machine.spec(context)
    assert (spec.name, machine.name, spec.on_exit, spec.lifetime) == (
        'slam-1', 'slam-1', 'stop', 7200)
    assert spec.options == {'memory': '4g', 'cpus': 2.0, 'mounts': ['/slam:/x']}
    assert spec.environment == {'NAME': 'slam'} and spec.workspace == '/w'
    # once: a machine doesn't change when the configuration does
    context.launch_configurations['name'] = 'other'
    assert machine.spec(context) is spec


@pytest.mark.parametrize(('make', 'message'), [
    (lambda: ContainerInstance(imge='x'),
     "ContainerInstance has no attribute 'imge' (did you mean 'image'?)"),
    (lambda: ContainerInstance(zzz=1), 'there are: apt, bandwidth, bootstrap, '),
    (lambda: ContainerInstance(name='two words'), "'two words' is no name for a machine"),
    (lambda: ContainerInstance(name='$(reboot)'), 'is no name for a machine'),
    (lambda: ContainerInstance(on_exit='delet'), "did you mean 'delete'?"),
    (lambda: ContainerInstance(bootstrap='embedded'), 'use one of auto, apt, pip, none'),
    (lambda: ContainerInstance(on_exit='keep'), "a machine with on_exit='keep' needs a name"),
    (lambda: ContainerInstance(lifetime='soon'), 'is no duration'),
    (lambda: ContainerInstance(lifetime=8), "lifetime=8 would be 8 seconds (write the unit, such "
     "as '8h' or '8s')"),
    (lambda: ContainerInstance(idle_timeout='soon'), "idle_timeout='soon' is no duration"),
    (lambda: CloudInstance(), 'CloudInstance is no machine yet'),
    (lambda: ContainerInstance(apt='libzbar0'), "apt='libzbar0' is no list (apt=['libzbar0'])"),
    (lambda: ContainerInstance(monitor_allow='10.0.0.1'), 'is no list'),
    (lambda: ContainerInstance(devices=5), 'devices=5 has the wrong type (it takes a list)'),
    (lambda: ContainerInstance(pip=[None]), 'pip=[None] has the wrong type'),
    (lambda: ContainerInstance(name={}), 'name={} has the wrong type (it takes a text)'),
    (lambda: ContainerInstance(cpus=[1.5]), 'it takes a number'),
    (lambda: ContainerInstance(cpus='many'), "cpus: 'many' is no number"),
    (lambda: ContainerInstance(lifetime=timedelta(hours=8)), 'lifetime=datetime.timedelta'),
    (lambda: ContainerInstance(environment={1: 'A'}), 'it takes a mapping'),
    (lambda: ContainerInstance(isolated=b'no'), 'it takes a bool'),
    (lambda: AWSCloudInstance(tags=['robot']), 'it takes a mapping'),
    (lambda: ContainerInstance(apt=['libzbar0 -y']), 'no name of a Debian package'),
    (lambda: ContainerInstance(pip=['fogros2']), "'fogros2' is part of FogROS2"),
    (lambda: ContainerInstance().apt_install('--yes x'), 'no name of a Debian package'),
    (lambda: ContainerInstance().pip_install('-r all.txt'), 'names no Python package'),
])
def test_mistakes_are_found_where_they_are_written(make, message):
    with pytest.raises(ConfigurationError) as caught:
        make()
    assert message in str(caught.value)


def test_packages_of_fogros2s_methods_are_the_keywords(context):
    from launch.substitutions import TextSubstitution
    machine = ContainerInstance(
        apt=['libzbar0', TextSubstitution(text='g++')], pip=['pyzbar>=0.1'])
    machine.apt_install('ffmpeg libzbar0')
    machine.pip_install("'qrcode>=7,<8' pyzbar")
    spec = machine.spec(context)
    assert spec.apt == ('libzbar0', 'g++', 'ffmpeg')
    assert spec.pip == ('pyzbar>=0.1', 'qrcode>=7,<8', 'pyzbar')


def test_mistakes_in_substitutions(context):
    from launch.substitutions import LaunchConfiguration
    context.launch_configurations['x'] = 'no such thing'
    context.launch_configurations['keep'] = 'keep'
    for arguments in ({'on_exit': LaunchConfiguration('keep')},
                      {'cpus': LaunchConfiguration('x')},
                      {'name': LaunchConfiguration('x')},
                      {'on_exit': LaunchConfiguration('x')},
                      {'lifetime': LaunchConfiguration('x')}):
        with pytest.raises(ConfigurationError):
            ContainerInstance(**arguments).spec(context)


@pytest.mark.parametrize(('value', 'seconds'), [
    (90, 90), (0.5, 0.5), ('90', 90), ('8h', 28800), ('1h30m', 5400), ('2d', 172800),
    ('1.5h', 5400), ('45 s', 45),
])
def test_durations_have_at_most_two_units(value, seconds):
    assert parse_duration('lifetime', value) == seconds


@pytest.mark.parametrize(
    'value', ['', 'h', '-1', '0', 'inf', '8 hours', 'nan', -3, 10**400, '1e10'])
def test_no_durations(value):
    with pytest.raises(ConfigurationError):
        parse_duration('lifetime', value)


def test_numbers_are_texts_where_a_text_is_needed(context):
    spec = ContainerInstance(name=5, environment={
        'N': 1, 'S': Path('/x')}).spec(context)
    assert (spec.name, spec.environment) == ('5', {'N': '1', 'S': '/x'})


@pytest.mark.parametrize('isolated', [False, True])
@pytest.mark.parametrize('variable', ['COLCON_PREFIX_PATH', 'AMENT_PREFIX_PATH'])
def test_the_workspace_is_found(tmp_path, variable, isolated):
    install = tmp_path / 'ws/install'
    (install / 'demo').mkdir(parents=True)
    (install / '.colcon_install_layout').write_text('isolated\n')
    first = install / 'demo' if isolated else install
    environment = {variable: f'{first}{os.pathsep}/opt/ros/jazzy'}
    # an installed distribution may have the marker, but no sources beside it
    assert find_workspaces(environment) == []
    (tmp_path / 'ws/src').mkdir()
    assert find_workspaces(environment) == [str(tmp_path / 'ws')]
    assert find_workspaces({}) == []
    # ROS 2 that was built from source is the system, not a workspace
    (first.parent / 'ros_environment' if isolated else install).joinpath(
        'share/ros_environment').mkdir(parents=True)
    assert find_workspaces(environment) == []


def test_info(context):
    machine = ContainerInstance(
        ros_workspace='/ws', working_dir_base='there', name='planner')
    assert machine.info() == {
        'name': 'planner', 'cloud_service_provider': 'container', 'ros_workspace': '/ws',
        'working_dir': 'there', 'ssh_key_path': None, 'public_ip': None, 'vpn_ip': None}
    assert machine.info(flush_to_disk=True)['name'] == 'planner'


def test_importing_fogros2_loads_nothing():
    """Machines can be written down without launch, SSH or YAML."""
    code = (
        'import sys; before = set(sys.modules); import fogros2; '
        'from fogros2 import ContainerInstance, SSHInstance, CloudInstance, FogError; '
        'ContainerInstance(); dir(fogros2); '
        "print([m for m in sys.modules if m.split('.')[0] in "
        "('launch', 'launch_ros', 'rclpy', 'paramiko', 'boto3', 'yaml')])")
    result = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True,
        cwd=Path(__file__).parents[2])
    assert result.stdout.strip() == '[]'


def test_public_names():
    import fogros2
    # features' names, too
    assert {'FogError', 'StreamTopic'} <= set(fogros2.__all__) <= set(dir(fogros2))
    with pytest.raises(AttributeError, match='no attribute'):
        assert fogros2.CludNode

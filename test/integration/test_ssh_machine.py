# SPDX-License-Identifier: Apache-2.0
"""A computer that exists already, from a bare one to one that runs nodes, and back."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import textwrap
import uuid

import pytest

from fogros2 import store
from fogros2.provider.container import root as container_root
from fogros2.waiting import wait_until
from rigs.bare_computer import bare_computer
from rigs.colcon_workspace import colcon_workspace
from rigs.launched import embedded, ros2
from rigs.second_robot import join, second

__all__ = ['join', 'second']

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

#: Other runs of these tests may be under way on the same computer.
RUN = uuid.uuid4().hex[:6]
COLCON = shutil.which('colcon', path=os.pathsep.join(
    [os.path.dirname(sys.executable), os.environ.get('PATH', '')]))


@pytest.fixture(scope='module')
def computer(cloud_network, tmp_path_factory):
    """
    Run a computer with Python alone; where the robot has ROS 2, it has that as well.

    It may mount, as any computer that is not a container does.
    """
    mounts = [] if embedded() else container_root.environment_mounts(None)
    with bare_computer(f'fogt-ssh-{RUN}', tmp_path_factory.mktemp('computer'), cloud_network,
                       mounts=mounts, options=('--cap-add', 'SYS_ADMIN')) as running:
        yield running


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """Give the robot a home of its own, without known hosts and keys; its wheels are packed."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(store.cache_home().parent))
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    monkeypatch.delenv('SSH_AUTH_SOCK', raising=False)


def example(computer, **arguments):
    given = {'host': computer.address, 'user': computer.user, 'key': computer.key,
             'name': f'ssh-{RUN}', 'bootstrap': 'pip', 'count': 2, **arguments}
    return ['fogros2_examples', 'talker.ssh.launch.py',
            *(f'{name}:={value}' for name, value in given.items())]


def test_bare_computer_gets_missing_packages(computer, launch):
    run = launch(*example(computer, host_key=computer.host_key))
    assert run.ended() == 0, run.text
    assert f'I heard: [Hello World from {computer.name}' in run.text
    assert ('ROS 2 installed by pip' in run.text) == embedded()
    assert 'WARNING' not in run.text and run.errors == []
    assert computer.leftovers() == []


#: robot_timeout is more than a repair takes.
VOLUME = """
from fogros2 import CloudNode, FogROSLaunchDescription, SSHInstance


def generate_launch_description():
    machine = SSHInstance('lab', name='{name}', ros_workspace='', bootstrap='pip',
                          robot_timeout=10, volumes={{'models': '/data'}})
    return FogROSLaunchDescription([CloudNode(
        machine=machine, package='fogros2_examples', executable='talker', respawn=True,
        output='screen')])
"""


def no_data(computer):
    return computer.run('[ ! -e /data ]', check=False).returncode == 0


def volume_is_mounted_and_in_use(computer):
    assert computer.run('stat -c %U /data; echo kept >/data/model').stdout == 'fog\n'
    refused = ros2('fog', 'volume', 'delete', 'models', '--host', 'lab', '--yes')
    assert refused.returncode == 1 and 'a launch uses the volume' in refused.stderr


def agent_that_died_repairs_the_vpn(computer, run, name):
    running = ' '.join(computer.leftovers())
    assert 'agent.py' in running and 'talker' in running and name in running
    computer.run(f'kill -9 $(cat /run/fogros2/{name}/agent.pid)')
    run.wait_for('its agent died and was started again')
    run.said.clear()
    run.wait_for('Publishing')
    computer.run('ip link set $(ls /sys/class/net | grep ^fog) down')
    run.wait_for('the VPN was down for')


def agent_removes_all_but_the_volume(computer):
    # it misses the heartbeats
    wait_until(lambda: computer.leftovers() == [] and no_data(computer), timeout=60,
               what='the end of the nodes, the VPN and /data there')
    assert 'table inet fog' not in computer.run('nft list tables').stdout


def volume_comes_back(computer, again):
    again.wait_for('Publishing')
    assert computer.run('cat /data/model').stdout == 'kept\n'
    again.interrupt()
    assert again.ended() == 0, again.text
    wait_until(lambda: no_data(computer), timeout=10.0, what='/data to go')


def volume_is_listed_and_deleted(computer):
    assert 'models' in ros2('fog', 'volume', 'list', '--host', 'lab').stdout
    assert ros2('fog', 'volume', 'delete', '--host', 'lab', 'models', '--yes').returncode == 0
    assert computer.run(f'ls /home/{computer.user}/.local/share/fogros2-volumes').stdout == ''


def test_killed_launch_leaves_its_volume_alone(computer, launch, tmp_path):
    """Its agent has died before; ~/.ssh/config says how to reach the computer."""
    config = tmp_path / '.ssh/config'
    config.parent.mkdir(mode=0o700)
    known = config.with_name('known_hosts')
    known.write_text(f'{computer.address} {computer.host_key}\n')
    config.write_text(f'Host lab\nHostName {computer.address}\nUser {computer.user}\n'
                      f'IdentityFile {computer.key}\nUserKnownHostsFile {known}\n')
    names = [f'{word}-{RUN}' for word in ('dies', 'again')]
    first, second = (tmp_path / f'{name}.launch.py' for name in names)
    for path, name in zip((first, second), names):
        path.write_text(VOLUME.format(name=name))
    run = launch(str(first))
    run.wait_for('Publishing')
    volume_is_mounted_and_in_use(computer)
    agent_that_died_repairs_the_vpn(computer, run, names[0])
    run.kill()
    agent_removes_all_but_the_volume(computer)
    volume_comes_back(computer, launch(str(second)))
    assert ros2('fog', 'delete', names[0], '--yes').returncode == 0
    assert ros2('fog', 'gc').returncode == 0
    assert computer.leftovers() == []
    volume_is_listed_and_deleted(computer)


NODE = """\
from {package}.text import TEXT
import rclpy
from rclpy.node import Node

rclpy.init()
node = Node('{package}')
node.declare_parameter('speed', 0.0)
node.declare_parameter('colour', '')
speed, colour = (node.get_parameter(name).value for name in ('speed', 'colour'))
print(f'found {{TEXT}}, speed {{speed}}, {{colour}}, in {{__file__}}', flush=True)
node.destroy_node()
rclpy.shutdown()
"""


def listed():
    return [entry['name']
            for entry in json.loads(ros2('fog', 'list', '--json').stdout)['machines']]


def test_kept_computer_gets_only_changed_workspace_files(
        computer, launch, tmp_path):
    """known_hosts says who it is."""
    (tmp_path / '.ssh').mkdir(mode=0o700)
    (tmp_path / '.ssh/known_hosts').write_text(f'{computer.address} {computer.host_key}\n')
    package, name = f'fogt_{RUN}', f'kept-{RUN}'
    root = tmp_path / 'a workspace'
    variables = {**os.environ, **colcon_workspace(
        root, package, programs={'node': NODE.format(package=package)},
        module="TEXT = 'the first text'\n")}
    parameters = tmp_path / 'parameters.yaml'
    parameters.write_text(f'{package}:\n  ros__parameters:\n    speed: 2.5\n')
    path = tmp_path / 'kept.launch.py'
    path.write_text(textwrap.dedent(f"""
        from fogros2 import CloudNode, FogROSLaunchDescription, SSHInstance
        from launch.actions import DeclareLaunchArgument, Shutdown
        from launch.substitutions import LaunchConfiguration


        def generate_launch_description():
            machine = SSHInstance(
                '{computer.address}', '{computer.user}', key='{computer.key}', name='{name}',
                on_exit=LaunchConfiguration('on_exit'))
            return FogROSLaunchDescription([
                DeclareLaunchArgument('on_exit'),
                CloudNode(machine=machine, package='{package}', executable='node',
                          parameters=['{parameters}', {{'colour': 'blue'}}], output='screen',
                          on_exit=Shutdown()),
            ])
        """))
    first = launch(str(path), 'on_exit:=keep', environment=variables)
    assert first.ended() == 0, first.text
    program = root / 'install' / package / 'lib' / package / 'node'
    assert f'found the first text, speed 2.5, blue, in {program}' in first.text
    there = computer.run(f"cd '{root}' && find . -type f").stdout.split()
    assert f'./install/{package}/share/{package}/large' in there
    assert not [path for path in there if '.git' in path or 'build' in path]
    assert name in listed()

    computer.run('touch /tmp/marker')
    (module,) = root.glob(f'install/{package}/lib/*/site-packages/{package}/text.py')
    module.write_text("TEXT = 'the second text'\n")
    second = launch(str(path), 'on_exit:=delete', environment=variables)
    assert second.ended() == 0, second.text
    assert 'found the second text, speed 2.5, blue' in second.text
    assert 'kept from before' in second.text and '(there already)' in second.text
    assert computer.run(f'find /home/{computer.user}/.local -type f -newer /tmp/marker '
                        '2>/dev/null || :').stdout == ''
    assert 'workspace' in second.text and '(1 files, ' in second.text
    assert computer.leftovers() == []
    assert name not in listed()


#: A package that reads a parameter file out of its share folder.
ROB_TOOLS = {
    'package.xml': '<package format="3"><name>rob_tools</name><version>1.0.0</version>'
                   '<description>For a test.</description>'
                   '<maintainer email="nobody@example.org">nobody</maintainer>'
                   '<license>Apache-2.0</license>'
                   '<export><build_type>ament_python</build_type></export></package>\n',
    'setup.py': "from setuptools import setup\nsetup(name='rob_tools', version='1.0.0',\n"
                "      packages=['rob_tools'], data_files=[\n"
                "          ('share/ament_index/resource_index/packages',\n"
                "           ['resource/rob_tools']),\n"
                "          ('share/rob_tools', ['package.xml', 'speed.yaml'])],\n"
                "      entry_points={'console_scripts': ['params = rob_tools.params:main']})\n",
    'setup.cfg': '[develop]\nscript_dir=$base/lib/rob_tools\n[install]\n'
                 'install_scripts=$base/lib/rob_tools\n',
    'speed.yaml': '/**: {ros__parameters: {speed: 42}}\n',
    'resource/rob_tools': '', 'rob_tools/__init__.py': '',
    'rob_tools/params.py': """
import rclpy


def main():
    rclpy.init()
    node = rclpy.create_node('params')
    print('speed is', node.declare_parameter('speed', 0).value, flush=True)
    node.destroy_node()
    rclpy.try_shutdown()
""",
}


@pytest.mark.skipif(COLCON is None, reason='colcon is not installed')
def test_an_unsourced_workspace_of_linked_packages_runs(computer, launch, tmp_path):
    """It was built by a Python that the machine lacks, out of a folder outside the workspace."""
    outside, root = tmp_path / 'elsewhere' / 'rob_tools', tmp_path / 'ws'
    for name, text in ROB_TOOLS.items():
        path = outside / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (root / 'src').mkdir(parents=True)
    (root / 'src' / 'rob_tools').symlink_to(outside)
    built = subprocess.run(
        [sys.executable, COLCON, 'build', '--symlink-install'], cwd=root, capture_output=True,
        text=True, timeout=200, env={**os.environ, 'PYTHONWARNINGS': 'ignore'})
    assert built.returncode == 0, built.stdout + built.stderr
    program = root / 'install' / 'rob_tools' / 'lib' / 'rob_tools' / 'params'
    if embedded():
        assert program.read_text().startswith(f'#!{sys.executable}')
        assert computer.run(f'ls {sys.executable}', check=False).returncode != 0
    path = tmp_path / 'params.launch.py'
    path.write_text(textwrap.dedent(f"""
        from fogros2 import FogROSLaunchDescription, Node, SSHInstance
        from launch_ros.substitutions import FindPackageShare


        def generate_launch_description():
            machine = SSHInstance(
                '{computer.address}', '{computer.user}', key='{computer.key}',
                host_key='{computer.host_key}', name='params-{RUN}', ros_workspace='{root}')
            return FogROSLaunchDescription([Node(
                machine=machine, package='rob_tools', executable='params', output='screen',
                parameters=[[FindPackageShare('rob_tools'), '/speed.yaml']])])
        """))
    run = launch(str(path))
    assert run.ended() == 0, run.text
    assert 'speed is 42' in run.text
    assert 'WARNING' not in run.text and run.errors == [], run.text


KEPT = """
from fogros2 import CloudNode, FogROSLaunchDescription, SSHInstance


def generate_launch_description():
    machine = SSHInstance(
        '{host.address}', '{host.user}', key='{host.key}', host_key='{host.host_key}',
        name='{host.name}', ros_workspace='', bootstrap='pip', on_exit='keep')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='listener',
                  output='screen', remappings=[('chatter', '/near')])])
"""


@pytest.mark.skipif(not embedded(), reason='this robot has no wheels of ROS 2 to send')
def test_guest_gets_what_its_nodes_need(
        computer, launch, cloud_network, engine, second, join, tmp_path):
    path = tmp_path / 'kept.launch.py'
    path.write_text(KEPT.format(host=computer))
    launched = launch(str(path))
    launched.wait_for('process started')
    gateway = second.reaches(engine, cloud_network)
    computer.run(f'ip route replace {second.nat_address} via {gateway}')
    key = second.run('ros2', 'fog', 'key').strip()
    done = ros2('fog', 'invite', computer.name, '--key', key)
    assert done.returncode == 0, done.stderr
    joined = join(done.stdout.strip())
    joined.wait_for('I heard', timeout=300.0)
    launched.interrupt()
    assert launched.ended() == 0, launched.text
    joined.wait_for('I heard', times=joined.text.count('I heard') + 5)
    joined.interrupt()
    assert joined.ended() == 0, joined.text
    assert 'talker' not in ' '.join(computer.leftovers())
    assert ros2('fog', 'revoke', computer.name).returncode == 0
    wait_until(lambda: not computer.run(
        'ls -d /sys/class/net/fog* /run/fog* /var/lib/fogros2-guests || :').stdout,
        timeout=60.0, what='the guest and the VPN to be gone')
    assert computer.run('grep -c ^fog.*g2 /etc/passwd || :').stdout == '0\n'
    deleted = ros2('fog', 'delete', '--yes', computer.name)
    assert deleted.returncode == 0, deleted.stderr

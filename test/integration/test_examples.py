# SPDX-License-Identifier: Apache-2.0
"""The example launch files, and one launch with most of what a launch file can ask for."""

from __future__ import annotations

import os
from pathlib import Path
import re
import shutil
import subprocess
import uuid

from ament_index_python.packages import get_package_share_directory
import pytest
from ros2cli.cli import main

from rigs.colcon_workspace import colcon_workspace

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

#: Other runs of these tests may be under way on the same computer.
RUN = uuid.uuid4().hex[:6]


def example(name):
    return Path(get_package_share_directory('fogros2_examples'), 'launch', name)


def clean(launch):
    """Return whether it said nothing that would worry anybody."""
    return launch.errors == [] and 'WARNING' not in launch.text and 'Traceback' not in launch.text


def test_three_hosts_exchange_messages(launch, cloud_network):
    run = launch('fogros2_examples', 'two_clouds.launch.xml', f'name:=speaker-{RUN}',
                 f'second_name:=hearer-{RUN}', f'network:={cloud_network}')
    said = f'I heard: [Hello World from speaker-{RUN} '
    run.wait_for(f'[listener]: {said}')
    run.wait_for(f'[robot_listener]: {said}')
    assert clean(run), run.text
    run.interrupt()
    assert run.ended() == 0, run.text
    assert run.errors == [], run.text


@pytest.mark.parametrize('option', ['-s', '-p'])
def test_showing_a_launch_file_creates_nothing(option, state_home, capsys):
    for name in (
            'talker.auto_aws.launch.py', 'talker.aws.launch.py', 'talker.budget.launch.py',
            'talker.container.launch.py', 'talker.container.launch.xml', 'talker.kube.launch.py',
            'talker.recorded.launch.py', 'talker.regions.aws.launch.py', 'talker.ssh.launch.py',
            'talker.volume.launch.py', 'two_clouds.launch.py', 'two_clouds.launch.yaml',
            'video.container.launch.yaml'):
        assert not main(argv=['launch', str(example(name)), option]), name
        shown = capsys.readouterr().out
        assert option == '-p' or "'name':" in shown, name
    assert list(state_home.iterdir()) == []


#: A managed node that prints the transitions that it makes.
MANAGED = """
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn


class Managed(LifecycleNode):
    def on_configure(self, state):
        print('managed: configured', flush=True)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state):
        print('managed: activated', flush=True)
        return super().on_activate(state)


rclpy.init()
node = Managed('managed')
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
"""

#: A process that fails as soon as it has run, the third time for good.
FAILING = """
import os
import sys

count = len(open('/tmp/runs').read()) if os.path.exists('/tmp/runs') else 0
open('/tmp/runs', 'a').write('x')
print(f'failing: run {count}', flush=True)
sys.exit(7 if count < 2 else 0)
"""

LAUNCH = """
from fogros2 import CloudGroup, CloudNode, ContainerInstance, FogROSLaunchDescription
from launch.actions import EmitEvent, LogInfo, RegisterEventHandler
from launch.event_handlers import OnProcessExit, OnProcessIO
from launch_ros.actions import LifecycleNode, Node, PushROSNamespace
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch.events import matches_action
from lifecycle_msgs.msg import Transition


def generate_launch_description():
    machine = ContainerInstance(name={name!r}, network={network!r}, ros_workspace={workspace!r})
    hearer = CloudNode(
        machine=machine, package='fogros2_examples', executable='listener', name='once',
        parameters=[{{'count': 1}}])
    second = CloudNode(
        machine=machine, package='fogros2_examples', executable='listener', name='second',
        parameters=[{{'count': 1}}])
    managed = LifecycleNode(
        package={package!r}, executable='managed', name='managed', namespace='', output='screen')

    def transition(number):
        return EmitEvent(event=ChangeState(
            lifecycle_node_matcher=matches_action(managed), transition_id=number))

    def ended(event, context):
        return LogInfo(msg=f'once ended with {{event.returncode}} as {{event.process_name}}')

    def respawned(event):
        if b'run 2' in event.text:
            return LogInfo(msg='respawned twice')

    failing = Node(package={package!r}, executable='failing', respawn=True, respawn_delay=0.1,
                   respawn_max_retries=2, output='screen')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker'),
        hearer,
        CloudGroup(machine=machine, actions=[managed, failing]),
        RegisterEventHandler(OnProcessExit(target_action=hearer, on_exit=ended)),
        RegisterEventHandler(OnProcessExit(target_action=hearer, on_exit=[second])),
        RegisterEventHandler(OnProcessExit(
            target_action=second, on_exit=[LogInfo(msg='second ended')])),
        RegisterEventHandler(OnProcessIO(target_action=failing, on_stdout=respawned)),
        RegisterEventHandler(OnProcessExit(
            target_action=hearer, on_exit=[transition(Transition.TRANSITION_CONFIGURE)])),
        RegisterEventHandler(OnStateTransition(
            target_lifecycle_node=managed, goal_state='inactive',
            entities=[transition(Transition.TRANSITION_ACTIVATE)])),
        RegisterEventHandler(OnStateTransition(
            target_lifecycle_node=managed, goal_state='active',
            entities=[LogInfo(msg='managed is active')])),
    ])
"""


def test_two_full_launches_run_side_by_side(launch, cloud_network, tmp_path):
    package, name = f'fogt_{RUN}', f'all-{RUN}'
    root = tmp_path / 'workspace'
    variables = {**os.environ, **colcon_workspace(
        root, package, programs={'managed': MANAGED, 'failing': FAILING})}
    path = tmp_path / 'all.launch.py'
    path.write_text(LAUNCH.format(
        name=name, network=cloud_network, workspace=str(root), package=package))
    run = launch(str(path), environment=variables)
    run.wait_for('once ended with 0 as listener-')
    run.wait_for('second ended')
    run.wait_for('respawned twice')
    run.wait_for(f'[{name}.failing-', times=3)
    run.wait_for('managed: configured')
    run.wait_for('managed is active')
    assert len([line for line in run.errors if 'exit code 7' in line]) == 2, run.text

    # another launch on the same robot comes, is heard, and goes
    other = launch('fogros2_examples', 'talker.container.launch.py',
                   f'name:=other-{RUN}', 'count:=2')
    assert other.ended() == 0, other.text
    assert other.text.count(f'I heard: [Hello World from other-{RUN} ') >= 2
    assert len(re.findall(rf'other-{RUN}: agent +[0-9.]+ s', other.text)) == 1
    assert clean(other), other.text
    assert run.child.poll() is None and len(run.errors) == 2, run.text

    # another terminal joins
    heard = subprocess.run(
        ['sh', '-ec', f'eval "$(ros2 fog env {name})"; '
         # a daemon would stay
         'exec ros2 topic echo --no-daemon --once /chatter std_msgs/msg/String'],
        text=True, capture_output=True, timeout=60, stdin=subprocess.DEVNULL)
    assert heard.returncode == 0, heard.stderr
    assert f'data: Hello World from {name} ' in heard.stdout.replace("'", '')

    run.interrupt()
    assert run.ended() == 0, run.text
    assert len(run.errors) == 2 and 'Traceback' not in run.text, run.text

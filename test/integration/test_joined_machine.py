# SPDX-License-Identifier: Apache-2.0
"""A launch of a second robot runs nodes on the first robot's machine, by an invitation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
import signal
import uuid

import pytest

from fogros2.host import wheels
from fogros2.model import Command
from fogros2.process import run
from fogros2.provider.container.entry import AGENT_DIRECTORY
from fogros2.waiting import wait_until
from rigs.bare_computer import bare_computer
from rigs.launched import Launched, launching, ros2
from rigs.second_robot import second, SecondRobot

__all__ = ['second']

#: The key of a third computer.
OTHER = 'nLDHqcSHfnzLjlrO6PdzdSUWfvrWqPqRUQgyn6lKsjw='
FIRST = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    machine = ContainerInstance(
        name='{name}', network='{network}', ros_workspace='', on_exit='{on_exit}')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='listener',
                  output='screen', remappings=[('chatter', '/near')])])
"""
SECOND = """
from launch_ros.actions import Node

from fogros2 import CloudNode, FogROSLaunchDescription, JoinedMachine


def generate_launch_description():
    machine = JoinedMachine('{text}', name='theirs', ros_workspace='{workspace}',
                            robot_timeout=10)
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen', remappings=[('chatter', '/near')]),
        *[CloudNode(machine=machine, package='own', executable='where', output='screen')]
        * bool('{workspace}'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             remappings=[('chatter', '/near')])])
"""


class First:
    """The first robot's launch, and its machine."""

    def __init__(self, name: str, launched: Launched, engine: str) -> None:
        self.name = name
        self.launched = launched
        self.engine = engine

    def there(self, script: str) -> str:
        """Return what a shell of root on the machine prints."""
        return run(Command((self.engine, 'exec', f'fogros2-{self.name}', 'sh', '-c', script),
                           sudo=True), timeout=30.0, check=False).stdout

    def accounts(self) -> list[str]:
        """Return the accounts of guests on the machine, and their processes."""
        return self.there('grep "^fog.*g2" /etc/passwd; ls /var/lib/fogros2-guests; '
                          'for p in /proc/[0-9]*; do stat -c %U $p; done | grep "^fog.*g2"'
                          ).split()

    def talkers(self) -> int:
        return self.there('cat /proc/[0-9]*/cmdline | tr "\\0" " "').count('/talker ')

    def invited(self, second: SecondRobot, *options: str) -> str:
        key = second.run('ros2', 'fog', 'key').strip()
        done = ros2('fog', 'invite', self.name, '--key', key, '--address', second.host, *options)
        assert done.returncode == 0, done.stdout + done.stderr
        return str(done.stdout).strip()


@pytest.fixture
def first(
    tmp_path: Path, cloud_network: str, engine: str, nothing_left: None, second: SecondRobot,
) -> Iterator[Callable[[str], First]]:
    name = f'host-{uuid.uuid4().hex[:6]}'
    with launching() as start:
        def launch(on_exit: str) -> First:
            path = tmp_path / 'first.launch.py'
            path.write_text(FIRST.format(name=name, network=cloud_network, on_exit=on_exit))
            started = start(str(path))
            started.wait_for('process started')
            second.reaches(engine, cloud_network)
            return First(name, started, engine)
        yield launch
    ros2('fog', 'delete', '--yes', name)


@pytest.fixture
def join(
    second: SecondRobot, tmp_path: Path,
) -> Iterator[Callable[..., Launched]]:
    with launching() as start:
        def launch(text: str, workspace: str = '') -> Launched:
            path = tmp_path / 'second.launch.py'
            path.write_text(SECOND.format(text=text, workspace=workspace))
            return start(str(path), environment=second.environment,
                         prefix=('ip', 'netns', 'exec', second.spaces[1]))
        yield launch


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """Return the prefix of a package whose program prints where it is."""
    prefix = tmp_path / 'own ws' / 'install' / 'own'
    for name, text in {
            'share/ament_index/resource_index/packages/own': '',
            'share/own/package.xml': '<package><name>own</name></package>',
            'lib/own/where': '#!/usr/bin/python3\nprint(__file__)\n',
            '../local_setup.sh': f'export AMENT_PREFIX_PATH="{prefix}:$AMENT_PREFIX_PATH"\n',
    }.items():
        (prefix / name).parent.mkdir(parents=True, exist_ok=True)
        (prefix / name).write_text(text)
    (prefix / 'lib/own/where').chmod(0o755)
    return prefix


def test_nodes_of_a_second_robot_end_with_its_heartbeat(
    first: Callable[[str], First], second: SecondRobot, join: Callable[..., Launched],
    workspace: Path,
) -> None:
    host = first('delete')
    text = host.invited(second)
    joined = join(text, str(workspace.parents[1]))
    joined.wait_for(f'/ws{workspace}/lib/own/where')
    assert any('/var/lib/fogros2-guests/fog' in line for line in joined.said), joined.text
    joined.wait_for('I heard')
    assert host.talkers() == 1
    host.launched.wait_for('I heard')  # the first robot's node there hears the second's too
    (account,) = {name for name in host.accounts() if ':' not in name}
    for script in ('cat /{0}/config.json', 'sudo -n true', 'kill -0 1', 'ls /home/*',
                   'cat /run/fog*.more.json', 'touch /var/lib/fogros2-guests/x'):
        said = host.there(f"su -s /bin/sh -c '{script.format(AGENT_DIRECTORY)}' {account} "
                          '2>/dev/null && echo may')
        assert 'may' not in said, (script, said)
    assert 'may' in host.there(f"su -s /bin/sh -c 'touch ~/x' {account} && echo may")
    joined.interrupt()
    assert joined.ended() == 0, joined.text
    assert host.talkers() == 0
    again = join(text)
    again.wait_for('I heard')
    again.child.send_signal(signal.SIGKILL)
    wait_until(lambda: host.talkers() == 0, timeout=60.0, what='the end of the nodes')
    assert host.accounts()
    assert ros2('fog', 'revoke', host.name).returncode == 0
    assert host.accounts() == []
    again.kill()
    second.run('ros2', 'fog', 'gc')
    assert second.run('ip', '-brief', 'link').count('fog') == 0


def test_nodes_go_on_when_the_inviting_launch_keeps_its_machine(
    first: Callable[[str], First], second: SecondRobot, join: Callable[..., Launched],
) -> None:
    host = first('keep')
    joined = join(host.invited(second))
    joined.wait_for('I heard')
    host.launched.interrupt()
    assert host.launched.ended() == 0, host.launched.text
    heard = joined.text.count('I heard')
    joined.wait_for('I heard', times=heard + 5)
    assert host.talkers() == 1 and host.there('ls /sys/class/net').count('fog') == 1
    joined.interrupt()
    assert joined.ended() == 0, joined.text
    assert ros2('fog', 'revoke', host.name).returncode == 0
    wait_until(lambda: not host.there('ls /sys/class/net /run | grep ^fog.*m0'), timeout=60.0,
               what='the door to take the VPN down')
    assert host.accounts() == []
    deleted = ros2('fog', 'delete', '--yes', host.name)
    assert deleted.returncode == 0, deleted.stdout + deleted.stderr


def test_next_launch_takes_its_machine_from_the_guests(
    first: Callable[[str], First], second: SecondRobot, join: Callable[..., Launched],
) -> None:
    host = first('keep')
    joined = join(host.invited(second))
    joined.wait_for('I heard')
    host.launched.interrupt()
    assert host.launched.ended() == 0, host.launched.text
    again = first('delete')
    assert again.accounts() == [] and again.talkers() == 0
    assert again.there('ls /sys/class/net').count('fog') == 1


def test_invitation_that_is_not_valid_any_more_gets_no_answer(
    first: Callable[[str], First], second: SecondRobot, join: Callable[..., Launched],
) -> None:
    host = first('delete')
    old = host.invited(second)
    new = host.invited(second)
    replayed = join(old)
    assert replayed.ended() == 1
    assert "'theirs' refuses this invitation" in replayed.text, replayed.text
    assert host.accounts() == []
    assert ros2('fog', 'revoke', host.name).returncode == 0
    revoked = join(new)
    assert revoked.ended() == 1
    assert "'theirs' does not answer" in revoked.text, revoked.text
    foreign = ros2('fog', 'invite', host.name, '--key', OTHER, '--address',
                   second.host).stdout.strip()
    stranger = join(foreign)
    assert stranger.ended() == 1
    assert 'this invitation is for another computer' in stranger.text, stranger.text
    assert 'theirs: machine' not in stranger.text and host.accounts() == []


SSH = """
from fogros2 import CloudNode, FogROSLaunchDescription, SSHInstance


def generate_launch_description():
    machine = SSHInstance(
        '{host.address}', '{host.user}', key='{host.key}', host_key='{host.host_key}',
        name='{host.name}', ros_workspace='', bootstrap='pip', on_exit='keep')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='listener',
                  output='screen', remappings=[('chatter', '/near')])])
"""


def test_guest_of_an_ssh_host_gets_what_its_nodes_need(
    second: SecondRobot, join: Callable[..., Launched], tmp_path: Path, cloud_network: str,
    engine: str, nothing_left: None,
) -> None:
    if not wheels.collect(tmp_path / 'wheels').ros:
        pytest.skip('this robot has an installation of ROS 2 and no wheels to send')
    name = f'ssh-{uuid.uuid4().hex[:6]}'
    path = tmp_path / 'ssh.launch.py'
    with bare_computer(name, tmp_path / 'computer', cloud_network) as computer, \
            launching() as start:
        path.write_text(SSH.format(host=computer))
        launched = start(str(path))
        launched.wait_for('process started', timeout=300.0)
        gateway = second.reaches(engine, cloud_network)
        computer.run(f'ip route add {second.nat_address} via {gateway}')
        key = second.run('ros2', 'fog', 'key').strip()
        done = ros2('fog', 'invite', name, '--key', key)
        assert done.returncode == 0, done.stderr
        joined = join(done.stdout.strip())
        joined.wait_for('I heard', timeout=300.0)
        launched.interrupt()
        assert launched.ended() == 0, launched.text
        joined.wait_for('I heard', times=joined.text.count('I heard') + 5)
        joined.interrupt()
        assert joined.ended() == 0, joined.text
        assert ros2('fog', 'revoke', name).returncode == 0
        wait_until(lambda: not computer.run(
            'ls -d /sys/class/net/fog* /run/fog* /var/lib/fogros2-guests || :').stdout,
            timeout=60.0, what='the guest and the VPN to be gone')
        assert computer.run('grep -c ^fog.*g2 /etc/passwd || :').stdout == '0\n'
        deleted = ros2('fog', 'delete', '--yes', name)
        assert deleted.returncode == 0, deleted.stderr

# SPDX-License-Identifier: Apache-2.0
"""A second robot joins the machine of a launch by an invitation, with terminals and with nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
import signal
import uuid

import pytest

from fogros2.model import Command
from fogros2.process import run
from fogros2.provider.container.entry import AGENT_DIRECTORY
from fogros2.waiting import wait_until
from rigs.launched import Launched, launching, ros2
from rigs.second_robot import join, second, SecondRobot

__all__ = ['join', 'second']

FIRST = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    machine = ContainerInstance(
        name='{name}', network='{network}', ros_workspace='', on_exit='{on_exit}')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  remappings=[('chatter', '/far')]),
        CloudNode(machine=machine, package='fogros2_examples', executable='listener',
                  output='screen', remappings=[('chatter', '/near')])])
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
        """Return how many nodes of guests run on the machine."""
        return sum('/talker ' in line and '/near' in line for line in self.there(
            'for p in /proc/[0-9]*; do tr "\\0" " " <$p/cmdline; echo; done').splitlines())

    def fog(self, verb: str, *words: str, status: int = 0) -> str:
        """Run a verb for the machine; return its output, or its errors if it has to fail."""
        done = ros2('fog', verb, self.name, *words)
        assert done.returncode == status, done.stdout + done.stderr
        return str(done.stderr if status else done.stdout).strip()

    def invited(self, second: SecondRobot, *options: str) -> str:
        key = second.run('ros2', 'fog', 'key').strip()
        return self.fog('invite', '--key', key, '--address', second.host, *options)


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


def terminals_hear_and_are_heard(host: First, second: SecondRobot) -> None:
    """Join with the terminals of the second robot, and leave."""
    old = host.invited(second, '--for', '1s')
    wait_until(lambda: 'GUEST' not in host.fog('status'), timeout=60, what='the expiry')
    assert 'has expired' in second.run('ros2', 'fog', 'join', old, status=1)
    text = host.invited(second)
    own = ('198.18.0.9/15', 'dev', 'lo')
    second.ip('-n', second.spaces[1], 'address', 'add', *own)
    said = second.run('ros2', 'fog', 'join', text, status=1)
    assert 'this computer uses 198.18.0.0/15' in said and 'FOGROS2_VPN_POOL' in said
    second.ip('-n', second.spaces[1], 'address', 'delete', *own)
    second.run('sh', '-ec', f'eval "$(ros2 fog join {text})"; ros2 topic echo --once '
               '/far std_msgs/msg/String')
    speaker = second.start('sh', '-ec', f'eval "$(ros2 fog env {host.name})"; exec ros2 topic pub '
                           "/near std_msgs/msg/String '{data: from the second}'")
    try:
        host.launched.wait_for('from the second')
    finally:
        speaker.terminate()
        speaker.communicate()
    assert 'GUEST' in host.fog('status')
    assert 'round trip' in second.run('ros2', 'fog', 'status', host.name)
    second.run('ros2', 'fog', 'join', text)  # once more changes nothing
    assert second.run('ros2', 'fog', 'leave', host.name) == f'left {host.name}\n'
    assert 'has not joined' in second.run('ros2', 'fog', 'leave', host.name, status=1)
    assert 'no guest robot9' in host.fog('revoke', 'robot9', status=1)
    assert host.fog('revoke').startswith('revoked ')
    wait_until(lambda: 'GUEST' not in host.fog('status'), timeout=60, what='the guest to be gone')


def test_guest_uses_a_machine_until_it_is_gone_or_revoked(
    first: Callable[[str], First], second: SecondRobot, join: Callable[..., Launched],
    workspace: Path,
) -> None:
    host = first('keep')
    terminals_hear_and_are_heard(host, second)
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
    joined.child.send_signal(signal.SIGKILL)
    wait_until(lambda: host.talkers() == 0, timeout=60.0, what='the end of the nodes')
    assert host.accounts()
    host.fog('revoke')
    assert host.accounts() == []
    joined.kill()
    second.run('ros2', 'fog', 'gc')
    assert second.run('ip', '-brief', 'link').count('fog') == 0
    revoked = join(text)
    assert revoked.ended() == 1
    assert "'theirs' does not answer" in revoked.text, revoked.text
    assert host.accounts() == []
    guest_stays_until_the_next_launch(host, first, join(host.invited(second)))


def guest_stays_until_the_next_launch(
    host: First, first: Callable[[str], First], joined: Launched,
) -> None:
    """End the first robot's launch, which keeps its machine; then launch there again."""
    joined.wait_for('I heard')
    host.launched.interrupt()
    assert host.launched.ended() == 0, host.launched.text
    heard = joined.text.count('I heard')
    joined.wait_for('I heard', times=heard + 5)
    assert host.talkers() == 1 and host.there('ls /sys/class/net').count('fog') == 1
    # the next launch takes its machine from the guests
    again = first('delete')
    assert again.accounts() == [] and again.talkers() == 0
    assert again.there('ls /sys/class/net').count('fog') == 1

# SPDX-License-Identifier: Apache-2.0
"""Others than the robot watch an EC2 instance: its security group lets them in, and no more."""

from __future__ import annotations

import subprocess
import sys

import pytest

from fogros2.waiting import wait_until

pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')
CLOUDS = ('aws',)
LAUNCH_FILE = """
from fogros2 import AWSCloudInstance, CloudNode, FogROSLaunchDescription


def generate_launch_description():
    machine = AWSCloudInstance(
        name={name!r}, ec2_instance_type='t3.medium', ros_workspace='', on_exit='keep',
        monitor_allow=['198.51.100.2'])
    return FogROSLaunchDescription([CloudNode(
        machine=machine, package='fogros2_examples', executable='talker', name='talker')])
"""
KNOCK = """
import socket, ssl, sys
context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
try:
    plain = socket.create_connection((sys.argv[1], 8766), timeout=float(sys.argv[3]))
except TimeoutError:
    sys.exit('nothing answers')
with context.wrap_socket(plain) as link:
    link.sendall(f'GET {sys.argv[2]} HTTP/1.1\\r\\nHost: x\\r\\n\\r\\n'.encode())
    print(link.recv(4096).split()[1].decode())
"""


def knock(box, at, target, timeout=15.0):
    done = subprocess.run(
        [*box.on_robot([]), sys.executable, '-c', KNOCK, at, target, str(timeout)],
        capture_output=True, text=True, timeout=60)
    return (done.stdout or done.stderr).strip()


def open_ports(robot):
    (group,) = [group for group in robot.api().describe_security_groups()['SecurityGroups']
                if group['GroupName'] != 'default']
    return [(rule['FromPort'], [source['CidrIp'] for source in rule['IpRanges']])
            for rule in group['IpPermissions'] if rule['IpProtocol'] == 'tcp']


@pytest.mark.soak  # the contract and the launches on containers open ports
def test_security_group_admits_viewers_until_the_launch_ends(robot, box, name):
    run = robot.launch(robot.write('monitor.launch.py', LAUNCH_FILE.format(name=name)))
    run.wait_for('the certificate has the SHA-256')
    run.wait_for(f'with its token: ros2 fog monitor {name} --share')
    wait_until(lambda: open_ports(robot) == [(8766, ['198.51.100.2/32'])] or None, timeout=60,
               what='the SSH port to be closed')
    (instance,) = box.alive()
    shared = robot.ros2('fog', 'monitor', name, '--share').stdout.splitlines()[0]
    at, _, token = shared.removeprefix('wss://').partition(':8766')
    wait_until(lambda: knock(box, at, '/') == '401' or None, timeout=60, what='the gate')
    assert knock(box, at, token) == '200'
    # from elsewhere nothing even answers
    box.move_robot()
    try:
        assert knock(box, at, token, timeout=1.0) == 'nothing answers'
    finally:
        box.move_robot(back=True)
    run.interrupt()
    assert run.ended() == 0, run.text
    assert box.alive()[0].id == instance.id
    assert open_ports(robot) == []
    assert robot.ros2('fog', 'delete', name, '--yes').returncode == 0

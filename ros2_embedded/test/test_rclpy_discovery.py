# SPDX-License-Identifier: Apache-2.0
"""Two processes find each other without any configuration."""

import os
import shutil
import subprocess
import sys

import pytest

TALKER = '''
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node('talker')
publisher = node.create_publisher(String, 'chatter', 10)
while publisher.get_subscription_count() == 0:
    rclpy.spin_once(node, timeout_sec=0.05)
publisher.publish(String(data='found'))
publisher.wait_for_all_acked()
'''
LISTENER = '''
import rclpy
from rclpy.task import Future
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node('listener')
found = Future()
node.create_subscription(String, 'chatter', found.set_result, 10)
rclpy.spin_until_future_complete(node, found, timeout_sec=15)
print(found.result().data if found.done() else 'nothing', flush=True)
'''
NETWORKS = {
    'loopback': 'ip link set lo up',
    'loopback and a link': 'ip link set lo up; ip link add one type veth peer name two; '
                           'ip addr add 198.51.100.2/24 dev one; ip link set one up; '
                           'ip link set two up'}


def namespaces():
    return shutil.which('unshare') and shutil.which('ip') and subprocess.run(
        ['unshare', '--net', 'true'], stderr=subprocess.DEVNULL).returncode == 0


@pytest.mark.skipif(not namespaces(), reason='no right to make a network of its own')
@pytest.mark.parametrize('scope', ['SUBNET', 'LOCALHOST', 'LOCALHOST 127.0.0.2'])
@pytest.mark.parametrize('network', NETWORKS)
def test_nodes_discover_each_other_without_configuration(network, scope):
    scope, _, peers = scope.partition(' ')
    environment = {name: value for name, value in os.environ.items()
                   if name not in ('CYCLONEDDS_URI', 'ROS_DOMAIN_ID')}
    environment.update(ROS_AUTOMATIC_DISCOVERY_RANGE=scope, ROS_STATIC_PEERS=peers)
    script = f'{NETWORKS[network]}; "$0" -c "$1" & "$0" -c "$2"; kill $! 2>/dev/null; wait'
    done = subprocess.run(
        ['unshare', '--net', 'sh', '-c', script, sys.executable, TALKER, LISTENER],
        env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout == 'found\n', done.stderr


# the other computer's name in the environment of one of the two is enough
TWO_COMPUTERS = '''
ip link set lo up
unshare --net sh -c 'ip link set lo up; read -r _ < "$2"; ip addr add 198.51.100.3/24 dev two
                     ip link set two up; ROS_STATIC_PEERS=198.51.100.2 exec "$0" -c "$1"' \
    "$0" "$1" "$3" &
ip link add one type veth peer name two
ip addr add 198.51.100.2/24 dev one; ip link set one up
until [ "$(readlink /proc/$!/ns/net)" != "$(readlink /proc/self/ns/net)" ]; do sleep 0.05; done
ip link set two netns $!
echo > "$3"
"$0" -c "$2"
kill $! 2>/dev/null; wait
'''


@pytest.mark.skipif(not namespaces(), reason='no right to make a network of its own')
def test_static_peer_on_one_computer_is_enough(tmp_path):
    environment = {name: value for name, value in os.environ.items()
                   if name not in ('CYCLONEDDS_URI', 'ROS_DOMAIN_ID', 'ROS_STATIC_PEERS')}
    environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.mkfifo(tmp_path / 'go')
    done = subprocess.run(
        ['unshare', '--net', 'sh', '-c', TWO_COMPUTERS, sys.executable, TALKER, LISTENER,
         str(tmp_path / 'go')], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout == 'found\n', done.stderr

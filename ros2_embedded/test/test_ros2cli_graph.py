# SPDX-License-Identifier: Apache-2.0
"""``ros2 topic|node|service|param`` beside a node that runs."""

import importlib.util
import os
import signal
import subprocess
import sys

import pytest

ours = pytest.mark.skipif(
    not importlib.util.find_spec('embedded_default'), reason='is ROS 2 itself')

NODE = '''
import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import String
from std_srvs.srv import SetBool
rclpy.init()
node = rclpy.create_node('worker', namespace='/cell')
node.declare_parameter('speed', 1.5, ParameterDescriptor(description='how fast'))
node.declare_parameter('arm.joints', 6)
publisher = node.create_publisher(String, 'chatter', 10)
node.create_timer(0.05, lambda: publisher.publish(String(data='hello')))
node.create_subscription(String, 'orders', lambda message: print(message.data, flush=True), 10)
def switch(request, response):
    response.success = request.data
    return response
node.create_service(SetBool, 'switch', switch)
actions = [node.create_publisher(String, 'count/_action/feedback', 10),
           node.create_subscription(String, 'walk/_action/feedback', lambda _: None, 10)]
print('ready', flush=True)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
'''


@pytest.fixture(scope='module')
def worker():
    with subprocess.Popen([sys.executable, '-c', NODE], stdout=subprocess.PIPE,
                          text=True) as process:
        assert process.stdout.readline() == 'ready\n'
        yield process
        process.terminate()


def no_daemon(command):
    """Return a command that starts no daemon, which would outlive the test."""
    daemons = ('list', 'info', 'get', 'set', 'echo')
    return [*command[:2], *['--no-daemon'] * (command[1] in daemons), *command[2:]]


@pytest.fixture(scope='module')
def ros2(commands):
    """Return what runs a command of ros2 and returns its output."""
    with commands() as answer:
        def run(*command, status=0, shows=''):
            for _ in range(5):  # a busy computer may discover nothing within the command's time
                code, output = answer(*no_daemon(command))
                if code == status and shows in output:
                    return output
            raise AssertionError(output)

        yield run


def stopped(*command, until, by=signal.SIGINT):
    """Run a command as a process and send it a signal once it has said something."""
    process = subprocess.Popen(
        ['ros2', *no_daemon(command)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, env={**os.environ, 'PYTHONUNBUFFERED': '1'},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
    output = ''
    try:
        while until not in output:
            line = process.stdout.readline()
            assert line, output
            output += line
        process.send_signal(by)
        return output + process.communicate(timeout=60)[0]
    finally:
        process.kill()
        process.wait()


def test_topic_list_and_info_show_topics(worker, ros2):
    listed = ros2('topic', 'list', '-t', shows='/cell/chatter').splitlines()
    assert '/cell/chatter [std_msgs/msg/String]' in listed and '/rosout [' in str(listed)
    info = ros2('topic', 'info', '/cell/chatter', shows='Publisher count: 1')
    assert info == 'Type: std_msgs/msg/String\nPublisher count: 1\nSubscription count: 0\n'
    verbose = ros2('topic', 'info', '-v', '/cell/chatter', shows='Node name: worker')
    assert 'Node name: worker\nNode namespace: /cell\n' in verbose
    assert '  Reliability: RELIABLE\n' in verbose and 'RIHS01_df668c' in verbose
    assert "Unknown topic '/none'" in ros2('topic', 'info', '/none', status=1)


def test_topic_echo_prints_messages(worker, ros2):
    assert ros2('topic', 'echo', '--once', '--field', 'data', '/cell/chatter') == 'hello\n---\n'
    assert ros2('topic', 'echo', '--once', '/cell/chatter', 'std_msgs/msg/String') == \
        'data: hello\n---\n'
    short = ros2('topic', 'echo', '--once', '--no-str', '--qos-reliability', 'best_effort',
                 '/cell/chatter')
    assert short == "data: '<string length: <5>>'\n---\n"
    assert 'Could not determine the type' in ros2('topic', 'echo', '/none', status=1)
    assert 'message type is invalid' in ros2('topic', 'echo', '/x', 'no/such', status=1)


def test_topic_pub_publishes_and_ends(worker, ros2):
    done = ros2('topic', 'pub', '--once', '/cell/orders', 'std_msgs/msg/String', '{data: go}')
    assert "publishing #1: std_msgs.msg.String(data='go')" in done
    assert worker.stdout.readline() == 'go\n'
    done = ros2('topic', 'pub', '-r', '50', '-t', '3', '/cell/orders', 'std_msgs/msg/String',
                'data: more')
    assert done.count('publishing #') == 3 and 'publishing #3' in done
    assert [worker.stdout.readline() for _ in range(3)] == ['more\n'] * 3
    for values, text in (('{datum: 1}', 'Failed to populate field'),
                         ('3', 'needs to be a dictionary')):
        assert text in ros2('topic', 'pub', '--once', '-w', '0', '/x', 'std_msgs/msg/String',
                            values, status=1)


@ours
def test_first_message_reaches_the_awaited_subscription(ros2):
    reader = subprocess.Popen(
        ['ros2', 'topic', 'echo', '--once', '/first', 'std_msgs/msg/String'],
        stdout=subprocess.PIPE, text=True)
    ros2('topic', 'pub', '--once', '/first', 'std_msgs/msg/String', '{data: go}')
    try:
        assert reader.communicate(timeout=60)[0] == 'data: go\n---\n'
    finally:
        reader.kill()
        reader.wait()


def test_topic_pub_repeats_until_interrupted(worker):
    process = subprocess.Popen(
        ['ros2', 'topic', 'pub', '/cell/orders', 'std_msgs/msg/String', '{data: again}'],
        stdout=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
    try:
        assert [worker.stdout.readline() for _ in range(2)] == ['again\n'] * 2
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=120) == signal.SIGINT
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize('command', [
    ('topic', 'pub', '--once', '/nobody', 'std_msgs/msg/String'),
    ('service', 'call', '/nobody', 'std_srvs/srv/SetBool')])
def test_sigterm_ends_a_waiting_command(command):
    said = stopped(*command, until='aiting for ', by=signal.SIGTERM)
    assert 'publishing' not in said and 'response' not in said
    if importlib.util.find_spec('embedded_default'):
        assert len(said.splitlines()) == 1


def test_topic_hz_measures(worker):
    rate = stopped('topic', 'hz', '/cell/chatter', until='window: ')
    assert 15 < float(rate.split('average rate: ')[1].split()[0]) < 25


def test_node_list_and_info_show_nodes(worker, ros2):
    assert '/cell/worker' in ros2('node', 'list', shows='/cell/worker').splitlines()
    info = ros2('node', 'info', '/cell/worker', shows='/cell/walk: ').splitlines()
    assert info[0] == '/cell/worker'
    assert '    /cell/orders: std_msgs/msg/String' in info
    assert info.index('    /cell/switch: std_srvs/srv/SetBool') > \
        info.index('  Service Servers:')
    servers, clients = info.index('  Action Servers:'), info.index('  Action Clients:')
    assert info[servers + 1:clients] == ['    /cell/count: std_msgs/msg/String']
    assert info[clients + 1:] == ['    /cell/walk: std_msgs/msg/String']
    assert "Unable to find node '/none'" in ros2('node', 'info', '/none', status=1)


def test_service_list_and_call_work(worker, ros2):
    assert '/cell/switch [std_srvs/srv/SetBool]' in \
        ros2('service', 'list', '-t', shows='/cell/switch ').splitlines()
    called = ros2('service', 'call', '/cell/switch', 'std_srvs/srv/SetBool',
                  '{data: true}')
    assert 'requester: making request: std_srvs.srv.SetBool_Request(data=True)' in \
        called
    assert "response:\nstd_srvs.srv.SetBool_Response(success=True, message='')" in called
    assert 'service type is invalid' in ros2('service', 'call', '/x', 'no/such', status=1)


def test_param_verbs_list_get_and_set(worker, ros2):
    listed = ros2('param', 'list', '/cell/worker').splitlines()
    assert {'  arm.joints', '  speed', '  use_sim_time'} <= {*listed} and sorted(listed) == listed
    assert '/cell/worker:' in ros2('param', 'list', shows='/cell/worker:').splitlines()
    assert ros2('param', 'get', '/cell/worker', 'speed') == 'Double value is: 1.5\n'
    assert ros2('param', 'set', '/cell/worker', 'speed', '2.5') == 'Set parameter successful\n'
    assert ros2('param', 'get', '/cell/worker', 'speed') == 'Double value is: 2.5\n'
    assert 'Setting parameter failed: Wrong parameter type' in \
        ros2('param', 'set', '/cell/worker', 'speed', 'fast')
    assert 'Node not found' in ros2('param', 'get', '/none', 'speed', status=1)
    ros2('param', 'get', '/cell/worker', 'none', status=1, shows='Parameter not set')


class Graph:
    """A node that sees others at certain times of a clock of its own."""

    def __init__(self, *times):
        self.times, self.now = times, 0.0

    def spin_once(self, node, timeout_sec):
        self.now += timeout_sec

    def get_node_names_and_namespaces(self):
        return [(f'n{time}', '/') for time in self.times if time <= self.now]

    def get_topic_names_and_types(self):
        return []

    get_service_names_and_types = get_topic_names_and_types


@ours
@pytest.mark.parametrize('times, enough, end', [
    ((0.1,), None, 1.3), ((0.1, 1.2), None, 2.4), ((), None, 3), ((0.1, 1.2, 2.3), None, 3),
    ((0.5,), lambda node: node.get_node_names_and_namespaces(), 0.5), ((), lambda node: True, 0)])
def test_discovery_waits_for_answers_sent_again(monkeypatch, times, enough, end):
    import rclpy
    from ros2cli.node import direct
    graph = Graph(*times)
    monkeypatch.setattr(rclpy, 'spin_once', graph.spin_once)
    monkeypatch.setattr(direct.time, 'monotonic', lambda: graph.now)
    node = direct.DirectNode.__new__(direct.DirectNode)
    node.node = graph
    node._discover(None, enough)
    assert end <= graph.now < end + 0.2


BUFFERS = '''
import argparse, os, socket
from ros2cli.node.direct import DirectNode
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as new:
    default = new.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
with DirectNode(argparse.Namespace(spin_time=0)):
    for name in os.listdir('/proc/self/fd'):
        try:
            one = socket.socket(fileno=os.dup(int(name)))
        except OSError:
            continue
        with one:
            if one.type == socket.SOCK_DGRAM and one.family == socket.AF_INET:
                print(one.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) > default)
'''


@ours
def test_answers_of_many_nodes_fit_the_receive_buffer():
    environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}
    del environment['FASTRTPS_DEFAULT_PROFILES_FILE']
    done = subprocess.run([sys.executable, '-c', BUFFERS], env=environment, text=True,
                          capture_output=True, timeout=60)
    assert done.stdout.count('True') >= 2, done.stdout + done.stderr

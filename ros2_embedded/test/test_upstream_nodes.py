# SPDX-License-Identifier: Apache-2.0
"""
ROS 2's own demonstrations and examples of rclpy, unmodified.

ROS2_SOURCES names a folder that holds the repositories ``demos`` and ``examples`` of
github.com/ros2, branch jazzy. Nothing of theirs is here.
"""

from contextlib import contextmanager, ExitStack
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import threading

import pytest

SOURCES = Path(os.environ.get('ROS2_SOURCES', '/nowhere'))
DEMOS = 'demos/demo_nodes_py'
PUBLISHER, SUBSCRIBER, CLIENT, SERVICE = (
    f'examples/rclpy/{kind}/minimal_{name}' for kind, name in (
        ('topics', 'publisher'), ('topics', 'subscriber'), ('services', 'client'),
        ('services', 'service')))
TALKER = (PUBLISHER, 'examples_rclpy_minimal_publisher.publisher_member_function')
SERVER = (SERVICE, 'examples_rclpy_minimal_service.service')
EXECUTORS = 'examples/rclpy/executors'

pytestmark = pytest.mark.skipif(
    not (SOURCES / DEMOS).is_dir() or not (SOURCES / PUBLISHER).is_dir(),
    reason="the sources of ROS 2's demos and examples are not here (ROS2_SOURCES)")


BLACKBOARD = '''
import rclpy
rclpy.init()
rclpy.spin(rclpy.create_node('parameter_blackboard', allow_undeclared_parameters=True))
'''
SETTER = '''
import rclpy
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
rclpy.init()
node = rclpy.create_node('setter')
client = AsyncParameterClient(node, 'set_parameters_callback')
assert client.wait_for_services(15)
for call, argument in ((client.set_parameters_atomically, [Parameter('param1', value=9.0)]),
                       (client.get_parameters, ['param1', 'param2'])):
    future = call(argument)
    rclpy.spin_until_future_complete(node, future)
print([value.double_value for value in future.result().values], flush=True)
'''


def running(folder, module, *arguments):
    """Run a module's main() as its entry point would."""
    return running_code(f'import sys; from {module} import main; sys.exit(main())', *arguments,
                        PYTHONPATH=SOURCES / folder)


@contextmanager
def running_code(code, *arguments, **paths):
    """Run a program with some more in its path variables; give its process."""
    environment = {**os.environ, 'PYTHONUNBUFFERED': '1'}
    for name, path in paths.items():
        environment[name] = os.pathsep.join([str(path), os.environ.get(name, '')])
    process = subprocess.Popen([sys.executable, '-c', code, *arguments], env=environment,
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    watchdog = threading.Timer(30, process.kill)
    watchdog.start()
    try:
        yield process
    finally:
        watchdog.cancel()
        process.kill()
        process.communicate()


def shows(process, *expected):
    """Wait until a node has said all that is expected of it, in this order; return it."""
    said = ''
    for text in expected:
        while text not in said:
            line = process.stdout.readline()
            assert line, f'{text!r} is missing in:\n{said}'
            said += line
    assert 'Traceback' not in said
    return said


def ends(process):
    """Check that a node ends without a complaint."""
    rest = process.communicate(timeout=20)[0]
    assert process.returncode == 0 and 'Traceback' not in rest, rest


def demo(name):
    return DEMOS, f'demo_nodes_py.{name}'


# what runs beside it, a program, and what it says
ENDING = [
    ([demo('services.add_two_ints_server')], demo('services.add_two_ints_client'),
     ['Result of add_two_ints: 5']),
    ([demo('services.add_two_ints_server')], demo('services.add_two_ints_client_async'),
     ['Result of add_two_ints: 5']),
    ([], demo('events.matched_event_detect'), [
        'First subscription is connected.', 'Last subscription is disconnected.',
        'First publisher is connected.', 'Last publisher is disconnected.']),
    ([], demo('logging.use_logger_service'), [
        'Output 1 with INFO logger level.', 'Output 2 with DEBUG logger level.',
        'Output 3 with WARN logger level.', 'Output 4 with ERROR logger level.']),
    *(([SERVER], (CLIENT, f'examples_rclpy_minimal_client.{name}', '41', '1'), ['= 42'])
      for name in ('client', 'client_async', 'client_async_callback')),
    ([(SERVICE, 'examples_rclpy_minimal_service.service_member_function')],
     (CLIENT, 'examples_rclpy_minimal_client.client_async_member_function', '41', '1'),
     ['= 42']),
]
SPINNING = [
    ([demo('topics.talker')], demo('topics.listener'), ['I heard: [Hello World: ']),
    ([demo('topics.talker')], demo('topics.listener_serialized'), ['I heard: "b']),
    ([(*demo('topics.talker_qos'), '-n', '50', '--reliable')],
     (*demo('topics.listener_qos'), '-n', '2', '--reliable'), ['I heard: [Hello World: ']),
    ([], (*demo('services.introspection'), '--ros-args', '-p',
          'client_configure_introspection:=contents'), ['Result of add_two_ints: 5']),
    *(([TALKER], (SUBSCRIBER, f'examples_rclpy_minimal_subscriber.subscriber_{name}'),
       ['I heard: "Hello World: ']) for name in ('lambda', 'member_function', 'old_school')),
    *(([(PUBLISHER, f'examples_rclpy_minimal_publisher.publisher_{name}')],
       (SUBSCRIBER, 'examples_rclpy_minimal_subscriber.subscriber_lambda'),
       ['I heard: "Hello World: ']) for name in ('local_function', 'old_school')),
    *(([], (EXECUTORS, f'examples_rclpy_executors.{name}'), expected) for name, expected in (
        ('composed', ['Publishing: "Hello World: 0"', 'I heard: "Hello World: 0"']),
        ('callback_group', ['Publishing: "Hello World: 1"']),
        ('custom_callback_group', ['Publishing: "Hello World: 14"']),
        ('custom_executor', ['Publishing']))),
]


def names(cases):
    return [one[1].split('.', 1)[1] for _, one, _ in cases]


@pytest.mark.parametrize('others, one, expected', ENDING, ids=names(ENDING))
def test_demo_prints_its_result_and_ends(others, one, expected):
    with ExitStack() as stack:
        for other in others:
            stack.enter_context(running(*other))
        with running(*one) as process:
            shows(process, *expected)
            ends(process)


@pytest.mark.parametrize('others, one, expected', SPINNING, ids=names(SPINNING))
def test_demo_prints_its_result_while_spinning(others, one, expected):
    with ExitStack() as stack:
        for other in others:
            stack.enter_context(running(*other))
        with running(*one) as process:
            shows(process, *expected)


def test_demo_talker_ends_on_interrupt():
    with running(*demo('topics.talker')) as process, running(*demo('topics.listener')) as other:
        shows(other, 'I heard')  # it isn't about to publish: that would fail, as on ROS 2
        process.send_signal(signal.SIGINT)
        ends(process)


def test_parameters_of_a_demo_are_set():
    with running(*demo('parameters.set_parameters_callback')), running_code(SETTER) as setter:
        shows(setter, '[9.0, 4.0]')


def test_demo_sets_lists_loads_and_deletes_parameters(tmp_path, monkeypatch):
    share = tmp_path / 'share/demo_nodes_py'
    share.mkdir(parents=True)
    shutil.copy(SOURCES / DEMOS / 'demo_nodes_py/parameters/params.yaml', share)
    index = tmp_path / 'share/ament_index/resource_index/packages'
    index.mkdir(parents=True)
    (index / 'demo_nodes_py').touch()
    monkeypatch.setenv('AMENT_PREFIX_PATH', os.pathsep.join(
        [str(tmp_path), os.environ.get('AMENT_PREFIX_PATH', '')]).rstrip(os.pathsep))
    with running_code(BLACKBOARD), running(*demo('parameters.async_param_client')) as client:
        said = shows(client, '- string_parameter: Fee Fi Fo Fum', 'Loading', 'Deleting')
        assert 'successful: False' not in said
        ends(client)

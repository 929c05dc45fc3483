# SPDX-License-Identifier: Apache-2.0
"""A policy on a container machine and on the robot, and its nodes with bad and no messages."""

from __future__ import annotations

from array import array
import contextlib
import json
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import threading

from ament_index_python.packages import get_package_prefix
import pytest

pytest.importorskip('onnxruntime', reason='ONNX Runtime is in the extra applications')

import numpy
import rclpy
from sensor_msgs.msg import Image, JointState, TimeReference
from std_msgs.msg import Float64MultiArray, Header, String, UInt8MultiArray
from trajectory_msgs.msg import JointTrajectory

from fogros2.waiting import wait_until
from fogros2_examples.nodes import LATCHED
from fogros2_examples.policy import arm, training
from fogros2_examples.policy.chunks import SECOND
from fogros2_examples.policy.messages import chunk_message, SENSED
from fogros2_examples.policy.onnx_file import perceptron
from fogros2_examples.slam.messages import image, nanoseconds, time
from rigs.launched import launching

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]
IMAGES = {f'observation.images.{name}': (1, 3, training.HEIGHT, training.WIDTH)
          for name in ('top', 'side')}


@pytest.fixture
def policy(tmp_path):
    """Return a policy that is blind, and goes to the demo's second target from the start."""
    chance = numpy.random.default_rng(5)
    arm.targets(1, chance)
    goal = arm.reaching(arm.targets(2, chance)[1])
    share = numpy.minimum(1, numpy.arange(training.STEPS) / training.RATE)
    weights = numpy.zeros((6 * training.WIDTH * training.HEIGHT + 2, 2 * training.STEPS))
    weights[-2, ::2] = weights[-1, 1::2] = -share
    path = tmp_path / 'policy.onnx'
    path.write_bytes(perceptron(
        IMAGES, [(weights, (share[:, None] * goal).ravel())], training.STEPS))
    return path


def test_arm_reaches_a_target(policy, tmp_path):
    drawn, runs = tmp_path / 'policy.png', tmp_path / 'runs.jsonl'
    with launching() as launch:
        run = launch('fogros2_examples', 'policy.launch.py', 'machine:=container', 'targets:=2',
                     f'policy:={policy}', f'runs:={runs}', f'picture:={drawn}')
        assert run.ended(300) == 0, run.text
    assert run.errors == [], run.text
    assert 'the policy runs on CPUExecutionProvider' in run.text
    assert '[policy.policy_server-1]' in run.text and '/arm/top/image goes out' in run.text
    assert drawn.read_bytes().startswith(b'\x89PNG')
    result = json.loads(runs.read_text())
    assert result['label'] == 'container' and '1' in result['reached']
    # no action was executed past the horizon of its chunk
    assert 0 < max(age for _, age in result['ages']) <= (training.STEPS - 1) / training.RATE


@contextlib.contextmanager
def running(executable, *words):
    """Run a node of the example beside a node of the test's own; yield that and what it says."""
    path = Path(get_package_prefix('fogros2_examples'), 'lib/fogros2_examples', executable)
    process = subprocess.Popen([sys.executable, path, '--ros-args', *words], text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    said = []
    reader = threading.Thread(target=lambda: said.extend(iter(process.stdout.readline, '')))
    reader.start()
    rclpy.init()
    node = rclpy.create_node('robot')
    try:
        yield node, said
    finally:
        node.destroy_node()
        rclpy.shutdown()
        process.send_signal(signal.SIGINT)
        process.wait(30)
        reader.join(30)
        process.stdout.close()
    assert process.returncode == 0, said


def until(node, true, publish=lambda: None):
    """Publish and handle messages until ``true()`` is true."""
    def there():
        publish()
        rclpy.spin_once(node, timeout_sec=0.05)
        return bool(true())
    # a chunk fits the observation before it for a second: the next has to come soon
    wait_until(there, timeout=60.0, interval=0.01, longest=0.05, what='an answer')


def test_robot_stops_where_it_is_without_a_chunk(tmp_path):
    """Chunks end, and what commands then are is where the robot was measured, once."""
    model = tmp_path / 'policy.onnx'
    model.write_bytes(b'any policy')
    with running('policy_client', '-p', 'task:=reach', '-p', f'policy:={model}',
                 '-p', 'images:=[/nobody]') as (node, said):
        commands, sources, told, models = [], [], [], []
        states = node.create_publisher(JointState, 'joint_states', SENSED)
        chunks = node.create_publisher(JointTrajectory, 'action_chunk', SENSED)
        node.create_subscription(
            Float64MultiArray, 'commands', lambda m: commands.append(list(m.data)), 100)
        node.create_subscription(TimeReference, 'action_source', sources.append, 100)
        node.create_subscription(String, 'task', lambda m: told.append(m.data), LATCHED)
        node.create_subscription(
            UInt8MultiArray, 'policy_model', lambda m: models.append(bytes(m.data)), LATCHED)
        made = []

        def sense(position, act=True):
            stamp = node.get_clock().now().nanoseconds
            made.append(stamp)
            states.publish(JointState(header=Header(stamp=time(stamp)), name=list(arm.JOINTS),
                                      position=[position, -position]))
            if act and len(made) > 1:
                # of the observation before, so that the client has seen it
                chunks.publish(chunk_message(
                    made[-2], arm.JOINTS, numpy.full((31, 2), 0.5), 30, False))

        until(node, lambda: len(sources) > 5, lambda: sense(0.25))
        assert told == ['reach'] and models == [b'any policy']
        assert commands[0] == [0.5, 0.5]
        until(node, lambda: commands[-1] != [0.5, 0.5], lambda: sense(0.25, act=False))
        assert commands[-1] == [0.25, -0.25]
        count = len(commands)
        until(node, lambda: len(commands) > count + 5, lambda: sense(0.75, act=False))
        # it stays where it stopped, and has executed nothing that was over
        assert commands[-1] == [0.25, -0.25]
        for source in sources:
            assert 0 <= nanoseconds(source.header.stamp) - nanoseconds(source.time_ref) <= SECOND
        # a chunk for a stamp that the robot did not make moves nothing
        chunks.publish(chunk_message(
            node.get_clock().now().nanoseconds, arm.JOINTS, numpy.ones((31, 2)), 30, False))
        count = len(commands)
        until(node, lambda: len(commands) > count + 5)
        assert commands[-1] == [0.25, -0.25]
        until(node, lambda: commands[-1] == [0.5, 0.5], lambda: sense(0.25))
    text = ''.join(said)
    assert 'the robot stops: no action for now' in text
    assert 'its stamp is of no observation that this robot made' in text


def test_server_survives_bad_observations():
    with running('policy_server', '-p', 'tolerance:=0.0') as (node, said):
        answers = []
        states = node.create_publisher(JointState, 'joint_states', SENSED)
        views = [node.create_publisher(Image, f'/arm/{name}/image', 2) for name in ('top', 'side')]
        models = node.create_publisher(UInt8MultiArray, 'policy_model', LATCHED)
        node.create_subscription(JointTrajectory, 'action_chunk', answers.append, SENSED)

        def sense(encoding='bgr8', names=arm.JOINTS, apart=0):
            stamp = node.get_clock().now().nanoseconds
            states.publish(JointState(header=Header(stamp=time(stamp + apart)), name=list(names),
                                      position=[0.1, 0.2]))
            for view in views:
                pixels = numpy.zeros((48, 64, 3), numpy.uint8)
                view.publish(image(Header(stamp=time(stamp)), pixels, encoding))
            return stamp

        # none is loaded; then a file that is no model, and a model
        models.publish(UInt8MultiArray(data=array('B', b'no model')))
        until(node, lambda: 'the ONNX model cannot be loaded' in ''.join(said), sense)
        pixels = 6 * training.WIDTH * training.HEIGHT
        layer = numpy.zeros((pixels + 2, 4), numpy.float32), numpy.arange(4, dtype=numpy.float32)
        models.publish(UInt8MultiArray(data=array('B', perceptron(IMAGES, [layer], 2))))
        until(node, lambda: answers, sense)
        assert answers[0].joint_names == list(arm.JOINTS)
        positions = [list(point.positions) for point in answers[0].points]
        assert positions == [pytest.approx([0.1, 1.2]), pytest.approx([2.1, 3.2])]
        # stamps that do not match, images without colours, joints without names: no answer
        for words in ({'apart': 1000}, {'encoding': '16UC1'}, {'names': ['a', 'b']}):
            count = len(answers)
            for _ in range(5):
                sense(**words)
                rclpy.spin_once(node, timeout_sec=0.05)
            stamp = sense()
            until(node, lambda at=stamp: nanoseconds(answers[-1].header.stamp) >= at, sense)
            assert len(answers) > count
    text = ''.join(said)
    assert "an image as '16UC1'" in text
    assert 'the policy runs on CPUExecutionProvider' in text


def test_absent_file_of_a_policy_ends_the_client():
    path = Path(get_package_prefix('fogros2_examples'), 'lib/fogros2_examples/policy_client')
    done = subprocess.run([sys.executable, path, '--ros-args', '-p', 'policy:=/no/policy.onnx'],
                          capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    assert '/no/policy.onnx' in done.stderr and 'policy_client: ' in done.stderr

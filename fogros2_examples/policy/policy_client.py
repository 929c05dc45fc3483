# SPDX-License-Identifier: Apache-2.0
"""
Command the robot by the chunks of a policy.

The node publishes ``task``, takes ``joint_states`` and ``action_chunk``, and publishes
``commands`` at a fixed rate. With each action it publishes ``action_source``: now, and the time of
the observations behind it. Without an action for now, the robot stops.
"""

from __future__ import annotations

import array
from pathlib import Path
from typing import Optional

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState, TimeReference
from std_msgs.msg import Float64MultiArray, Header, String, UInt8MultiArray
from trajectory_msgs.msg import JointTrajectory

from fogros2_examples.meshes import Floats
from fogros2_examples.nodes import LATCHED, run
from fogros2_examples.parameters import within
from fogros2_examples.policy.arm import JOINTS
from fogros2_examples.policy.chunks import Queue, SECOND
from fogros2_examples.policy.messages import angles_of, chunk_of, SENSED
from fogros2_examples.slam.messages import nanoseconds, time


class PolicyClient(Node):
    """
    The robot's end of a policy.

    Parameters: ``task``; ``policy``, an ONNX file for the server, '' if the server has its own;
    ``images``, topics that need a publisher; ``joints``; ``rate`` of commands per second;
    ``velocity``, whether actions are velocities; ``blend``, the time in s in which a new chunk
    takes over; ``longest``, the most s from an observation to an action.
    """

    def __init__(self) -> None:
        super().__init__('policy_client')
        self.joints = list(self.declare_parameter('joints', list(JOINTS)).value)
        self.images = list(self.declare_parameter(
            'images', ['/arm/top/image', '/arm/side/image']).value)
        self.velocity = bool(self.declare_parameter('velocity', False).value)
        rate = within(self, 'rate', 30.0, 10.0, 1000.0)
        blend, longest = (round(SECOND * within(self, name, default, 0.0, 60.0))
                          for name, default in (('blend', 0.1), ('longest', 5.0)))
        self.queue = Queue(blend, longest, self.velocity)
        self.measured: Optional[Floats] = None
        self.stopped = True
        self.commands = self.create_publisher(Float64MultiArray, 'commands', 1)
        self.sources = self.create_publisher(TimeReference, 'action_source', 10)
        self.tasks = self.create_publisher(String, 'task', LATCHED)
        self.tasks.publish(String(data=str(self.declare_parameter('task', 'reach').value)))
        path = str(self.declare_parameter('policy', '').value)
        if path:
            self.models = self.create_publisher(UInt8MultiArray, 'policy_model', LATCHED)
            self.models.publish(UInt8MultiArray(data=array.array('B', Path(path).read_bytes())))
        self.create_subscription(JointState, 'joint_states', self._measure, SENSED)
        self.create_subscription(JointTrajectory, 'action_chunk', self._take, SENSED)
        # the node's clock may be set back, and the robot has to stop all the same
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1 / rate, self._tick, clock=steady)
        self.create_timer(5.0, self._look, clock=steady)

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _measure(self, state: JointState) -> None:
        if set(self.joints) <= set(state.name):
            self.measured = angles_of(state, self.joints)
            self.queue.observe(nanoseconds(state.header.stamp))

    def _take(self, message: JointTrajectory) -> None:
        try:
            self.queue.add(chunk_of(message, self.joints, self.velocity), self._now())
        except ValueError as error:
            self.get_logger().warning(f'chunk refused: {error}', throttle_duration_sec=5.0)

    def _tick(self) -> None:
        now = self._now()
        command = self.queue.command(now, self.measured)
        if command is None:
            return
        self.commands.publish(Float64MultiArray(data=command.values.tolist()))
        if command.stamp is not None:
            self.sources.publish(TimeReference(
                header=Header(stamp=time(now)), time_ref=time(command.stamp), source='policy'))
        if (command.stamp is None) != self.stopped:
            self.stopped = command.stamp is None
            self.get_logger().info('the robot stops: no action for now' if self.stopped
                                   else 'the policy commands the robot')

    def _look(self) -> None:
        for topic in self.images:
            if self.stopped and not self.count_publishers(topic):
                self.get_logger().warning(f'nobody publishes {topic}')


def main() -> None:
    """Run until interrupted."""
    run('policy_client', PolicyClient)

# SPDX-License-Identifier: Apache-2.0
"""
Simulate a robot: a planar arm that reaches for targets, seen by two cameras.

The node publishes ``joint_states`` and ``arm/top/image``, ``arm/side/image``, and follows
``commands``. When the first command arrives, it shows its targets one after the other.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
import time

import numpy
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import Image, JointState, TimeReference
from std_msgs.msg import Float64MultiArray, Header

from fogros2_examples.files import PICTURES
from fogros2_examples.nodes import run
from fogros2_examples.parameters import within, writable
from fogros2_examples.policy import arm
from fogros2_examples.policy.messages import SENSED
from fogros2_examples.policy.picture import draw, summary
from fogros2_examples.slam import messages

#: Steps of the simulation per second, and how many of them an image is apart.
STEPS, APART = 60, 2
#: Seconds for each target and until the first command; distance of a reached target, m.
SHOWN, WAIT, REACHED = 4.0, 300.0, 0.04


class PolicyArm(Node):
    """
    The robot.

    Parameters: ``targets``, number of targets; ``label`` of this run; ``runs``, a file to which
    the run is added as a line of JSON; ``picture``, a file to draw all runs of that file in.
    """

    def __init__(self) -> None:
        super().__init__('policy_arm')
        self.label = str(self.declare_parameter('label', 'policy').value)
        self.runs = writable(self, 'runs')
        self.picture = writable(self, 'picture', (*PICTURES, '.pdf', '.svg'))
        chance = numpy.random.default_rng(5)
        self.joints = self.commanded = arm.reaching(arm.targets(1, chance))[0]
        self.targets = arm.targets(within(self, 'targets', 6, 1, 1000), chance)
        self.views = arm.cameras(640, 480)
        self.begin, self.before, self.end = 0.0, time.monotonic(), time.monotonic() + WAIT
        self.step = 0
        #: Time, position of the tip and its distance from the target; time and age of each action.
        self.course: list[list[float]] = []
        self.ages: list[list[float]] = []
        #: Seconds until a target was reached.
        self.reached: dict[int, float] = {}
        self.states = self.create_publisher(JointState, 'joint_states', SENSED)
        self.images = {name: self.create_publisher(Image, f'arm/{name}/image', 2)
                       for name in self.views}
        self.create_subscription(Float64MultiArray, 'commands', self._command, 1)
        self.create_subscription(TimeReference, 'action_source', self._source, 10)
        self.create_timer(1 / STEPS, self._move)

    def _command(self, command: Float64MultiArray) -> None:
        self.commanded = numpy.array(command.data)
        if not self.begin:
            self.begin = time.monotonic()
            self.end = self.begin + SHOWN * len(self.targets)

    def _source(self, source: TimeReference) -> None:
        now, then = map(messages.nanoseconds, (source.header.stamp, source.time_ref))
        self.ages.append([self.begin and time.monotonic() - self.begin, 1e-9 * (now - then)])

    def _move(self) -> None:
        """Simulate the time since the last step, and publish what the robot senses."""
        now = time.monotonic()
        self.joints = arm.moved(self.joints, self.commanded, now - self.before)
        self.before = now
        seconds = self.begin and now - self.begin
        index = min(len(self.targets) - 1, int(seconds / SHOWN))
        target = self.targets[index]
        if self.begin:
            tip = arm.corners(self.joints)[-1]
            far = float(numpy.linalg.norm(tip - target))
            self.course.append([seconds, *tip, far])
            if far < REACHED:
                self.reached.setdefault(index, seconds - index * SHOWN)
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id='base')
        self.states.publish(JointState(
            header=header, name=list(arm.JOINTS), position=self.joints.tolist()))
        if self.step % APART == 0:
            for name, view in self.views.items():
                self.images[name].publish(messages.image(
                    header, arm.picture(view, self.joints, target), 'bgr8'))
        self.step += 1

    def run(self) -> None:
        """Show all targets, then exit: with status 0 if the tip has reached one."""
        while time.monotonic() < self.end:
            rclpy.spin_once(self, timeout_sec=0.1)
        if not self.ages:
            raise SystemExit(f'policy_arm: no action came in {WAIT:g} s')
        done = {'label': self.label, 'targets': self.targets.tolist(), 'shown': SHOWN,
                'reached': self.reached, 'course': self.course, 'ages': self.ages}
        self.get_logger().info(summary(done))
        with open(self.runs or os.devnull, 'a+') as file:
            file.write(json.dumps(done) + '\n')
            file.seek(0)
            runs = [json.loads(line) for line in file] or [done]
        if self.picture:
            draw(Path(self.picture), runs)
        raise SystemExit(not self.reached)


def main() -> None:
    """Run until all targets were shown."""
    run('policy_arm', PolicyArm, PolicyArm.run)

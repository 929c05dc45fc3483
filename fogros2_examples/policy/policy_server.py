# SPDX-License-Identifier: Apache-2.0
"""
Answer observations with chunks of actions.

The node takes the images of all cameras and ``joint_states``, matched by their stamps, and
``task``. It answers the newest observation on ``action_chunk``, with the joint state's stamp.
"""

from __future__ import annotations

from functools import partial
import time
from typing import Any, Optional

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String, UInt8MultiArray
from trajectory_msgs.msg import JointTrajectory

from fogros2_examples.letterbox import Pixels
from fogros2_examples.nodes import LATCHED, run
from fogros2_examples.parameters import BadParameter, within
from fogros2_examples.policy.chunks import SECOND
from fogros2_examples.policy.matching import Matcher
from fogros2_examples.policy.messages import angles_of, chunk_message, SENSED
from fogros2_examples.policy.policies import BadPolicy, Onnx, OPENPI, Openpi, Policy, PROMPT
from fogros2_examples.slam.messages import nanoseconds, rgb

#: Name of the joint state among the images.
STATE = ''
#: Images of each camera and joint states that wait for each other.
IMAGES, STATES = 8, 1024
#: Messages that are taken before the policy runs, at most.
TAKEN = 16


class PolicyServer(Node):
    """
    The server.

    Parameters: ``policy``, an ONNX file, ``openpi:PORT``, or '' for the model that
    ``policy_client`` sends; ``images``, as INPUT=TOPIC; ``states``, as INPUT=JOINT,JOINT, which
    are the joints of the actions too; ``rate``, actions per second; ``velocity``, whether actions
    are velocities; ``tolerance`` of stamps, s; ``providers`` of ONNX Runtime; ``slowdown``, to act
    as a processor that is so many times slower.
    """

    def __init__(self) -> None:
        super().__init__('policy_server')
        self.source = str(self.declare_parameter('policy', '').value)
        self.images = self._pairs('images', ['observation.images.top=/arm/top/image',
                                             'observation.images.side=/arm/side/image'])
        self.states = {name: joints.split(',') for name, joints in self._pairs(
            'states', ['observation.state=shoulder,elbow']).items()}
        self.joints = [joint for joints in self.states.values() for joint in joints]
        self.rate = within(self, 'rate', 30.0, 0.1, 1000.0)
        self.velocity = bool(self.declare_parameter('velocity', False).value)
        self.providers = list(self.declare_parameter('providers', [
            'TensorrtExecutionProvider', 'CUDAExecutionProvider', 'CPUExecutionProvider']).value)
        self.slowdown = within(self, 'slowdown', 1.0, 1.0, 1000.0)
        self.matcher = Matcher({**dict.fromkeys(self.images, IMAGES), STATE: STATES}, round(
            SECOND * within(self, 'tolerance', 0.02, 0.0, 1.0)))
        self.policy: Optional[Policy] = None
        self.task, self.taken = '', 0
        self.chunks = self.create_publisher(JointTrajectory, 'action_chunk', SENSED)
        for name, topic in self.images.items():
            self.create_subscription(Image, topic, partial(self._take, name), 2)
        self.create_subscription(JointState, 'joint_states', partial(self._take, STATE), SENSED)
        self.create_subscription(
            String, 'task', lambda task: setattr(self, 'task', task.data), LATCHED)
        if self.source:
            self.create_timer(1.0, partial(self._use, self.source))
        else:
            self.create_subscription(UInt8MultiArray, 'policy_model', lambda message: self._use(
                bytes(message.data)), LATCHED)

    def _pairs(self, name: str, default: list[str]) -> dict[str, str]:
        texts = self.declare_parameter(name, default).value
        if not all('=' in text for text in texts):
            raise BadParameter(f"'{name}' is {texts}: each has to be of the form INPUT=...")
        return dict(text.split('=', 1) for text in texts)

    def _take(self, name: str, message: Any) -> None:
        self.taken += 1
        self.matcher.add(name, nanoseconds(message.header.stamp), message)

    def _use(self, source: str | bytes) -> None:
        """Load a policy, unless the one of the parameter is loaded; log it if that fails."""
        if self.policy and self.source:
            return
        try:
            if isinstance(source, str) and source.startswith(OPENPI):
                self.policy = Openpi(int(source[len(OPENPI):]))
            else:
                self.policy = Onnx(source, [*self.images, *self.states, PROMPT], self.providers)
        except (ImportError, ValueError) as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
        else:
            self.get_logger().info(f'the policy runs on {self.policy.runs_on}')

    def _seen(self, name: str, image: Image) -> Pixels:
        """Return an image as RGB, of the size that the model names; log if this adds bars."""
        assert self.policy is not None
        size = self.policy.sizes.get(name)
        if size and image.width * size[1] != image.height * size[0]:
            self.get_logger().warning(
                f"'{name}' of {image.width}x{image.height} gets black bars, for the model's size "
                f'of {size[0]}x{size[1]}', once=True)
        return rgb(image, size)

    def answer(self) -> None:
        """Answer the newest observation, if there is a new one."""
        if self.policy is None or (observation := self.matcher.newest()) is None:
            return
        state = observation[STATE]
        try:
            actions = self.policy.infer({
                **{name: self._seen(name, observation[name]) for name in self.images},
                **{name: angles_of(state, joints) for name, joints in self.states.items()},
                PROMPT: self.task})
            if actions.shape[1] != len(self.joints):
                raise BadPolicy(f"{actions.shape[1]} actions, not for {', '.join(self.joints)}")
        except ValueError as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            if isinstance(error, BadPolicy) and isinstance(self.policy, Openpi):
                self.policy = None  # connect again
            return
        self.chunks.publish(chunk_message(
            nanoseconds(state.header.stamp), self.joints, actions, self.rate, self.velocity))

    def run(self) -> None:
        """Answer observations until interrupted."""
        spent = time.process_time()
        while True:
            rclpy.spin_once(self, timeout_sec=1.0)
            # take what has arrived meanwhile, for the newest observation
            for _ in range(TAKEN):
                before = self.taken
                rclpy.spin_once(self, timeout_sec=0.0)
                if self.taken == before:
                    break
            self.answer()
            time.sleep((self.slowdown - 1) * (time.process_time() - spent))
            spent = time.process_time()


def main() -> None:
    """Run until interrupted."""
    run('policy_server', PolicyServer, PolicyServer.run)

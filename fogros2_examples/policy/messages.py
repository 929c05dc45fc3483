# SPDX-License-Identifier: Apache-2.0
"""Convert chunks and joint states from and to messages; images are converted as for SLAM."""

from __future__ import annotations

import array
from collections.abc import Sequence

from builtin_interfaces.msg import Duration
import numpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from fogros2_examples.meshes import Floats
from fogros2_examples.policy.chunks import Chunk, SECOND
from fogros2_examples.slam.messages import nanoseconds, time

#: Repeats no lost message, so that nothing waits; a busy reader misses none.
SENSED = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


def angles_of(state: JointState, joints: Sequence[str]) -> Floats:
    """
    Return the positions of some joints, in their order.

    :raises ValueError: a joint has none.
    """
    positions = dict(zip(state.name, state.position))
    missing = [name for name in joints if name not in positions]
    if missing:
        raise ValueError(f"the joint state has no position of {', '.join(missing)}")
    return numpy.array([positions[name] for name in joints])


def chunk_message(
    stamp: int, joints: Sequence[str], actions: Floats, rate: float, velocity: bool,
) -> JointTrajectory:
    """
    Return actions (n, joints) as a message, the first one for the stamp itself.

    :param rate: actions per second.
    """
    made = JointTrajectory(header=Header(stamp=time(stamp)), joint_names=list(joints))
    for number, action in enumerate(actions):
        after = round(number * SECOND / rate)
        made.points.append(JointTrajectoryPoint(
            time_from_start=Duration(sec=after // SECOND, nanosec=after % SECOND),
            # rclpy checks each number of a list, which takes 2 ms for 50 actions
            **{'velocities' if velocity else 'positions': array.array('d', action)}))
    return made


def chunk_of(message: JointTrajectory, joints: Sequence[str], velocity: bool) -> Chunk:
    """
    Return the chunk of a message.

    :raises ValueError: other joints, no actions, numbers that are not finite, times in disorder.
    """
    if list(message.joint_names) != list(joints):
        raise ValueError(f"actions for {', '.join(message.joint_names) or 'no joints'}")
    rows = [point.velocities if velocity else point.positions for point in message.points]
    if not rows or any(len(row) != len(joints) for row in rows):
        raise ValueError(f"no {'velocities' if velocity else 'positions'} for each joint")
    values = numpy.array(rows, float)
    times = numpy.array([nanoseconds(point.time_from_start) for point in message.points], float)
    if not numpy.isfinite(values).all() or times[0] < 0 or (numpy.diff(times) <= 0).any():
        raise ValueError('actions that are no numbers, or times that do not increase')
    return Chunk(nanoseconds(message.header.stamp), times, values)

# SPDX-License-Identifier: Apache-2.0
"""Where a node's clock has its time from: the system, or /clock while use_sim_time is set."""

from typing import Any, TYPE_CHECKING
import weakref

from rclpy.clock import ROSClock
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time

if TYPE_CHECKING:
    from rclpy.node import Node

CLOCK_TOPIC = '/clock'
USE_SIM_TIME_NAME = 'use_sim_time'


class TimeSource:
    """Sets a node's clock, by the node's parameter and a subscription to /clock."""

    def __init__(self, node: 'Node', clock: ROSClock) -> None:
        self._reference = weakref.ref(node)
        self._clock = clock
        self._subscription: Any = None
        if not node.has_parameter(USE_SIM_TIME_NAME):
            node.declare_parameter(USE_SIM_TIME_NAME, False)
        parameter = node.get_parameter(USE_SIM_TIME_NAME)
        if parameter.type_ is Parameter.Type.BOOL:
            self._follow(parameter.value)
        else:
            node.get_logger().error(f"Invalid type for parameter '{USE_SIM_TIME_NAME}' "
                                    f'{parameter.type_!r} should be bool')
        node.add_on_set_parameters_callback(self._on_parameters)

    def _follow(self, simulated: bool) -> None:
        """Take the time from /clock, or from the system."""
        self._clock._set_ros_time_is_active(simulated)
        node = self._reference()
        if node is None or simulated == (self._subscription is not None):
            return
        if simulated:
            from rosgraph_msgs.msg import Clock
            self._subscription = node.create_subscription(
                Clock, CLOCK_TOPIC, self._on_clock,
                QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
        else:
            node.destroy_subscription(self._subscription)
            self._subscription = None

    def _on_clock(self, msg: Any) -> None:
        self._clock.set_ros_time_override(Time.from_msg(msg.clock))

    def _on_parameters(self, parameters: list[Parameter]) -> Any:
        from rcl_interfaces.msg import SetParametersResult
        for parameter in parameters:
            if parameter.name != USE_SIM_TIME_NAME:
                continue
            if parameter.type_ is not Parameter.Type.BOOL:
                reason = f'{USE_SIM_TIME_NAME} parameter set to something besides a bool'
                if (node := self._reference()) is not None:
                    node.get_logger().error(reason)
                return SetParametersResult(successful=False, reason=reason)
            self._follow(parameter.value)
        return SetParametersResult(successful=True)

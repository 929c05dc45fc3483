# SPDX-License-Identifier: Apache-2.0
"""Where a node's clock has its time from: the system, or /clock while use_sim_time is set."""

from typing import Any, TYPE_CHECKING
import weakref

from rclpy.clock import ROSClock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time

if TYPE_CHECKING:
    from rclpy.node import Node

CLOCK_TOPIC = '/clock'
USE_SIM_TIME_NAME = 'use_sim_time'


class TimeSource:
    """Sets clocks by a node's parameter and its subscription to /clock."""

    def __init__(self, *, node: 'Node | None' = None) -> None:
        self._clock_sub: Any = None
        self._reference: weakref.ReferenceType[Node] | None = None
        self._clocks: set[ROSClock] = set()
        self._last = Time(clock_type=ClockType.ROS_TIME)
        self._active = False
        if node is not None:
            self.attach_node(node)

    @property
    def ros_time_is_active(self) -> bool:
        """Whether /clock gives the time."""
        return self._active

    @ros_time_is_active.setter
    def ros_time_is_active(self, enabled: bool) -> None:
        if self._active == enabled:
            return
        self._active = enabled
        for clock in self._clocks:
            clock._set_ros_time_is_active(enabled)
        node = self._node()
        if node is None:
            return
        if enabled and self._clock_sub is None:
            from rosgraph_msgs.msg import Clock
            self._clock_sub = node.create_subscription(
                Clock, CLOCK_TOPIC, self.clock_callback,
                QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
        elif not enabled and self._clock_sub is not None:
            node.destroy_subscription(self._clock_sub)
            self._clock_sub = None

    def _node(self) -> 'Node | None':
        return self._reference() if self._reference is not None else None

    def attach_node(self, node: 'Node') -> None:
        """Follow this node's parameter."""
        self._reference = weakref.ref(node)
        if not node.has_parameter(USE_SIM_TIME_NAME):
            node.declare_parameter(USE_SIM_TIME_NAME, False)
        parameter = node.get_parameter(USE_SIM_TIME_NAME)
        if parameter.type_ is Parameter.Type.BOOL:
            self.ros_time_is_active = parameter.value
        else:
            node.get_logger().error(f"Invalid type for parameter '{USE_SIM_TIME_NAME}' "
                                    f'{parameter.type_!r} should be bool')
        node.add_on_set_parameters_callback(self._on_parameters)

    def attach_clock(self, clock: ROSClock) -> None:
        """
        Set this clock.

        :raises ValueError: if its type isn't ROS_TIME.
        """
        if not isinstance(clock, ROSClock):
            raise ValueError('Only clocks with type ROS_TIME can be attached.')
        clock.set_ros_time_override(self._last)
        clock._set_ros_time_is_active(self._active)
        self._clocks.add(clock)

    def clock_callback(self, msg: Any) -> None:
        """Set the clocks by a message of /clock."""
        self._last = Time.from_msg(msg.clock)
        for clock in self._clocks:
            clock.set_ros_time_override(self._last)

    def _on_parameters(self, parameters: list[Parameter]) -> Any:
        from rcl_interfaces.msg import SetParametersResult
        for parameter in parameters:
            if parameter.name != USE_SIM_TIME_NAME:
                continue
            if parameter.type_ is not Parameter.Type.BOOL:
                reason = f'{USE_SIM_TIME_NAME} parameter set to something besides a bool'
                if (node := self._node()) is not None:
                    node.get_logger().error(reason)
                return SetParametersResult(successful=False, reason=reason)
            self.ros_time_is_active = parameter.value
        return SetParametersResult(successful=True)

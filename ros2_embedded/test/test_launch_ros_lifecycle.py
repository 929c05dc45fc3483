# SPDX-License-Identifier: Apache-2.0
"""Lifecycle nodes: transitions asked for and told, over real services and topics."""

import inspect
import sys

from launch import LaunchDescription, LaunchService
from launch.actions import EmitEvent, OpaqueFunction, RegisterEventHandler, Shutdown, TimerAction
from launch.substitutions import TextSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.events.matchers import matches_node_name
import pytest

NODE = f'''#!{sys.executable}
from lifecycle_msgs.msg import State, TransitionEvent
from lifecycle_msgs.srv import ChangeState
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

NEXT = {{1: ('configure', 'configuring', State(id=2, label='inactive')),
        3: ('activate', 'activating', State(id=3, label='active')),
        4: ('deactivate', 'deactivating', State(id=2, label='inactive'))}}


class Managed(Node):

    def __init__(self):
        super().__init__('managed')
        self.publisher = self.create_publisher(TransitionEvent, '~/transition_event', 10)
        self.create_service(ChangeState, '~/change_state', self.change)

    def change(self, request, response):
        number = request.transition.id
        response.success = number in NEXT
        if response.success:
            event = TransitionEvent()
            event.transition.label, event.start_state.label, event.goal_state = NEXT[number]
            self.publisher.publish(event)
        return response


rclpy.init()
node = Managed()
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
'''


pytestmark = pytest.mark.usefixtures('own_log')


@pytest.mark.skipif('autostart' not in inspect.signature(LifecycleNode).parameters,
                    reason='launch_ros is older than 0.26.7')
def test_launch_changes_the_states_of_a_node_and_hears_of_them(tmp_path):
    """It configures and activates the node by ``autostart``, and deactivates it by an event."""
    path = tmp_path / 'managed'
    path.write_text(NODE)
    path.chmod(0o755)
    notes = []
    node = LifecycleNode(executable=path, name='managed', namespace='/ns',
                         autostart=TextSubstitution(text='true'))

    def on(then=(), **kwargs):
        def note(context):
            event = context.locals.event
            notes.append((event.transition, event.start_state, event.goal_state,
                          event.action is node))

        return RegisterEventHandler(OnStateTransition(
            target_lifecycle_node=node, entities=[OpaqueFunction(function=note), *then], **kwargs))

    service = LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription([
        on(transition='configure', goal_state='inactive'),
        on(transition='activate', start_state='activating', then=[EmitEvent(event=ChangeState(
            lifecycle_node_matcher=matches_node_name('/ns/managed'), transition_id=4))]),
        on(transition='deactivate', then=[Shutdown()]),
        node, TimerAction(period=120.0, actions=[Shutdown(reason='too late')])]))
    assert service.run() == 0
    assert notes == [('configure', 'configuring', 'inactive', True),
                     ('activate', 'activating', 'active', True),
                     ('deactivate', 'deactivating', 'inactive', True)]

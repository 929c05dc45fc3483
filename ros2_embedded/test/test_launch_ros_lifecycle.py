# SPDX-License-Identifier: Apache-2.0
"""Lifecycle nodes: transitions asked for and told, over real services and topics."""

import inspect
import logging
import sys

from launch import LaunchDescription, LaunchService
from launch.actions import EmitEvent, OpaqueFunction, RegisterEventHandler, Shutdown, TimerAction
from launch.event_handlers import OnProcessIO
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
        3: ('activate', 'activating', State(id=3, label='active'))}}


class Managed(Node):

    def __init__(self):
        super().__init__('managed')
        self.publisher = self.create_publisher(TransitionEvent, '~/transition_event', 10)
        self.create_service(ChangeState, '~/change_state', self.change)
        print('ready', flush=True)

    def change(self, request, response):
        number = request.transition.id
        response.success = number in NEXT
        if response.success:
            event = TransitionEvent()
            event.transition.label, event.start_state.label, event.goal_state = NEXT[number]
            self.publisher.publish(event)
            print(event.transition.label, flush=True)
        return response


rclpy.init()
node = Managed()
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
'''


pytestmark = pytest.mark.usefixtures('own_log')


@pytest.fixture
def path(tmp_path):
    """Return the path of the node's program."""
    made = tmp_path / 'managed'
    made.write_text(NODE)
    made.chmod(0o755)
    return made


@pytest.mark.skipif('autostart' not in inspect.signature(LifecycleNode).parameters,
                    reason='launch_ros is older than 0.26.7')
def test_autostart_configures_and_activates_a_node(path):
    seen = b''
    node = LifecycleNode(executable=path, name='managed', namespace='/ns',
                         autostart=TextSubstitution(text='true'))

    def note(event):
        nonlocal seen
        before, seen = seen, seen + event.text
        return Shutdown() if b'activate' in seen and b'activate' not in before else None

    service = LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription([
        RegisterEventHandler(OnProcessIO(target_action=node, on_stdout=note)),
        node, TimerAction(period=120.0, actions=[Shutdown(reason='too late')])]))
    assert service.run() == 0
    assert seen.split() == [b'ready', b'configure', b'activate']


def test_launch_configures_and_activates_a_node(path, capsys, monkeypatch):
    notes = []
    node = LifecycleNode(
        executable=path, name='managed', namespace='/ns', output='screen')

    def note(context):
        event = context.locals.event
        notes.append((event.transition, event.start_state, event.goal_state,
                      event.action is node))

    def change(number):
        return EmitEvent(event=ChangeState(
            lifecycle_node_matcher=matches_node_name('/ns/managed'), transition_id=number))

    service = LaunchService(noninteractive=True)

    class AfterFailure(logging.Handler):
        # one after the other: of two calls at once rclpy may lose a response
        def emit(self, record):
            if 'TRANSITION_CLEANUP' in record.getMessage():
                service.emit_event(change(1).event)

    logger = logging.getLogger(LifecycleNode.execute.__globals__['__name__'])
    monkeypatch.setattr(logger, 'handlers', [*logger.handlers, AfterFailure()])
    service.include_launch_description(LaunchDescription([
        RegisterEventHandler(OnProcessIO(target_action=node, on_stdout=lambda event: (
            change(2) if b'ready' in event.text else None))),
        RegisterEventHandler(OnStateTransition(
            target_lifecycle_node=node, goal_state='inactive',
            entities=[OpaqueFunction(function=note), change(3)])),
        RegisterEventHandler(OnStateTransition(
            target_lifecycle_node=node, transition='activate', start_state='activating',
            goal_state='active', entities=[OpaqueFunction(function=note), Shutdown()])),
        node, TimerAction(period=120.0, actions=[Shutdown(reason='too late')])]))
    assert service.run() == 0
    assert notes == [('configure', 'configuring', 'inactive', True),
                     ('activate', 'activating', 'active', True)]
    assert ("Failed to make transition 'TRANSITION_CLEANUP' for LifecycleNode '/ns/managed'"
            ) in capsys.readouterr().out

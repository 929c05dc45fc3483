# SPDX-License-Identifier: Apache-2.0
"""Nodes looking at each other: parameters, graph, /rosout, lifecycle."""

import time

from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
import pytest
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    Log,
    ParameterDescriptor,
    ParameterEvent,
    SetParametersResult,
)
import rclpy
from rclpy.context import Context
from rclpy.exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import NodeNameNonExistentError
from rclpy.parameter import get_parameter_value, Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger

LIMIT = 10.0  # seconds until something that should happen hasn't


class World:
    """Two contexts, so that the wire is between their nodes, and one executor for each."""

    def __init__(self):
        self.contexts = [Context(), Context()]
        self.executors = []
        self.nodes = []
        for context in self.contexts:
            context.init(args=[])
            self.executors.append(SingleThreadedExecutor(context=context))

    def node(self, name, side=0, kind=rclpy.create_node, **kwargs):
        node = kind(name, context=self.contexts[side], **kwargs)
        self.nodes.append(node)
        self.executors[side].add_node(node)
        return node

    def until(self, condition, limit=LIMIT):
        end = time.monotonic() + limit
        while not condition():
            assert time.monotonic() < end, 'it did not happen'
            for executor in self.executors:
                executor.spin_once(timeout_sec=0.005)

    def call(self, client, request):
        assert client.wait_for_service(timeout_sec=LIMIT)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def close(self):
        for node in self.nodes:
            node.destroy_node()
        for executor in self.executors:
            executor.shutdown()
        for context in self.contexts:
            context.try_shutdown()


@pytest.fixture
def world():
    made = World()
    yield made
    made.close()


# --- parameters ---------------------------------------------------------------------------------

def test_parameters_are_declared_and_read(world):
    node = world.node('one')
    assert node.declare_parameter('speed', 1.5).value == 1.5
    assert node.get_parameter('speed').type_ == Parameter.Type.DOUBLE
    declared = node.declare_parameters('arm', [('joints', 6), ('names', ['a'])])
    assert [one.name for one in declared] == ['arm.joints', 'arm.names']
    assert set(node.get_parameters_by_prefix('arm')) == {'joints', 'names'}
    assert node.has_parameter('arm.joints') and not node.has_parameter('joints')
    assert node.get_parameter_or('none', Parameter('none', value=3)).value == 3
    listed = node.list_parameters(['arm'], 0)
    assert sorted(listed.names) == ['arm.joints', 'arm.names'] and listed.prefixes == ['arm']
    with pytest.raises(ParameterAlreadyDeclaredException):
        node.declare_parameter('speed', 2.0)
    with pytest.raises(ParameterNotDeclaredException):
        node.get_parameter('none')
    with pytest.raises(InvalidParameterException):
        node.declare_parameter('', 1)
    with pytest.raises(TypeError):
        node.declare_parameter('mixed', [1, 'a'])
    node.declare_parameter('later', Parameter.Type.INTEGER)
    with pytest.raises(ParameterUninitializedException):
        node.get_parameter('later')
    node.set_parameters([Parameter('later', value=3)])
    assert node.get_parameter('later').value == 3
    node.undeclare_parameter('speed')
    assert not node.has_parameter('speed')


def test_parameter_is_set_or_refused_with_a_reason(world):
    node, told = world.node('one'), []
    node.declare_parameter('count', 2, ParameterDescriptor(
        integer_range=[IntegerRange(from_value=0, to_value=10, step=2)]))
    node.declare_parameter('fixed', 'x', ParameterDescriptor(read_only=True))
    node.declare_parameter('ratio', 0.5, ParameterDescriptor(
        floating_point_range=[FloatingPointRange(from_value=0.0, to_value=1.0)]))
    node.add_post_set_parameters_callback(
        lambda parameters: told.extend(one.name for one in parameters))

    def result(name, value):
        return node.set_parameters([Parameter(name, value=value)])[0]

    assert result('count', 4).successful and told == ['count']
    for name, value, reason in (
            ('count', 3, 'not a valid step'), ('count', 12, 'out of range'),
            ('count', 'x', 'Wrong parameter type'), ('fixed', 'y', 'read-only'),
            ('ratio', 1.5, 'out of range')):
        refused = result(name, value)
        assert not refused.successful and reason in refused.reason
    assert node.get_parameter('count').value == 4
    with pytest.raises(ParameterNotDeclaredException):
        result('none', 1)
    with pytest.raises(ParameterImmutableException):
        node.undeclare_parameter('fixed')
    node.add_on_set_parameters_callback(
        lambda parameters: SetParametersResult(successful=False, reason='never'))
    assert result('count', 6).reason == 'never'
    with pytest.raises(InvalidParameterValueException):
        node.declare_parameter('new', 1)


def test_parameters_are_set_atomically(world):
    node = world.node('one', allow_undeclared_parameters=True)
    node.declare_parameter('fixed', 1, ParameterDescriptor(read_only=True))
    done = node.set_parameters_atomically(
        [Parameter('a', value=1), Parameter('fixed', value=2)])
    assert not done.successful and not node.has_parameter('a')
    assert node.set_parameters_atomically([Parameter('a', value=1)]).successful
    assert node.get_parameter('a').value == 1
    assert node.get_parameter('undeclared').type_ == Parameter.Type.NOT_SET
    assert node.set_parameters([Parameter('a')])[0].successful and not node.has_parameter('a')


def test_parameters_come_from_command_line_and_files(tmp_path):
    file = tmp_path / 'values.yaml'
    file.write_text(
        '/**:\n  ros__parameters:\n    all: 1\n    shared: everyone\n'
        '/robot/one:\n  ros__parameters:\n    shared: one\n    list: [1.0, 2.0]\n'
        '    deep: {er: true}\nother:\n  ros__parameters: {shared: other}\n')
    context = Context()
    context.init(args=['--ros-args', '--params-file', str(file), '-p', 'typed:=2', '-p',
                       'one:mine:=yes please', '-p', 'two:mine:=no'])
    node = rclpy.create_node('one', namespace='/robot', context=context,
                             parameter_overrides=[Parameter('given', value='here')])
    for name, default, value in (
            ('all', 0, 1), ('shared', '', 'one'), ('deep.er', False, True), ('typed', 0, 2),
            ('given', '', 'here'), ('untouched', 5, 5)):
        assert node.declare_parameter(name, default).value == value
    assert list(node.declare_parameter('list', [0.0]).value) == [1.0, 2.0]
    with pytest.raises(InvalidParameterTypeException):
        node.declare_parameters('', [('typed.too', 1.0)]) and None
        node.undeclare_parameter('typed')
        node.declare_parameter('typed', 'text')
    everything = rclpy.create_node('one', namespace='/robot', context=context,
                                   automatically_declare_parameters_from_overrides=True)
    assert everything.get_parameter('shared').value == 'one'
    node.destroy_node()
    everything.destroy_node()
    context.shutdown()


def test_client_sets_parameters_of_another_node(world):
    server, client_node, events = world.node('server'), world.node('client', 1), []
    server.declare_parameter('gain', 2.0)
    client_node.create_subscription(ParameterEvent, '/parameter_events', events.append, 10)
    client = AsyncParameterClient(client_node, 'server')
    assert client.wait_for_services(timeout_sec=LIMIT)

    def ask(future):
        world.until(future.done)
        return future.result()

    assert 'gain' in ask(client.list_parameters()).result.names
    assert parameter_value_to_python(ask(client.get_parameters(['gain'])).values[0]) == 2.0
    assert list(ask(client.get_parameter_types(['gain'])).types) == [3]
    assert ask(client.describe_parameters(['gain'])).descriptors[0].name == 'gain'
    assert ask(client.set_parameters([Parameter('gain', value=3.0)])).results[0].successful
    refused = ask(client.set_parameters([Parameter('none', value=3.0)])).results[0]
    assert not refused.successful and 'undeclared' in refused.reason
    assert len(ask(client.get_parameters(['none'])).values) == 0
    assert server.get_parameter('gain').value == 3.0
    world.until(lambda: any(one.name == 'gain' for event in events
                            for one in event.changed_parameters))
    assert events[-1].node == '/server'


@pytest.mark.parametrize('text, value', [
    ('1', 1), ('1.5', 1.5), ('true', True), ('abc', 'abc'), ('[1, 2]', [1, 2]),
    ('[a, b]', ['a', 'b']), ('', ''), ('[1, a]', '[1, a]')])
def test_typed_text_becomes_a_parameter_value(text, value):
    assert parameter_value_to_python(get_parameter_value(text)) == value


# --- the graph ----------------------------------------------------------------------------------

def test_graph_shows_nodes_topics_and_services(world):
    here, there = world.node('here', namespace='/a'), world.node('there', 1)
    here.create_publisher(String, 'chatter', QoSProfile(
        depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    there.create_subscription(String, '/a/chatter', lambda message: None, 10)
    here.create_service(Trigger, 'ask', lambda request, response: response)
    there.create_client(Trigger, '/a/ask')
    for node in (here, there):
        world.until(lambda node=node: {('here', '/a'), ('there', '/')} <= set(
            node.get_node_names_and_namespaces()))
        world.until(lambda node=node: node.count_publishers('/a/chatter') == 1
                    and node.count_subscribers('/a/chatter') == 1
                    and node.count_services('/a/ask') == 1
                    and node.count_clients('/a/ask') == 1)
        assert ('/a/chatter', ['std_msgs/msg/String']) in node.get_topic_names_and_types()
        assert ('/a/ask', ['std_srvs/srv/Trigger']) in node.get_service_names_and_types()
        assert '/a/here' in node.get_fully_qualified_node_names()
        assert ('/a/chatter', ['std_msgs/msg/String']) in \
            node.get_publisher_names_and_types_by_node('here', '/a')
        assert ('/a/chatter', ['std_msgs/msg/String']) in \
            node.get_subscriber_names_and_types_by_node('there', '/')
        assert ('/a/ask', ['std_srvs/srv/Trigger']) in \
            node.get_service_names_and_types_by_node('here', '/a')
        # each endpoint of a client is discovered by itself
        world.until(lambda node=node: ('/a/ask', ['std_srvs/srv/Trigger'])
                    in node.get_client_names_and_types_by_node('there', '/'))
        with pytest.raises(NodeNameNonExistentError):
            node.get_publisher_names_and_types_by_node('nobody', '/')
    info = there.get_publishers_info_by_topic('/a/chatter')[0]
    assert (info.node_name, info.node_namespace) == ('here', '/a')
    assert info.topic_type == 'std_msgs/msg/String'
    assert info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert str(info.topic_type_hash) == \
        'RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18'
    assert here.get_subscriptions_info_by_topic('/a/chatter')[0].node_name == 'there'
    here.destroy_node()
    world.until(lambda: ('here', '/a') not in there.get_node_names_and_namespaces()
                and there.count_publishers('/a/chatter') == 0)


def test_log_messages_are_published_on_rosout(world):
    talker, reader, got = world.node('talker'), world.node('reader', 1), []
    reader.create_subscription(Log, '/rosout', got.append, QoSProfile(
        depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    talker.get_logger().warning('careful')
    talker.get_logger().get_child('arm').info('moving')
    world.until(lambda: {one.msg for one in got} >= {'careful', 'moving'})
    found = {one.msg: one for one in got}
    assert found['careful'].level == Log.WARN and found['careful'].name == 'talker'
    assert found['moving'].name == 'talker.arm' and found['careful'].stamp.sec > 0
    assert found['careful'].file.endswith('test_rclpy_graph.py')
    assert found['careful'].function == 'test_log_messages_are_published_on_rosout'


# --- lifecycle ----------------------------------------------------------------------------------

class Managed(LifecycleNode):
    """Fails on request."""

    def __init__(self, name, **kwargs):
        super().__init__(name, **kwargs)
        self.answers = {}

    def on_configure(self, state):
        self.before = state
        answer = self.answers.get('configure', TransitionCallbackReturn.SUCCESS)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def on_error(self, state):
        return self.answers.get('error', TransitionCallbackReturn.SUCCESS)


def test_service_calls_change_the_lifecycle_state(world):
    node, caller, events, got = world.node('managed', kind=Managed), world.node('c', 1), [], []
    publisher = node.create_lifecycle_publisher(String, 'out', 10)
    caller.create_subscription(String, 'out', got.append, 10)
    caller.create_subscription(TransitionEvent, 'managed/transition_event', events.append, 10)
    change = caller.create_client(ChangeState, 'managed/change_state')
    state = caller.create_client(GetState, 'managed/get_state')
    available = caller.create_client(
        GetAvailableTransitions, 'managed/get_available_transitions')

    def to(transition):
        return world.call(change, ChangeState.Request(transition=Transition(id=transition)))

    def now():
        return world.call(state, GetState.Request()).current_state

    assert (now().id, now().label) == (State.PRIMARY_STATE_UNCONFIGURED, 'unconfigured')
    labels = [one.transition.label for one in world.call(
        available, GetAvailableTransitions.Request()).available_transitions]
    assert labels == ['configure', 'shutdown']
    assert to(Transition.TRANSITION_CONFIGURE).success and now().label == 'inactive'
    assert node.before.label == 'unconfigured'
    world.until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(String(data='hidden'))
    assert to(Transition.TRANSITION_ACTIVATE).success and now().label == 'active'
    publisher.publish(String(data='shown'))
    world.until(lambda: got)
    assert [one.data for one in got] == ['shown']
    assert world.call(change, ChangeState.Request(
        transition=Transition(label='deactivate'))).success
    assert to(Transition.TRANSITION_CLEANUP).success and now().label == 'unconfigured'
    assert not world.call(change, ChangeState.Request(
        transition=Transition(label='activate'))).success
    assert to(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN).success and now().label == 'finalized'
    world.until(lambda: events and events[-1].goal_state.label == 'finalized')


def test_failing_transition_is_reported(world):
    node = world.node('managed', kind=Managed)
    node.answers['configure'] = TransitionCallbackReturn.FAILURE
    assert node.trigger_configure() == TransitionCallbackReturn.FAILURE
    node.answers['configure'] = ArithmeticError('on purpose')
    assert node.trigger_configure() == TransitionCallbackReturn.ERROR
    node.answers['configure'] = TransitionCallbackReturn.SUCCESS
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    with pytest.raises(RuntimeError):
        node.trigger_configure()
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_shutdown() == TransitionCallbackReturn.SUCCESS
    with pytest.raises(RuntimeError):
        node.trigger_shutdown()

# SPDX-License-Identifier: Apache-2.0
"""Contexts, nodes, topics, services, timers, clocks."""

import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import threading
import time

from builtin_interfaces.msg import Time as TimeMessage
from example_interfaces.srv import AddTwoInts
import pytest
import rclpy
from rclpy.clock import Clock, ROSClock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.duration import Duration, Infinite
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidServiceNameException,
    InvalidTopicNameException,
    NotInitializedException,
)
from rclpy.executors import (
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    InvalidQoSProfileException,
    LivelinessPolicy,
    qos_check_compatible,
    qos_profile_sensor_data,
    QoSCompatibility,
    QoSPresetProfiles,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import String
from std_srvs.srv import Trigger

LIMIT = 10.0  # seconds until something that should happen hasn't


@pytest.fixture
def context():
    made = Context()
    made.init(args=[])
    yield made
    made.try_shutdown()


class World:
    """Nodes of one context and an executor, and waiting for what they do."""

    def __init__(self, context):
        self.context = context
        self.executor = SingleThreadedExecutor(context=context)
        self.nodes = []

    def node(self, name='node', **kwargs):
        node = rclpy.create_node(name, context=self.context, **kwargs)
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def until(self, condition, limit=LIMIT):
        end = time.monotonic() + limit
        while not condition():
            assert time.monotonic() < end, 'it did not happen'
            self.executor.spin_once(timeout_sec=0.05)

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.01)

    def close(self):
        for node in self.nodes:
            node.destroy_node()
        self.executor.shutdown()


@pytest.fixture
def world(context):
    made = World(context)
    yield made
    made.close()


# --- contexts -----------------------------------------------------------------------------------

def test_context_is_initialized_and_shut_down_once():
    context = Context()
    assert not context.ok()
    with pytest.raises(NotInitializedException):
        rclpy.create_node('early', context=context)
    rclpy.init(context=context, args=[])
    assert context.ok() and rclpy.ok(context=context)
    with pytest.raises(RuntimeError):
        rclpy.init(context=context, args=[])
    called = []
    context.on_shutdown(lambda: called.append(True))
    rclpy.shutdown(context=context)
    assert called and not context.ok()
    with pytest.raises(RuntimeError):
        rclpy.shutdown(context=context)
    rclpy.try_shutdown(context=context)


def test_invalid_domain_id_is_refused():
    context = Context()
    rclpy.init(context=context, args=[], domain_id=7)
    assert context.get_domain_id() == 7
    context.shutdown()
    for wrong in (-1, 100000):
        with pytest.raises(RuntimeError):
            context = Context()
            context.init(args=[], domain_id=wrong)
            rclpy.create_node('nowhere', context=context)


@pytest.mark.parametrize('args', [
    ['--ros-args', '-r'], ['--ros-args', '-r', 'no_rule'], ['--ros-args', '-p', 'x'],
    ['--ros-args', '--log-level', 'loud'], ['--ros-args', '--params-file', '/no/such/file'],
    ['--ros-args', '-r', 'a:=b c'], ['--ros-args', '-r', '1a:=b'], ['--ros-args', '-r', 'a:='],
    ['--ros-args', '-p', 'x:={y: 1}'], ['--ros-args', '-p', 'x:=[1, y]'],
    ['--ros-args', '--what']])
def test_invalid_ros_arguments_are_refused(args):
    with pytest.raises(RuntimeError):
        Context().init(args=args)


def test_ros_arguments_are_removed_from_a_command_line():
    from rclpy.utilities import remove_ros_args
    assert remove_ros_args(['me', '--x', '--ros-args', '-r', 'a:=b', '--', 'y']) == \
        ['me', '--x', 'y']


# --- names --------------------------------------------------------------------------------------

def test_node_has_a_valid_name_and_namespace(world):
    node = world.node('one', namespace='/robot')
    assert (node.get_name(), node.get_namespace()) == ('one', '/robot')
    assert node.get_fully_qualified_name() == '/robot/one'
    assert node.get_logger().name == 'robot.one'
    assert world.node('two', namespace='arm').get_namespace() == '/arm'
    for name in ('', 'a b', '1a', 'a/b'):
        with pytest.raises(InvalidNodeNameException):
            world.node(name)
    for namespace in ('/a//b', '/a b', '/1'):
        with pytest.raises(InvalidNamespaceException):
            world.node('three', namespace=namespace)


def test_topic_name_is_resolved_or_refused(world):
    node = world.node('me', namespace='/here')
    assert node.resolve_topic_name('chatter') == '/here/chatter'
    assert node.resolve_topic_name('/chatter') == '/chatter'
    assert node.resolve_topic_name('~/chatter') == '/here/me/chatter'
    assert node.resolve_topic_name('{node}/chatter') == '/here/me/chatter'
    for name in ('', 'a b', '1a', 'a~', 'a{', 'a/'):
        with pytest.raises(InvalidTopicNameException):
            node.create_publisher(String, name, 1)
    with pytest.raises(InvalidServiceNameException):
        node.create_client(Trigger, 'a b')
    for name in ('a b', '{nothing}', '~tail'):
        with pytest.raises(RuntimeError, match='failed to resolve name'):
            node.resolve_topic_name(name)
    with pytest.raises(ValueError, match="topic name 'a b' is invalid"):
        node.count_publishers('a b')


def test_names_are_remapped_by_arguments(context):
    made = Context()
    made.init(args=['--ros-args', '-r', '__node:=new', '-r', '__ns:=/space', '-r',
                    'chatter:=talk', '-r', 'new:only:=/mine', '-r', 'other:only:=/theirs',
                    '-r', 'rosservice://ask:=question'])
    node = rclpy.create_node('old', context=made)
    assert node.get_fully_qualified_name() == '/space/new'
    assert node.resolve_topic_name('chatter') == '/space/talk'
    assert node.resolve_topic_name('/space/chatter') == '/space/talk'
    assert node.resolve_topic_name('chatter', only_expand=True) == '/space/chatter'
    assert node.resolve_topic_name('only') == '/mine'
    assert node.resolve_topic_name('ask') == '/space/ask'
    assert node.resolve_service_name('ask') == '/space/question'
    assert node.create_publisher(String, 'chatter', 1).topic_name == '/space/talk'
    local = rclpy.create_node('local', context=made, use_global_arguments=False,
                              cli_args=['--ros-args', '-r', 'a:=b'])
    assert local.get_fully_qualified_name() == '/local'
    assert local.resolve_topic_name('a') == '/b'
    node.destroy_node()
    local.destroy_node()
    made.shutdown()


# --- topics -------------------------------------------------------------------------------------

def test_subscription_receives_messages_in_order(world):
    node, got = world.node(), []
    publisher = node.create_publisher(String, 'chatter', 10)
    subscription = node.create_subscription(String, 'chatter', got.append, 10)
    world.until(lambda: publisher.get_subscription_count() == 1)
    assert subscription.get_publisher_count() == 1 or world.until(
        lambda: subscription.get_publisher_count() == 1) is None
    for number in range(5):
        publisher.publish(String(data=str(number)))
    world.until(lambda: len(got) == 5)
    assert [message.data for message in got] == list('01234')
    with pytest.raises(TypeError):
        publisher.publish('text')
    assert publisher.wait_for_all_acked(Duration(seconds=5))
    assert node.destroy_publisher(publisher) and not node.destroy_publisher(publisher)
    with pytest.raises(Exception, match='.'):
        publisher.publish(String())


def test_subscription_receives_raw_bytes_and_timestamps(world):
    node, raw, info = world.node(), [], []
    publisher = node.create_publisher(String, 'chatter', 10)
    node.create_subscription(String, 'chatter', raw.append, 10, raw=True)
    node.create_subscription(String, 'chatter', lambda message, about: info.append(about), 10)
    world.until(lambda: publisher.get_subscription_count() == 2)
    before = time.time_ns()
    publisher.publish(String(data='x'))
    world.until(lambda: raw and info)
    assert isinstance(raw[0], bytes) and b'x\0' in raw[0]
    assert before <= info[0]['source_timestamp'] <= info[0]['received_timestamp']
    publisher.publish(raw[0])
    world.until(lambda: len(raw) == 2)
    assert raw[0] == raw[1]
    with pytest.raises(RuntimeError):
        node.create_subscription(String, 'chatter', lambda: None, 10)


def test_late_subscription_receives_transient_local_messages(world):
    node, got, volatile = world.node(), [], []
    latched = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(String, 'map', latched)
    for number in range(4):
        publisher.publish(String(data=str(number)))
    node.create_subscription(String, 'map', got.append, latched)
    node.create_subscription(String, 'map', volatile.append, 10)
    world.until(lambda: len(got) == 2)
    assert [message.data for message in got] == ['2', '3']
    world.spin(0.1)
    assert not volatile


def test_incompatible_quality_of_service_is_reported(world, capfd):
    node, offered, requested, got = world.node('worrier'), [], [], []
    publisher = node.create_publisher(
        String, 'x', qos_profile_sensor_data,
        event_callbacks=PublisherEventCallbacks(incompatible_qos=offered.append))
    node.create_subscription(
        String, 'x', got.append, 10,
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=requested.append))
    world.until(lambda: offered and requested)
    assert offered[0].total_count == requested[0].total_count == 1
    assert requested[0].last_policy_kind == 16  # reliability
    assert publisher.get_subscription_count() == 0
    node.create_subscription(String, 'x', got.append, 10)
    heard = []
    world.until(lambda: heard.append(capfd.readouterr().err) or any(
        "New publisher discovered on topic 'x', offering incompatible QoS. No messages will be "
        'received from it. Last incompatible policy: RELIABILITY' in text for text in heard))


def test_matches_and_missed_deadlines_are_reported(world):
    node, matched, missed = world.node(), [], []
    profile = QoSProfile(depth=1, deadline=Duration(nanoseconds=50_000_000))
    publisher = node.create_publisher(String, 'x', profile)
    subscription = node.create_subscription(
        String, 'x', lambda message: None, profile, event_callbacks=SubscriptionEventCallbacks(
            matched=matched.append, deadline=missed.append))
    world.until(lambda: matched)
    assert (matched[0].current_count, matched[0].total_count) == (1, 1)
    publisher.publish(String())
    world.until(lambda: missed)
    assert missed[0].total_count >= 1
    node.destroy_subscription(subscription)


def test_quality_of_service_profile_is_checked():
    assert QoSProfile(depth=3).history == HistoryPolicy.KEEP_LAST
    assert QoSProfile(depth=3).reliability == ReliabilityPolicy.RELIABLE
    assert QoSProfile(depth=3) == QoSProfile(depth=3) != QoSProfile(depth=4)
    for wrong in ({}, {'history': HistoryPolicy.KEEP_LAST}):
        with pytest.raises(InvalidQoSProfileException):
            QoSProfile(**wrong)
    with pytest.raises(AssertionError):
        QoSProfile(depth=1, deep=2)
    with pytest.raises(AssertionError):
        QoSProfile(depth='1')
    sensor = QoSPresetProfiles.get_from_short_key('sensor_data')
    assert sensor.reliability == ReliabilityPolicy.BEST_EFFORT and sensor.depth == 5
    assert ReliabilityPolicy.get_from_short_key('best_effort') == ReliabilityPolicy.BEST_EFFORT
    assert DurabilityPolicy.VOLATILE.short_key == 'volatile'
    strict = QoSProfile(depth=1)
    assert qos_check_compatible(sensor, strict)[0] == QoSCompatibility.ERROR
    assert qos_check_compatible(strict, sensor)[0] != QoSCompatibility.ERROR


def test_incompatible_profiles_are_explained():
    def said(publisher, subscription):
        return qos_check_compatible(QoSProfile(depth=1, **publisher),
                                    QoSProfile(depth=1, **subscription))

    automatic, second = {'liveliness': LivelinessPolicy.AUTOMATIC}, Duration(seconds=1)
    assert said(automatic, automatic) == (QoSCompatibility.OK, '')
    assert said({}, {}) == (
        QoSCompatibility.WARNING, 'WARNING: Publisher liveliness is system_default and '
        'subscription liveliness is system_default;')
    assert said({'reliability': ReliabilityPolicy.BEST_EFFORT}, {'deadline': second}) == (
        QoSCompatibility.ERROR, 'ERROR: Best effort publisher and reliable subscription;'
        'ERROR: Subscription has a deadline, but publisher does not;')
    assert said({'liveliness_lease_duration': Duration(seconds=2)},
                {'liveliness_lease_duration': second}) == (
        QoSCompatibility.ERROR,
        'ERROR: Subscription liveliness lease duration is less than publisher;')
    assert said({'reliability': ReliabilityPolicy.SYSTEM_DEFAULT, **automatic},
                {'durability': DurabilityPolicy.SYSTEM_DEFAULT, **automatic}) == (
        QoSCompatibility.WARNING, 'WARNING: Reliable subscription, but publisher is '
        'system_default;WARNING: Volatile publisher, but subscription is system_default;')


def test_wrong_interface_class_is_refused(world):
    node = world.node()
    for wrong in (int, Trigger):
        with pytest.raises(Exception, match='.'):
            node.create_publisher(wrong, 'x', 1)
    with pytest.raises(Exception, match='.'):
        node.create_service(String, 'x', lambda request, response: response)
    with pytest.raises(TypeError):
        node.create_publisher(String, 'x', 'many')
    with pytest.raises(ValueError):
        node.create_publisher(String, 'x', -1)


# --- services -----------------------------------------------------------------------------------

def add(request, response):
    response.sum = request.a + request.b
    return response


def test_client_calls_a_service(world):
    server, caller = world.node('server'), world.node('caller')
    service = server.create_service(AddTwoInts, 'add', add)
    client = caller.create_client(AddTwoInts, 'add')
    assert client.wait_for_service(timeout_sec=LIMIT)
    futures = [client.call_async(AddTwoInts.Request(a=number, b=1)) for number in range(3)]
    world.until(lambda: all(future.done() for future in futures))
    assert [future.result().sum for future in futures] == [1, 2, 3]
    assert service.service_name == client.service_name == '/add'
    with pytest.raises(TypeError):
        client.call_async(AddTwoInts.Response())
    assert not caller.create_client(Trigger, 'nothing').wait_for_service(timeout_sec=0.05)
    server.destroy_service(service)
    world.until(lambda: not client.service_is_ready())


def test_each_client_gets_its_own_response(world):
    node = world.node()
    node.create_service(AddTwoInts, 'add', add)
    clients = [node.create_client(AddTwoInts, 'add') for _ in range(2)]
    assert all(client.wait_for_service(timeout_sec=LIMIT) for client in clients)
    futures = [client.call_async(AddTwoInts.Request(a=number))
               for number, client in enumerate(clients)]
    world.until(lambda: all(future.done() for future in futures))
    assert [future.result().sum for future in futures] == [0, 1]


def test_synchronous_call_returns_the_response(world):
    server, caller = world.node('server'), world.node('caller')
    server.create_service(AddTwoInts, 'add', add)
    client = caller.create_client(AddTwoInts, 'add')
    assert client.wait_for_service(timeout_sec=LIMIT)
    thread = threading.Thread(target=world.executor.spin, daemon=True)
    thread.start()
    assert client.call(AddTwoInts.Request(a=2, b=3), timeout_sec=LIMIT).sum == 5
    world.executor.shutdown()
    thread.join(LIMIT)
    assert not thread.is_alive()


def test_service_callback_awaits_another_service(world):
    node = world.node()
    from rclpy.callback_groups import ReentrantCallbackGroup
    group = ReentrantCallbackGroup()
    node.create_service(AddTwoInts, 'add', add, callback_group=group)
    inner = node.create_client(AddTwoInts, 'add', callback_group=group)

    async def ask(request, response):
        found = await inner.call_async(AddTwoInts.Request(a=20, b=22))
        response.success, response.message = True, str(found.sum)
        return response

    node.create_service(Trigger, 'ask', ask, callback_group=group)
    outer = node.create_client(Trigger, 'ask', callback_group=group)
    assert outer.wait_for_service(timeout_sec=LIMIT) and inner.wait_for_service(LIMIT)
    future = outer.call_async(Trigger.Request())
    world.until(future.done)
    assert future.result().message == '42'


# --- timers and clocks --------------------------------------------------------------------------

def test_timer_ticks_is_canceled_and_reset(world):
    node, ticks = world.node(), []
    timer = node.create_timer(0.02, lambda: ticks.append(time.monotonic()))
    assert timer.timer_period_ns == 20_000_000 and not timer.is_canceled()
    assert 0 <= timer.time_until_next_call() <= 20_000_000
    world.until(lambda: len(ticks) == 6)
    assert 0.08 <= ticks[-1] - ticks[0] <= 0.4
    timer.cancel()
    count = len(ticks)
    world.spin(0.1)
    assert len(ticks) == count and timer.is_canceled()
    assert timer.time_until_next_call() is None
    timer.reset()
    world.until(lambda: len(ticks) > count)
    with pytest.raises(RuntimeError, match='timer period must be non-negative'):
        node.create_timer(-1.0, None)
    waiting = node.create_timer(0.01, lambda: ticks.append(0.0), autostart=False)
    world.spin(0.05)
    assert 0.0 not in ticks
    waiting.reset()
    world.until(lambda: 0.0 in ticks)
    assert node.destroy_timer(timer) and not node.destroy_timer(timer)


def test_timer_skips_missed_ticks(world):
    node, ticks = world.node(), []
    node.create_timer(0.02, lambda: ticks.append(1))
    time.sleep(0.2)
    world.spin(0.05)
    assert 1 <= len(ticks) <= 6


def test_durations_and_times_are_calculated():
    assert Duration(seconds=1.5, nanoseconds=1).nanoseconds == 1_500_000_001
    assert Duration(seconds=1) < Duration(seconds=2) and Infinite > Duration(seconds=2)
    assert Duration(seconds=-1).to_msg().sec == -1
    assert Duration.from_msg(Duration(seconds=2.5).to_msg()) == Duration(seconds=2.5)
    with pytest.raises(OverflowError):
        Duration(nanoseconds=2 ** 63)
    time_ = Time(seconds=3, nanoseconds=7)
    assert time_.seconds_nanoseconds() == (3, 7)
    assert (time_ + Duration(seconds=1)).nanoseconds == 4_000_000_007
    assert time_ - Time(seconds=1, nanoseconds=7) == Duration(seconds=2)
    assert Time.from_msg(TimeMessage(sec=1, nanosec=2)).clock_type == ClockType.ROS_TIME
    with pytest.raises(TypeError):
        time_ < Time(clock_type=ClockType.ROS_TIME)  # noqa: B015
    with pytest.raises(ValueError):
        Time(seconds=-1)


@contextlib.contextmanager
def repeated(call, values):
    """Call with a value every 50 ms during the block: the first may come before anybody sleeps."""
    awake = threading.Event()

    def work():
        for value in values:
            if awake.wait(0.05):
                return
            call(value)

    threading.Thread(target=work).start()
    try:
        yield
    finally:
        awake.set()


def test_clock_sleeps_in_steady_and_simulated_time(context):
    assert isinstance(Clock(clock_type=ClockType.ROS_TIME), ROSClock)
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    before = steady.now()
    assert steady.sleep_for(Duration(seconds=0.02), context)
    assert steady.now() - before >= Duration(seconds=0.02)
    simulated = ROSClock()
    simulated._set_ros_time_is_active(True)
    simulated.set_ros_time_override(Time(seconds=5, clock_type=ClockType.ROS_TIME))
    assert simulated.now().nanoseconds == 5_000_000_000
    times = [Time(seconds=number, clock_type=ClockType.ROS_TIME) for number in range(6, 606)]
    with repeated(simulated.set_ros_time_override, times):
        assert simulated.sleep_until(times[0], context)
    with repeated(simulated._set_ros_time_is_active, 300 * (False, True)):
        assert not simulated.sleep_for(Duration(seconds=60), context)


def test_simulated_clock_drives_time_and_timers(world):
    from rclpy.parameter import Parameter
    node, ticks = world.node(parameter_overrides=[Parameter('use_sim_time', value=True)]), []
    clock = world.node('simulator').create_publisher(ClockMessage, '/clock', 10)
    world.until(lambda: clock.get_subscription_count() == 1)
    assert node.get_clock().now().nanoseconds == 0
    timer = node.create_timer(1.0, lambda: ticks.append(node.get_clock().now().nanoseconds))

    def tick(seconds):
        def reached():
            clock.publish(ClockMessage(clock=TimeMessage(sec=seconds)))
            return node.get_clock().now().nanoseconds == seconds * 10 ** 9
        world.until(reached)

    tick(10)
    world.spin(0.05)
    count = len(ticks)
    world.spin(0.05)
    assert len(ticks) == count
    tick(12)
    world.until(lambda: len(ticks) == count + 1)
    timer.cancel()


def test_rate_sleeps_for_its_period(context):
    node = rclpy.create_node('slow', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    rate = node.create_rate(50.0)
    before = time.monotonic()
    for _ in range(5):
        rate.sleep()
    assert 0.06 <= time.monotonic() - before <= 1.0
    node.destroy_rate(rate)
    executor.shutdown()
    thread.join(LIMIT)
    node.destroy_node()


# --- executors ----------------------------------------------------------------------------------

def test_spin_once_runs_one_callback(world):
    node, called = world.node(), []
    timers = [node.create_timer(0.01, lambda: called.append(True)) for _ in range(2)]
    time.sleep(0.02)
    world.executor.spin_once(timeout_sec=LIMIT)
    assert len(called) <= 1
    before = time.monotonic()
    world.until(lambda: len(called) == 2)
    assert time.monotonic() - before < LIMIT
    for timer in timers:
        timer.cancel()


def test_spin_raises_the_exception_of_a_callback(world):
    node = world.node()

    def fail():
        raise ArithmeticError('on purpose')

    node.create_timer(0.01, fail)
    with pytest.raises(ArithmeticError, match='on purpose'):
        world.until(lambda: False)


def test_executor_runs_coroutines_that_await_futures(world):
    world.node()
    future, steps = rclpy.task.Future(), []

    async def wait():
        steps.append('before')
        steps.append(await future)
        return 'result'

    task = world.executor.create_task(wait)
    world.until(lambda: steps)
    assert steps == ['before'] and not task.done()
    future.set_result('after')
    world.until(task.done)
    assert steps == ['before', 'after'] and task.result() == 'result'
    failing = world.executor.create_task(lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        world.until(failing.done)
    called = []
    other = rclpy.task.Future()
    other.add_done_callback(lambda one: called.append(one.result()))
    other.set_result(3)
    assert called == [3] and other.done() and not other.cancelled()


def test_spin_until_future_complete_ends_in_time(world):
    node = world.node()
    future = rclpy.task.Future()
    before = time.monotonic()
    world.executor.spin_until_future_complete(future, timeout_sec=0.05)
    assert not future.done() and 0.04 <= time.monotonic() - before < 2.0
    node.create_timer(0.02, lambda: future.set_result(1))
    world.executor.spin_until_future_complete(future, timeout_sec=LIMIT)
    assert future.result() == 1


def test_callback_group_decides_what_runs_in_parallel(context):
    from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
    for group, together in ((ReentrantCallbackGroup(), 2), (MutuallyExclusiveCallbackGroup(), 1)):
        node = rclpy.create_node('busy', context=context)
        executor = MultiThreadedExecutor(num_threads=3, context=context)
        executor.add_node(node)
        lock, now, most, calls = threading.Lock(), [0], [0], [0]

        def work(lock=lock, now=now, most=most, calls=calls):
            with lock:
                now[0] += 1
                calls[0] += 1
                most[0] = max(most[0], now[0])
            time.sleep(0.03)
            with lock:
                now[0] -= 1

        for _ in range(2):
            node.create_timer(0.01, work, callback_group=group)
        end = time.monotonic() + LIMIT
        while calls[0] < 8 and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
        executor.shutdown()
        node.destroy_node()
        assert most[0] >= together if together == 2 else most[0] == 1


def test_custom_callback_group_delays_a_callback(world):
    from rclpy.callback_groups import CallbackGroup

    class Tokens(CallbackGroup):
        left = 1

        def can_execute(self, entity):
            return self.left > 0

        def beginning_execution(self, entity):
            self.left -= 1
            return self.left >= 0

        def ending_execution(self, entity):
            pass

    node, group, calls = world.node(), Tokens(), []
    node.create_timer(0.01, lambda: calls.append(1), callback_group=group)
    node.create_timer(0.1, lambda: setattr(group, 'left', 1))
    world.until(lambda: len(calls) == 3)


def test_node_belongs_to_one_executor(world):
    node = world.node()
    assert node.executor is world.executor and not world.executor.add_node(node)
    other = SingleThreadedExecutor(context=world.context)
    assert other.add_node(node)
    assert node.executor is other and node not in world.executor.get_nodes()
    other.remove_node(node)
    assert other.get_nodes() == []
    other.shutdown()


def test_shutdown_ends_spin(context):
    node = rclpy.create_node('still', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    ended = []

    def spin():
        try:
            executor.spin()
        except ExternalShutdownException:
            pass
        ended.append(True)

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    node.create_timer(0.05, context.try_shutdown)
    thread.join(LIMIT)
    assert ended


# --- a process of its own -----------------------------------------------------------------------

PROGRAM = '''
import time
import rclpy
from rclpy.executors import ExternalShutdownException
rclpy.init()
node = rclpy.create_node('sleeper')
log = node.get_logger()
log.info('ready')
for number in range(3):
    log.info('once %d' % number, once=True)
    log.info('not first %d' % number, skip_first=True)
    log.warning('throttled %d' % number, throttle_duration_sec=60.0)
log.debug('hidden')
log.get_child('arm').error('trouble')
node.create_timer(0.02, lambda: log.info('spinning', once=True))
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
except RuntimeError as error:
    # ROS 2 may begin to wait just as the signal shuts it down
    assert 'context is not valid' in str(error)
while rclpy.ok():  # ROS 2 raises KeyboardInterrupt while another thread shuts down
    time.sleep(0.01)
log.fatal('over')
node.destroy_node()
rclpy.try_shutdown()
'''


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_node_logs_and_ends_on_a_signal(number):
    process = subprocess.Popen(
        [sys.executable, '-c', PROGRAM], stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
    lines = []
    try:
        for line in process.stderr:
            lines.append(line.rstrip())
            if 'spinning' in line:
                process.send_signal(number)
        assert process.wait(LIMIT) == 0
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
    import re
    shown = [re.sub(r'\[\d{10}\.\d{9}\]', '[T]', line) for line in lines
             if 'sleeper' in line]
    assert shown == [
        '[INFO] [T] [sleeper]: ready', '[INFO] [T] [sleeper]: once 0',
        '[WARN] [T] [sleeper]: throttled 0', '[INFO] [T] [sleeper]: not first 1',
        '[INFO] [T] [sleeper]: not first 2', '[ERROR] [T] [sleeper.arm]: trouble',
        '[INFO] [T] [sleeper]: spinning', '[FATAL] [T] [sleeper]: over']


def test_log_level_is_set_on_the_command_line():
    program = PROGRAM.replace('rclpy.spin(node)', 'raise KeyboardInterrupt').replace(
        'while rclpy.ok()', 'while False')
    done = subprocess.run(
        [sys.executable, '-c', program, '--ros-args', '--log-level', 'sleeper:=debug',
         '--log-level', 'error'], capture_output=True, text=True, timeout=30, check=True,
        env={**os.environ, 'RCUTILS_CONSOLE_OUTPUT_FORMAT': '{severity} {name} {message}'})
    shown = [line for line in done.stderr.splitlines() if 'sleeper' in line]
    assert 'DEBUG sleeper hidden' in shown and 'ERROR sleeper.arm trouble' in shown


LATE = '''
import threading
import rclpy
from rclpy.executors import SingleThreadedExecutor
rclpy.init()
node = rclpy.create_node('late')
threading.kept = SingleThreadedExecutor()  # outlives the modules that were imported after this one
threading.kept.add_node(node)
threading.kept.spin_once(timeout_sec=0)
'''


@pytest.mark.skipif(importlib.util.find_spec('rosidl_embedded') is None,
                    reason="ROS 2's own executors stumble over what is gone by then")
def test_executor_ends_silently_at_interpreter_exit():
    done = subprocess.run([sys.executable, '-c', LATE], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, '')


#: Interrupted once more while it says goodbye.
INTERRUPTED_AT_ITS_END = '''
import os, signal, rclpy
from rclpy import _dds
class Slow:
    def dds_delete(self, handle):
        os.kill(os.getpid(), signal.SIGINT)
        return library.dds_delete(handle)
rclpy.init()
node = rclpy.create_node('interrupted')
library, _dds._lib = _dds._lib, Slow()
'''


@pytest.mark.skipif(importlib.util.find_spec('rosidl_embedded') is None,
                    reason="it is the embedded default's own ending")
def test_interrupt_at_exit_is_no_error():
    done = subprocess.run([sys.executable, '-c', INTERRUPTED_AT_ITS_END], capture_output=True,
                          text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, '')


def test_rclpy_is_imported_within_a_second():
    code = 'import time; t = time.perf_counter(); import rclpy; print(time.perf_counter() - t)'
    times = [float(subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                                  check=True, timeout=30).stdout) for _ in range(5)]
    assert min(times) < 1.0

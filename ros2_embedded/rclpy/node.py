# SPDX-License-Identifier: Apache-2.0
"""Nodes."""

from collections.abc import Callable
import sys
from typing import Any, TypeVar
import weakref

from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent
from rclpy import _arguments, _names, exceptions, logging, qos
from rclpy._dds import Reader, Writer
from rclpy._entity import Entity
from rclpy._graph import Graph, type_hash_data
from rclpy._node_graph import NodeGraph
from rclpy._node_parameters import NodeParameters
from rclpy.callback_groups import (
    CallbackGroup,
    MutuallyExclusiveCallbackGroup,
    ReentrantCallbackGroup,
)
from rclpy.client import Client
from rclpy.clock import Clock, ROSClock
from rclpy.constants import S_TO_NS
from rclpy.context import Context
from rclpy.event_handler import EventHandler, PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import NodeNameNonExistentError, RCLError
from rclpy.executors import Executor
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService
from rclpy.publisher import Publisher
from rclpy.qos import qos_profile_services_default, QoSProfile
from rclpy.service import Service
from rclpy.service_introspection import Introspected
from rclpy.subscription import Subscription
from rclpy.time_source import TimeSource
from rclpy.timer import Rate, Timer
from rclpy.type_support import check_is_valid_msg_type, check_is_valid_srv_type
from rclpy.utilities import get_default_context
from rosidl_embedded.lacking import lacking, NotEmbeddedError

__all__ = ['HIDDEN_NODE_PREFIX', 'Node', 'NodeNameNonExistentError']

HIDDEN_NODE_PREFIX = '_'
_T = TypeVar('_T', bound=Entity)
_lacking = lacking('rclpy.node.Node', 'create_guard_condition destroy_guard_condition guards '
                   'describe_parameters get_parameter_types handle set_descriptor', AttributeError)


class Node(NodeParameters, NodeGraph):
    """
    A node: what publishes, subscribes, serves and calls under one name.

    :param node_name: its name, which ``__node:=`` may replace.
    :param context: by default the one that ``rclpy.init()`` initializes.
    :param cli_args: a command line of its own.
    :param namespace: its namespace, which ``__ns:=`` may replace.
    :param use_global_arguments: whether the process's command line holds for it.
    :param enable_rosout: whether its messages go to /rosout.
    :param start_parameter_services: whether others may read and set its parameters.
    :param parameter_overrides: values that go before declared defaults.
    :param allow_undeclared_parameters: whether parameters need no declaration.
    :param automatically_declare_parameters_from_overrides: declare what has a value.
    :param enable_logger_service: whether others may read and set its loggers' levels.
    :raises NotInitializedException: without ``rclpy.init()``.
    :raises NameValidationException: if its name or namespace is invalid.
    """

    def __init__(self, node_name: str, *, context: Context | None = None,
                 cli_args: list[str] | None = None, namespace: str | None = None,
                 use_global_arguments: bool = True, enable_rosout: bool = True,
                 start_parameter_services: bool = True,
                 parameter_overrides: list[Parameter] | None = None,
                 allow_undeclared_parameters: bool = False,
                 automatically_declare_parameters_from_overrides: bool = False,
                 enable_logger_service: bool = False) -> None:
        self._context = get_default_context() if context is None else context
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._clients: list[Client] = []
        self._services: list[Service] = []
        self._timers: list[Timer] = []
        self._waitables: list[EventHandler] = []
        self._default_callback_group: CallbackGroup = MutuallyExclusiveCallbackGroup()
        self._rate_group = ReentrantCallbackGroup()
        self._executor_reference: weakref.ReferenceType[Executor] | None = None
        self._destroyed = False
        self._init_parameters(allow_undeclared_parameters)
        if not self._context.ok() or self._context._graph is None:
            raise exceptions.NotInitializedException('cannot create node')
        self._graph: Graph = self._context._graph
        own = _arguments.parse(['--ros-args', *(cli_args or [])])
        _arguments.check_known(own)
        self._settings = _arguments.Settings(
            own, self._context._arguments if use_global_arguments else None)
        self._name = self._settings.node_name(node_name)
        space = self._settings.namespace(node_name, namespace or '/')
        self._namespace = space if space.startswith('/') else '/' + space
        _names.validate_node_name(self._name)
        _names.validate_namespace(self._namespace)
        self._logger_name = _names.join(self._namespace, self._name)[1:].replace('/', '.')
        self._logger = logging.get_logger(self._logger_name)
        with self._graph.held():
            self._record = self._graph.add_node(self._namespace, self._name)
            if enable_rosout and self._settings.switch('rosout'):
                self._start_rosout()
            self._parameter_event_publisher: Publisher | None = self.create_publisher(
                ParameterEvent, '/parameter_events', qos.qos_profile_parameter_events)
            self._clock = ROSClock()
            self._start_parameters(parameter_overrides,
                                   automatically_declare_parameters_from_overrides)
            if start_parameter_services:
                self._parameter_service = ParameterService(self)
            if enable_logger_service:
                from rclpy.logging_service import LoggingService
                self._logger_service = LoggingService(self)

    def _start_rosout(self) -> None:
        from rcl_interfaces.msg import Log
        publisher = self.create_publisher(Log, '/rosout', qos.qos_profile_rosout_default)
        reference = weakref.ref(publisher)

        def publish(stamp: int, severity: int, name: str, message: str, file: str,
                    function: str, line: int) -> None:
            target = reference()
            if target is None or not self_context.ok() or target._destroyed:
                return
            log = Log(level=int(severity), name=name, msg=message, file=file,
                      function=function, line=line)
            log.stamp.sec, log.stamp.nanosec = divmod(stamp, S_TO_NS)
            try:
                target.publish(log)
            except RCLError:
                if self_context.ok():
                    raise
                # a signal came in between: the message went to the console only

        self_context = self._context
        self._rosout = publish
        logging._rosout[self._logger_name] = publish

    def _start_parameters(self, given: list[Parameter] | None, declare_all: bool) -> None:
        values = self._settings.parameters(self.get_fully_qualified_name())
        self._parameter_overrides = {
            name: Parameter(name, value=value) for name, value in values.items()}
        self._parameter_overrides.update({one.name: one for one in given or []})
        if declare_all:
            self.declare_parameters(
                '', [(one.name, one.value, ParameterDescriptor())
                     for one in self._parameter_overrides.values()], ignore_override=True)
        self._time_source = TimeSource(self, self._clock)

    def _publish_parameter_event(self, event: Any) -> None:
        if self._parameter_event_publisher is not None:
            event.node = self.get_fully_qualified_name()
            event.stamp = self._clock.now().to_msg()
            self._parameter_event_publisher.publish(event)

    # --- what it has ---

    publishers = property(lambda self: iter(self._publishers), doc='Its publishers.')
    subscriptions = property(lambda self: iter(self._subscriptions), doc='Its subscriptions.')
    clients = property(lambda self: iter(self._clients), doc='Its clients.')
    services = property(lambda self: iter(self._services), doc='Its services.')
    timers = property(lambda self: iter(self._timers), doc='Its timers.')
    context = property(lambda self: self._context, doc='Its context.')
    default_callback_group = property(
        lambda self: self._default_callback_group, doc='For what is created without a group.')
    waitables = property(lambda self: iter(self._waitables), doc='Its handlers of events.')

    def _entities(self) -> list[Entity]:
        """All that an executor waits for, in the order it is executed in."""
        return [*self._waitables, *self._timers, *self._subscriptions, *self._clients,
                *self._services]

    def __getattr__(self, name: str) -> Any:
        return _lacking(name)

    @property
    def executor(self) -> Executor | None:
        """The executor it was added to."""
        return self._executor_reference() if self._executor_reference is not None else None

    @executor.setter
    def executor(self, new_executor: Executor | None) -> None:
        current = self.executor
        if current is new_executor:
            return
        self._executor_reference = None
        if current is not None:
            current.remove_node(self)
        if new_executor is not None:
            self._executor_reference = weakref.ref(new_executor)
            new_executor.add_node(self)

    def _forget_executor(self, executor: Executor) -> None:
        if self.executor is executor:
            self._executor_reference = None

    def _wake_executor(self) -> None:
        executor = self.executor
        if executor is not None:
            executor.wake()

    def get_name(self) -> str:
        """Give its name."""
        return self._name

    def get_namespace(self) -> str:
        """Give its namespace."""
        return self._namespace

    def get_fully_qualified_name(self) -> str:
        """Give its name with its namespace."""
        return _names.join(self._namespace, self._name)

    def get_clock(self) -> Clock:
        """Give its clock, of ROS time."""
        return self._clock

    def get_logger(self) -> RcutilsLogger:
        """Give its logger."""
        return self._logger

    # --- names ---

    def _resolve(self, name: str, only_expand: bool, is_service: bool) -> str:
        _names.validate_topic_name(name, is_service=is_service)
        full = _names.expand(name, self._name, self._namespace)
        if not only_expand:
            full = self._settings.remap(full, self._name, self._namespace,
                                        'rosservice' if is_service else 'rostopic')
        _names.validate_full_topic_name(full, is_service=is_service)
        return full

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """
        Expand and remap a topic's name.

        :raises RCLError: if it is invalid.
        """
        return self._resolved(topic, only_expand, False)

    def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str:
        """
        Expand and remap a service's name.

        :raises RCLError: if it is invalid.
        """
        return self._resolved(service, only_expand, True)

    def _resolved(self, *name: Any) -> str:
        try:
            return self._resolve(*name)
        except (exceptions.NameValidationException, ValueError) as error:
            raise RCLError(f'failed to resolve name: {error}') from error

    # --- creating ---

    def _add(self, things: list[_T], thing: _T) -> _T:
        """Have executors look after something new."""
        if thing.callback_group is not None:
            thing.callback_group.add_entity(thing)
        things.append(thing)
        self._waitables += getattr(thing, 'event_handlers', ())
        self._wake_executor()
        return thing

    def _profile(self, qos_or_depth: QoSProfile | int) -> QoSProfile:
        if isinstance(qos_or_depth, QoSProfile):
            return qos_or_depth
        if not isinstance(qos_or_depth, int):
            raise TypeError(f'Expected QoSProfile or int, but received {type(qos_or_depth)!r}')
        if qos_or_depth < 0:
            raise ValueError('history depth must be greater than or equal to zero')
        return QoSProfile(depth=qos_or_depth)

    def _topic_entity(self, kind: Any, msg_type: Any, topic: str, profile: QoSProfile,
                      options: None) -> Any:
        if options is not None:
            raise NotEmbeddedError('qos_overriding_options')
        check_is_valid_msg_type(msg_type)
        full = self._resolve(topic, False, False)
        name = topic if profile.avoid_ros_namespace_conventions else _names.TOPIC_PREFIX + full
        type_name = msg_type._definition.name
        entity = kind(self._graph.participant, name, _names.dds_type(type_name),
                      profile._policies(type_hash_data(type_name)))
        self._graph.add_endpoints(self._record, entity)
        return entity

    def create_publisher(
            self, msg_type: Any, topic: str, qos_profile: QoSProfile | int, *,
            callback_group: CallbackGroup | None = None,
            event_callbacks: PublisherEventCallbacks | None = None,
            qos_overriding_options: None = None,
            publisher_class: type[Publisher] = Publisher) -> Publisher:
        """
        Create a publisher.

        :param qos_profile: a profile, or how many messages are kept.
        :param callback_group: of its events.
        """
        profile = self._profile(qos_profile)
        writer = self._topic_entity(Writer, msg_type, topic, profile, qos_overriding_options)
        publisher = publisher_class(
            writer, msg_type, topic, profile, event_callbacks or PublisherEventCallbacks(),
            callback_group or self._default_callback_group, self._context, self._logger_name)
        return self._add(self._publishers, publisher)

    def create_subscription(
            self, msg_type: Any, topic: str, callback: Callable[..., Any],
            qos_profile: QoSProfile | int, *, callback_group: CallbackGroup | None = None,
            event_callbacks: SubscriptionEventCallbacks | None = None,
            qos_overriding_options: None = None,
            raw: bool = False) -> Subscription:
        """
        Create a subscription.

        :param callback: called with each message, or with it and a dictionary of its times.
        :param qos_profile: a profile, or how many messages are kept.
        :param raw: give the callback bytes, not messages.
        """
        group = callback_group or self._default_callback_group
        profile = self._profile(qos_profile)
        reader = self._topic_entity(Reader, msg_type, topic, profile, qos_overriding_options)
        try:
            subscription = Subscription(
                reader, msg_type, topic, callback, group, profile, raw,
                event_callbacks or SubscriptionEventCallbacks(), self._logger_name)
        except RuntimeError:
            self._graph.remove_endpoints(self._record, reader)
            reader.close()
            raise
        return self._add(self._subscriptions, subscription)

    def _service_entity(self, srv_type: Any, name: str, profile: QoSProfile,
                        serves: bool) -> tuple[Reader, Writer]:
        check_is_valid_srv_type(srv_type)
        full = self._resolve(name, False, True)
        topics = {'Request': f'{_names.REQUEST_PREFIX}{full}Request',
                  'Response': f'{_names.RESPONSE_PREFIX}{full}Reply'}
        identity = f"{'serviceid' if serves else 'clientid'}={self._graph.service_id()};".encode()
        reads, writes = ('Request', 'Response') if serves else ('Response', 'Request')
        made: list[Any] = []
        for kind, part in ((Reader, reads), (Writer, writes)):
            type_name = f'{srv_type._service}_{part}'
            made.append(kind(self._graph.participant, topics[part], _names.dds_type(type_name),
                             profile._policies(identity + type_hash_data(type_name))))
        self._graph.add_endpoints(self._record, *made)
        return made[0], made[1]

    def _event_writer(self, of: Introspected, profile: QoSProfile) -> Writer:
        topic = self.resolve_service_name(of.srv_name) + '/_service_event'
        writer: Writer = self._topic_entity(Writer, of.srv_type.Event, topic, profile, None)
        return writer

    def create_client(self, srv_type: Any, srv_name: str, *,
                      qos_profile: QoSProfile = qos_profile_services_default,
                      callback_group: CallbackGroup | None = None) -> Client:
        """Create a client of a service."""
        group = callback_group or self._default_callback_group
        client = Client(
            self._context, self._service_entity(srv_type, srv_name, qos_profile, False),
            srv_type, srv_name, qos_profile, group, self._logger_name)
        client._node = weakref.ref(self)
        return self._add(self._clients, client)

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any],
                       *, qos_profile: QoSProfile = qos_profile_services_default,
                       callback_group: CallbackGroup | None = None) -> Service:
        """
        Create a service.

        :param callback: called with request and response; gives the response.
        """
        group = callback_group or self._default_callback_group
        service = Service(
            self._service_entity(srv_type, srv_name, qos_profile, True), srv_type, srv_name,
            callback, group, qos_profile, self._logger_name)
        service._node = weakref.ref(self)
        return self._add(self._services, service)

    def create_timer(self, timer_period_sec: float, callback: Callable[..., Any] | None,
                     callback_group: CallbackGroup | None = None, clock: Clock | None = None,
                     autostart: bool = True) -> Timer:
        """
        Create a timer.

        :param timer_period_sec: its period in seconds.
        :param clock: by default the node's.
        :param autostart: False: it starts at :meth:`.Timer.reset`.
        """
        group = callback_group or self._default_callback_group
        timer = Timer(callback, group, int(float(timer_period_sec) * S_TO_NS),
                      clock or self._clock, context=self._context, autostart=autostart,
                      wake=self._wake_executor)
        return self._add(self._timers, timer)

    def create_rate(self, frequency: float, clock: Clock | None = None) -> Rate:
        """
        Create a rate.

        :param frequency: in hertz.
        """
        if frequency <= 0:
            raise ValueError('frequency must be > 0')
        timer = self.create_timer(1.0 / frequency, None, self._rate_group, clock)
        return Rate(timer, context=self._context)

    # --- destroying ---

    def __del__(self) -> None:
        if not getattr(self, '_destroyed', True) and not sys.is_finalizing() \
                and hasattr(self, '_record') and self._context.ok():
            self.destroy_node()

    def _destroy(self, things: list[Any], thing: Entity) -> bool:
        if thing not in things:
            return False
        things.remove(thing)
        for handler in getattr(thing, 'event_handlers', []):
            self._waitables.remove(handler)
        self._graph.remove_endpoints(
            self._record, *[end for end in thing._ends if isinstance(end, (Reader, Writer))])
        thing.destroy()
        self._wake_executor()
        return True

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """Destroy a publisher; False if it isn't the node's."""
        return self._destroy(self._publishers, publisher)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription; False if it isn't the node's."""
        return self._destroy(self._subscriptions, subscription)

    def destroy_client(self, client: Client) -> bool:
        """Destroy a client; False if it isn't the node's."""
        return self._destroy(self._clients, client)

    def destroy_service(self, service: Service) -> bool:
        """Destroy a service; False if it isn't the node's."""
        return self._destroy(self._services, service)

    def destroy_timer(self, timer: Timer) -> bool:
        """Destroy a timer; False if it isn't the node's."""
        return self._destroy(self._timers, timer)

    def destroy_rate(self, rate: Rate) -> bool:
        """Destroy a rate; False if it isn't the node's."""
        done = self.destroy_timer(rate._timer)
        rate.destroy()
        return done

    def destroy_node(self) -> None:
        """Destroy the node and all that it has."""
        if self._destroyed:
            return
        self._destroyed = True
        self._parameter_event_publisher = None
        if logging._rosout.get(self._logger_name) is getattr(self, '_rosout', False):
            del logging._rosout[self._logger_name]
        with self._graph.held():
            everything: tuple[list[Any], ...] = (
                self._publishers, self._subscriptions, self._clients, self._services,
                self._timers)
            for things in everything:
                while things:
                    self._destroy(things, things[0])
            self._graph.remove_node(self._record)
        executor = self.executor
        if executor is not None:
            executor.remove_node(self)

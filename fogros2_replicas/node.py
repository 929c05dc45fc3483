# SPDX-License-Identifier: Apache-2.0
"""
Serve the public services and outputs of replicated nodes, from the first replica that answers.

rclpy has no serialized requests, so a service's type must be importable here. Messages of topics
pass as bytes. Types and QoS come from the ROS graph, so the launch file names only topics and
services.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import difflib
import functools
import itertools
import json
import math
import os
import re
import select
import sys
import threading
import time
from typing import Any, Optional

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future

from fogros2 import ros_types
from fogros2_replicas import figures
from fogros2_replicas.calls import Action, Answer, Calls, Drop, MOST
from fogros2_replicas.pairs import Header, header_of, Pair
from image_transport_h264 import ending
from image_transport_h264.lazy import every, printable

#: Seconds between two looks at the graph, between two writes of the figures, and after which
#: missing names are reported. Names and texts that are remembered because they were reported.
LOOK, WRITE, MISSING, WARNINGS = 0.25, 1.0, 30.0, 1000
#: Reads the header of a serialized message.
Read = Callable[[bytes], Optional[Header]]
#: Names that every node has.
_EVERYWHERE = re.compile(r'/rosout|/parameter_events|.*/_.*|.*/\w+_(parameters\w*|parameter_types|'
                         r'type_description)')


class _Served:
    """A public service and its clients, one for each replica."""

    def __init__(self, node: FirstAnswer, name: str) -> None:
        self.name, self.node = name, node
        self.figures = Calls(list(node.replicas), node.settings['hedge_after'], node.last,
                             node.deadline)
        self.opened = False
        self._kind = ''
        self._numbers = itertools.count()
        self._clients: dict[str, Client] = {}
        self._waiting: dict[int, tuple[Any, Future]] = {}
        self._asked: dict[str, dict[int, Future]] = {name: {} for name in node.replicas}

    def look(self) -> None:
        """Open the service when the first replica serves it; follow which replicas do."""
        kinds = dict(self.node.get_service_names_and_types())
        if f'{self.name}/_action/send_goal' in kinds:
            self.node.complain(f'{self.name} is a ROS action, which has goals, feedback and '
                               'results of one replica: run it on one machine')
        # this node's own client has a type, too
        self._kind, fit = self.node.agreed(self.name, self._kind, {
            name: min(kinds[prefix + self.name], key=self._kind.__eq__)
            for name, prefix in self.node.replicas.items() if kinds.get(prefix + self.name)})
        service = self.node.imported(self.name, self._kind, ros_types.service)
        if service is None:
            return
        if not self.opened:
            self.opened = True
            for name, prefix in self.node.replicas.items():
                self._clients[name] = self.node.create_client(service, prefix + self.name)
            # in a group that lets several requests in at once
            self.node.create_service(
                service, self.name, self._serve, callback_group=ReentrantCallbackGroup())
        with self.node.lock:
            self.do(self.figures.ready(time.monotonic(), [
                name for name in fit if self._clients[name].service_is_ready()]))

    async def _serve(self, request: Any, response: Any) -> Any:
        future = Future()
        with self.node.lock:
            call = next(self._numbers)
            self._waiting[call] = request, future
            self.do(self.figures.ask(time.monotonic(), call))
        return await future

    def do(self, actions: Iterable[Action]) -> None:
        """Send requests and answers; hold the lock for it."""
        for action in actions:
            if isinstance(action, Answer):
                self._waiting.pop(action.call)[1].set_result(action.response)
                continue
            if isinstance(action, Drop):
                # rclpy sends no response, and ``main`` handles the error
                self._waiting.pop(action.call)[1].set_exception(RuntimeError(
                    f'an answer of {self.name}, as {MOST} later requests have none either'))
                continue
            client, futures = self._clients[action.replica], self._asked[action.replica]
            future = futures[action.call] = client.call_async(self._waiting[action.call][0])
            future.add_done_callback(
                functools.partial(self._answered, action.call, action.replica))
            if len(futures) > MOST:
                client.remove_pending_request(futures.pop(next(iter(futures))))
        self.node.wake()

    def _answered(self, call: int, replica: str, future: Future) -> None:
        with self.node.lock:
            self._asked[replica].pop(call, None)
            response = future.result()
            # the field by which std_srvs and many others report a failure
            failed = getattr(response, 'success', True) is False
            self.do(self.figures.answered(
                time.monotonic(), call, replica, response, failed=failed))


class _Forwarded:
    """An input that goes to the replicas, and an output that comes from the first one."""

    def __init__(self, node: FirstAnswer, source: str, target: str, streamed: bool) -> None:
        self.name, self.node = target, node
        self.figures = Pair(list(node.replicas), node.last, node.deadline)
        self._source, self._streamed = source, streamed
        self._inputs: Optional[list[Publisher]] = None
        self._at_last: Optional[Publisher] = None
        self._output: Optional[Publisher] = None
        self._heard: set[str] = set()
        self._kind = ''

    @property
    def opened(self) -> bool:
        """Whether a replica's output was found."""
        return self._output is not None

    def look(self) -> None:
        """Subscribe to what the graph has now."""
        outputs = {name: self.node.published(prefix + self.name)
                   for name, prefix in self.node.replicas.items()}
        self._kind, fit = self.node.agreed(
            self.name, self._kind, {name: kind for name, (kind, _) in outputs.items() if kind})
        message = self.node.imported(self.name, self._kind, ros_types.message)
        for name, replica in self.figures.replicas.items():
            replica.there = name in fit
            if message is None or not replica.there or name in self._heard:
                continue
            self._heard.add(name)
            qos = outputs[name][1]
            self._output = self._output or self.node.create_publisher(message, self.name, qos)
            self.node.create_subscription(
                message, self.node.replicas[name] + self.name, functools.partial(
                    self._came_out, name, _reader(message)), qos, raw=True)
        kind, qos = self.node.published(self._source)
        message = self.node.imported(self._source, kind, ros_types.message)
        if self._inputs is None and message is not None:
            inputs = {name: self.node.create_publisher(message, prefix + self._source, qos)
                      for name, prefix in self.node.replicas.items()
                      if name == self.node.last or not self._streamed}
            self._at_last = inputs.pop(self.node.last, None)
            self._inputs = [*inputs.values()]
            self.node.create_subscription(message, self._source, functools.partial(
                self._came_in, _reader(message)), qos, raw=True)

    def _came_in(self, read: Read, data: bytes) -> None:
        for publisher in self._inputs or ():
            publisher.publish(data)
        with self.node.lock:
            self.to_last(self.figures.input(time.monotonic(), read(data), data))
        self.node.wake()

    def to_last(self, inputs: Iterable[bytes]) -> None:
        """Send inputs to the last replica."""
        if self._at_last is not None:
            for data in inputs:
                self._at_last.publish(data)

    def _came_out(self, name: str, read: Read, data: bytes) -> None:
        with self.node.lock:
            first = self.figures.output(time.monotonic(), name, read(data))
        if first and self._output is not None:
            self._output.publish(data)
        if self.figures.unmatched:
            self.node.complain(
                f'{self.name}: stamps of its messages match no {self._source}, so outputs of '
                'several replicas cannot be compared; one replica at a time is forwarded')


class FirstAnswer(Node):
    """
    The node on the robot.

    :param settings: ``name`` of the node; ``replicas``, the prefix of their names by name; the
        public ``services``; ``topics``, each as input, output and whether the input is a stream,
        which arrives by itself; ``hedge_after`` as in :mod:`fogros2_replicas.calls`; ``last``, the
        name of the replica that is asked last, if there is one, and its ``deadline`` in seconds;
        ``folder``, where figures are written to and events of the launch come from.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings['name'], start_parameter_services=False)
        self.settings = settings
        self.replicas: dict[str, str] = settings['replicas']
        self.last: str = settings.get('last', '')
        self.deadline: float = settings.get('deadline', math.inf)
        self.lock = threading.RLock()
        self._complained: set[str] = set()
        self._begin = time.monotonic()
        self._public: list[_Served | _Forwarded] = [
            *(_Served(self, name) for name in settings['services']),
            *(_Forwarded(self, *names) for names in settings['topics'])]
        self._path, self._written = f"{settings['folder']}/{settings['name']}", ''
        # opened for writing too, so that it never ends; ``wake`` writes empty lines
        self._events = os.open(f'{self._path}.events', os.O_RDWR | os.O_NONBLOCK)
        every(self, WRITE, self._write)
        every(self, LOOK, self._look)
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    # -- the graph ------------------------------------------------------------------------------

    def published(self, topic: str) -> tuple[str, QoSProfile]:
        """Return the type of a topic, '' without a publisher, and a profile that fits all."""
        infos = [info for info in self.get_publishers_info_by_topic(topic)
                 if info.node_name != self.settings['name']]
        qos = QoSProfile(depth=10)
        if not all(info.qos_profile.reliability == ReliabilityPolicy.RELIABLE for info in infos):
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        if all(info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in infos):
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        return infos[0].topic_type if infos else '', qos

    def agreed(self, name: str, kind: str, kinds: Mapping[str, str]) -> tuple[str, list[str]]:
        """Return the first type found, empty for none, and who has it; complain of others."""
        kind = kind or next(iter(kinds.values()), '')
        if set(kinds.values()) - {kind}:
            self.complain(f'{name}: replicas have different types, and the first one is used: '
                          + ', '.join(f'{other} on {one}' for one, other in kinds.items())
                          + '; give all machines the same packages')
        return kind, [one for one, other in kinds.items() if other == kind]

    def imported(self, name: str, kind: str, get: Callable[[str], Any]) -> Any:
        """Return the class of a type, None for none; complain if it is not installed."""
        try:
            return get(kind) if kind else None
        except LookupError as error:
            return self.complain(
                f"{name}: its type {kind!r} can't be imported on the robot ({error}); "
                'install its package here too, or source the workspace that has it')

    def complain(self, text: str) -> None:
        """Log an error once."""
        text = printable(text)
        if text not in self._complained and len(self._complained) < WARNINGS:
            self._complained.add(text)
            self.get_logger().error(text)

    def _look(self) -> None:
        for one in self._public:
            one.look()
        missing = [one.name for one in self._public if not one.opened]
        if not missing:
            self._report_shared()
        elif time.monotonic() - self._begin > MISSING:
            names = [name for name, _ in (
                *self.get_service_names_and_types(), *self.get_topic_names_and_types())]
            for name in missing:
                near = difflib.get_close_matches(name, names, 3, 0.5) or ['nothing like it']
                self.complain(f"no replica has {name}; the ROS graph has {', '.join(near)}")

    def _report_shared(self) -> None:
        """Warn once of names that the same node has on several machines."""
        nodes = self.get_node_names_and_namespaces()
        for node in {node for node in nodes if nodes.count(node) > 1}:
            try:
                names = [*self.get_publisher_names_and_types_by_node(*node),
                         *self.get_service_names_and_types_by_node(*node)]
            except RuntimeError:
                continue  # the node has just ended
            shared = sorted({name for name, _ in names if not _EVERYWHERE.fullmatch(name)
                             and not name.startswith('/fogros2/')} - self._complained)
            if shared and len(self._complained) < WARNINGS:
                self._complained.update(shared)
                self.get_logger().warning(printable(
                    f"{', '.join(shared)}: the node '{node[0]}' of each replica has this name; "
                    'declare it in services= or topics=, or expect all of them at once'))

    # -- events and figures ---------------------------------------------------------------------

    def wake(self) -> None:
        """Have the thread look when the next request is due."""
        waits = self.settings['hedge_after'] or self.last
        if waits and threading.current_thread() is not self._watcher:
            os.write(self._events, b'\n')

    def _watch(self) -> None:
        """Read events of the launch, and send requests that are due to the next replica."""
        while rclpy.ok(context=self.context):
            with self.lock:
                due = min((one.figures.next_due() for one in self._public), default=1e9)
            wait = max(0.0, min(due - time.monotonic(), WRITE))
            ready, _, _ = select.select([self._events], [], [], wait)
            lines = os.read(self._events, 65536).decode().split('\n') if ready else []
            with self.lock:
                now = time.monotonic()
                for what, _, name in (line.partition(' ') for line in lines if line):
                    for one in self._public:
                        if what == 'started':
                            one.figures.started(name)
                        elif isinstance(one, _Served):
                            one.do(one.figures.died(now, name))
                        else:
                            one.figures.died(name)
                for one in self._public:
                    if isinstance(one, _Served):
                        one.do(one.figures.due(now))
                    else:
                        one.to_last(one.figures.due(now))
            if any(lines) and self.executor is not None:
                self.executor.wake()  # an event may have answered a client

    def _write(self) -> None:
        with self.lock:
            text = json.dumps([row for one in self._public for row in figures.rows(
                one.name, [*one.figures.replicas.values()])])
        if text == self._written:
            return
        try:
            with open(f'{self._path}.new', 'w', opener=functools.partial(
                    os.open, mode=0o600)) as file:
                file.write(text)
            os.replace(f'{self._path}.new', f'{self._path}.json')
            self._written = text
        except OSError as error:  # such as a full disk; the services go on
            self.complain(f'figures of replicas are not written: {error}')


def _reader(message: Any) -> Read:
    fields = list(message.get_fields_and_field_types().values())
    return header_of if fields[:1] == ['std_msgs/Header'] else lambda data: None


def main() -> None:
    """Run until a signal; the only argument is the settings as JSON."""
    # a client or a replica may vanish while it is answered
    ending.run(lambda: FirstAnswer(json.loads(sys.argv[1])),
               lambda node, why: node.complain(f'not sent: {why}'))

# SPDX-License-Identifier: Apache-2.0
"""
Show viewers the parameters of the graph's nodes, and set them.

A viewer names a parameter ``/NODE.PARAMETER``. Viewers are answered from memory, because the SDK
waits for the answer with the thread that serves them. The nodes are first read when a viewer first
asks, and again after a change, and for a viewer who asks again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent import futures
import dataclasses
import threading
import time
from typing import Any, Optional

from foxglove import Parameter
from rcl_interfaces import msg, srv
from rclpy.serialization import serialize_message

from fogros2_monitor.services import CallError, Services

#: Number and bytes of all parameters that viewers see; the nodes that come first have them.
MOST, BYTES = 5000, 16_000_000
#: Number of parameters that a viewer may set at once, the items or characters of a value, and the
#: number of requests without an answer.
SETS, LONGEST, PENDING = 100, 1_000_000, 32
#: Time-out of a node's answer, and age from which a viewer gets newer values, in seconds.
ANSWER, FRESH = 5.0, 5.0
#: Seconds to wait for the first values, and for a node that sets one. One viewer waits at a time.
FIRST, SETTING = 1.0, 0.2
#: Names of the services of a node's parameters that are called here.
VERBS = ('list_parameters', 'get_parameters', 'set_parameters')
#: Nodes that are called at once.
_WORKERS = 8
#: Field of a value by its type, and the Python type of the value or its items.
_FIELDS: dict[int, tuple[str, type]] = {
    1: ('bool_value', bool), 2: ('integer_value', int), 3: ('double_value', float),
    4: ('string_value', str), 5: ('byte_array_value', bytes), 6: ('bool_array_value', bool),
    7: ('integer_array_value', int), 8: ('double_array_value', float),
    9: ('string_array_value', str)}
_BYTES, _FIRST_ARRAY = 5, 6


def shown(name: str, value: msg.ParameterValue) -> Optional[Parameter]:
    """Return a parameter as viewers see it, None without a value."""
    if value.type not in _FIELDS:
        return None
    native = getattr(value, _FIELDS[value.type][0])
    if value.type >= _BYTES:
        native = b''.join(native) if value.type == _BYTES else list(native)
    return Parameter(name, value=native)


def converted(value: Any, like: msg.ParameterValue) -> msg.ParameterValue:
    """
    Return a viewer's value as one of a parameter's own type.

    :raises ValueError: it is of another type, or too long.
    """
    if like.type not in _FIELDS:
        raise ValueError('it is unknown, or has no type yet')
    field, kind = _FIELDS[like.type]
    several = like.type >= _FIRST_ARRAY
    if several and not isinstance(value, list):
        raise ValueError('it takes a list')
    if isinstance(value, (bytes, list, str)) and len(value) > LONGEST:
        raise ValueError(f'it takes at most {LONGEST} items')
    items = [_item(item, kind) for item in (value if several else [value])]
    if like.type == _BYTES:
        items = [[bytes([byte]) for byte in items[0]]]
    return msg.ParameterValue(type=like.type, **{field: items if several else items[0]})


def _item(value: Any, kind: type) -> Any:
    # JSON has one type for both kinds of numbers, and Python's bool is an int
    if kind is float and type(value) in (int, float):
        return float(value)
    if type(value) is not kind:
        raise ValueError(f'it takes {kind.__name__}')
    return value


@dataclasses.dataclass
class _Node:
    """The parameters of a node, their size in bytes, and the time of the last read."""

    values: dict[str, msg.ParameterValue] = dataclasses.field(default_factory=dict)
    size: int = 0
    read_at: float = 0.0


class Parameters:
    """
    The parameters of all nodes.

    :param services: calls the nodes.
    :param admits: whether viewers may see a parameter, by its name.
    :param publish: sends changed parameters to the viewers.
    :param report: sends an error to the viewers.
    :ivar wanted: set when a viewer has asked for parameters.
    """

    def __init__(
        self, services: Services, admits: Callable[[str], bool],
        publish: Callable[[list[Parameter]], None], report: Callable[[str], None],
    ) -> None:
        self.wanted = threading.Event()
        self._services = services
        self._admits, self._publish, self._report = admits, publish, report
        self._pool = futures.ThreadPoolExecutor(_WORKERS, 'parameters')
        self._lock = threading.Lock()
        self._nodes: dict[str, _Node] = {}
        self._due: set[str] = set()
        self._reading: set[str] = set()
        self._setting = 0
        self._complete = threading.Event()

    def look(self, names: Collection[str]) -> None:
        """Read new nodes and changed ones; forget those that are gone."""
        with self._lock:
            self._nodes = {name: self._nodes.get(name, _Node()) for name in names}
            self._due |= {name for name, node in self._nodes.items() if not node.read_at}
            ready = (self._due & self._nodes.keys()) - self._reading
            self._due = self._due & self._reading
            self._reading |= ready
        for name in ready:
            self._pool.submit(self._read, name)

    def changed(self, name: str) -> None:
        """Note that a node's parameters have changed."""
        with self._lock:
            self._due |= {name} & self._nodes.keys()

    def get(self, names: Sequence[str]) -> list[Parameter]:
        """Return parameters by their names, all for no names; unknown ones are left out."""
        self._complete.wait(FIRST)
        self._complete.set()
        with self._lock:
            aged = time.monotonic() - FRESH
            self._due |= {name for name, node in self._nodes.items() if node.read_at < aged}
            known = {f'{node}.{name}': value for node, each in self._nodes.items()
                     for name, value in each.values.items()}
        wanted = [name for name in names if name in known] if names else [*known]
        return [one for name in wanted if (one := shown(name, known[name])) is not None]

    def set(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Have nodes set parameters; return the values that are known shortly after."""
        names = [parameter.name for parameter in parameters[:SETS]]
        self.get(names)  # these may be the first that are wanted
        with self._lock:
            nodes, alone = {**self._nodes}, not self._setting
            full = self._setting >= PENDING
        problems = [] if len(parameters) <= SETS and not full else [
            f'a viewer sets at most {SETS} parameters at once, and waits for {PENDING} nodes']
        tasks: dict[str, list[msg.Parameter]] = {}
        for parameter in [] if problems else parameters:
            node, _, name = parameter.name.partition('.')
            like = nodes.get(node, _Node()).values.get(name, msg.ParameterValue())
            try:
                value = converted(parameter.get_value(), like)
                tasks.setdefault(node, []).append(msg.Parameter(name=name, value=value))
            except ValueError as error:
                problems.append(f'{parameter.name} is not set: {error}')
        with self._lock:
            self._setting += len(tasks)
        jobs = [self._pool.submit(self._set, *task) for task in tasks.items()]
        for problem in problems:
            self._report(problem)
        if alone:
            futures.wait(jobs, SETTING)
        return self.get(names) if names else []

    def close(self) -> None:
        """Read and set no more."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    # -- in threads of the pool -----------------------------------------------------------------

    def _set(self, node: str, parameters: Sequence[msg.Parameter]) -> None:
        try:
            response = self._services.call(
                f'{node}/set_parameters', srv.SetParameters,
                srv.SetParameters.Request(parameters=parameters), ANSWER)
            for parameter, result in zip(parameters, response.results):
                if not result.successful:
                    self._report(f'{node}.{parameter.name} is not set: {result.reason}')
            self._read(node)
        except CallError as error:
            self._report(str(error))
        finally:
            with self._lock:
                self._setting -= 1

    def _read(self, name: str) -> None:
        """Read the parameters of a node."""
        values: Optional[dict[str, msg.ParameterValue]] = None
        size, problem = 0, ''
        try:
            listed = self._services.call(f'{name}/list_parameters', srv.ListParameters,
                                         srv.ListParameters.Request(), ANSWER)
            names = [each for each in listed.result.names if self._admits(f'{name}.{each}')]
            answer = self._services.call(f'{name}/get_parameters', srv.GetParameters,
                                         srv.GetParameters.Request(names=names[:MOST + 1]),
                                         ANSWER)
            size = len(serialize_message(answer))
            values = dict(zip(names, answer.values))
        except CallError as error:
            problem = str(error)
        with self._lock:
            self._reading.discard(name)
            if not self._reading:
                self._complete.set()
            before = self._nodes.get(name)
            if before is None:
                return
            others = [node for other, node in self._nodes.items() if other != name]
            if values is None:  # no answer; they may not have changed
                values, size = before.values, before.size
            elif sum(len(node.values) for node in others) + len(values) > MOST or \
                    sum(node.size for node in others) + size > BYTES:
                values, size, problem = {}, 0, f'the parameters of {name} are too many to show'
            self._nodes[name] = _Node(values, size, time.monotonic())
        changes = [shown(f'{name}.{key}', value) for key, value in values.items()
                   if before.values.get(key) != value]
        self._publish([change for change in changes if change is not None])
        if problem and not before.read_at:
            self._report(problem)

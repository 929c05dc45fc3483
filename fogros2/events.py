# SPDX-License-Identifier: Apache-2.0
"""
The agent's events and answers: the one definition of the messages that a machine sends.

A message is a JSON object. The agent and ``cloud_launch`` build it as one of these types; neither
imports them when it runs. The robot checks each received message once, in ``agent_client``, with
:func:`event` or :func:`answer`, because a hijacked machine may send anything. Keys that are not
defined here, and events of other names, come from a newer agent: the robot ignores them.
"""

from __future__ import annotations

from collections.abc import Mapping
import functools
import math
import re
from typing import (
    Any,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
    Literal,
    Optional,
    TypedDict,
    Union,
)

#: Largest magnitude of a number: float and every interpreter of JSON represent it exactly.
LARGEST = 2 ** 53


class InvalidMessage(ValueError):
    """A message does not have its type; the text names the field."""


# -- events -----------------------------------------------------------------------------------


class _Numbered(TypedDict, total=False):
    """The agent's journal adds a number and the time in seconds since the epoch."""

    seq: int
    time: float


class _OfNode(_Numbered):
    node: str
    name: str


class NodeStarted(_OfNode):
    """A node's process runs."""

    event: Literal['started']
    pid: int
    cmd: list[str]


class NodeOutput(_OfNode):
    """A node wrote text."""

    event: Literal['output']
    stream: str
    text: str


class NodeExited(_OfNode):
    """A node's process ended; launch starts it again if ``respawns``."""

    event: Literal['exited']
    returncode: int
    respawns: bool


class NodeRefused(_OfNode):
    """A node cannot run on the machine."""

    event: Literal['refused']
    error: str
    hint: str


class WatchdogFired(_Numbered):
    """A deadline has passed; the agent stops the nodes or ends the machine."""

    event: Literal['watchdog']
    reason: str
    action: str


class VpnRepaired(_Numbered):
    """A health check of the VPN failed, and its repair worked after so many seconds."""

    event: Literal['vpn_repaired']
    what: str
    seconds: float


class EndFailed(_Numbered):
    """The command that ends the machine failed; the agent tries again."""

    event: Literal['end_failed']
    returncode: int


class PreemptionNotice(_Numbered):
    """The provider will reclaim the machine. The agent answers requests until then."""

    event: Literal['notice']
    reason: str


class MachineIdle(_Numbered):
    """Nobody has used the machine for its ``idle_timeout``."""

    event: Literal['idle']
    reason: str


class AgentEnding(_Numbered):
    """A signal ends the agent, and with it the nodes."""

    event: Literal['ending']
    reason: str


class LaunchExited(_Numbered):
    """The nodes' launch process ended unexpectedly; ``said`` is the end of its log."""

    event: Literal['launch_exited']
    returncode: int
    said: str


class ConnectionChanged(TypedDict, total=False):
    """The robot's connection to the agent is lost, back, or given up because of ``error``."""

    event: Literal['connection']
    state: Literal['lost', 'back', 'absent']
    error: str


class Gap(TypedDict):
    """So many events were dropped from the agent's journal before the robot got them."""

    event: Literal['gap']
    count: int


class MachineLost(TypedDict):
    """
    The machine ended, stopped or was evicted, as its provider reports; the last event.

    Or it is lost: neither it nor its provider answers.
    """

    event: Literal['lost']
    reason: str


NodeEvent = Union[NodeStarted, NodeOutput, NodeExited, NodeRefused]
#: Events that an agent sends; the robot makes the others itself.
AgentEvent = Union[
    NodeEvent, WatchdogFired, VpnRepaired, EndFailed, PreemptionNotice, MachineIdle, AgentEnding,
    LaunchExited]
Event = Union[AgentEvent, ConnectionChanged, Gap, MachineLost]


# -- answers ----------------------------------------------------------------------------------


class Empty(TypedDict):
    """The answer to a request that has no result."""


class _Configured(TypedDict):
    machine: str
    next: int


class Configured(_Configured, total=False):
    """
    The machine's name, and the number of the next event.

    ``signed``: heartbeats need an HMAC; an agent of the first version omits it.
    """

    signed: bool


class Launched(TypedDict):
    """The process that will run the nodes."""

    pid: int


class StartedNodes(TypedDict):
    """The ids of nodes that had been started before."""

    known: list[str]


class LogRange(TypedDict):
    """The numbers of the events that exist, and how many requested ones do not any more."""

    first: int
    next: int
    lost: int


class HealthCheck(TypedDict):
    """The state of a health check, and how often it repaired."""

    what: str
    ok: bool
    repairs: int


class _NodeStatus(TypedDict):
    id: str
    name: str
    state: str
    pid: Optional[int]
    returncode: Optional[int]
    restarts: int


class NodeStatus(_NodeStatus, total=False):
    """The state of a node: starting, running, exited, or refused because of ``error``."""

    error: str


class Status(TypedDict):
    """
    The agent's state.

    ``since`` is in seconds since the epoch, ``robot_timeout``, ``lifetime_left`` and
    ``heartbeat_age`` (None: none is expected) are in seconds, ``rss_kb`` is its memory in kB.
    """

    machine: str
    launch: str
    pid: int
    user: str
    directory: str
    since: float
    on_exit: str
    robot_timeout: float
    lifetime_left: float
    heartbeat_age: Optional[float]
    ending: bool
    launch_running: bool
    nodes: list[NodeStatus]
    kept: list[HealthCheck]
    rss_kb: int
    first: int
    next: int


class Refusal(TypedDict, total=False):
    """The answer to a refused request."""

    error: str
    hint: str
    kind: str


class _Heartbeat(TypedDict):
    launch: str
    t: float


class HeartbeatAnswer(_Heartbeat, total=False):
    """
    The robot's heartbeat as the agent returns it.

    ``t`` is the robot's monotonic clock in seconds; ``clock`` is the machine's time in seconds
    since the epoch, which an agent of the first version omits.
    """

    clock: float


_EVENTS: Mapping[str, Any] = {
    get_args(get_type_hints(kind)['event'])[0]: kind for kind in get_args(AgentEvent)}
_ANSWERS: Mapping[str, Any] = {
    'configure': Configured, 'launch': Launched, 'start': StartedNodes, 'log': LogRange,
    'status': Status}


# -- text -------------------------------------------------------------------------------------

_REPLACEMENT = '\N{REPLACEMENT CHARACTER}'
_NO_COLOUR = re.compile('\x1b(?!\\[[0-9;:]*m)')


class _Visible(dict[int, str]):
    """Characters as a terminal may get them; escape characters are those of colours."""

    def __missing__(self, code: int) -> str:
        return chr(code) if chr(code).isprintable() else _REPLACEMENT


_VISIBLE = _Visible({0x1b: '\x1b', ord('\t'): '\t', ord('\n'): '\n', ord('\r'): '\n'})


def clean(text: str) -> str:
    """
    Replace control characters in a machine's text, so that a terminal can show it.

    Colours, tabs and line breaks stay. A carriage return becomes a line break: it would let the
    text overwrite the name of the machine in front of it.
    """
    if text.isprintable():
        return text
    return _NO_COLOUR.sub(_REPLACEMENT, text.replace('\r\n', '\n')).translate(_VISIBLE)


def cleaned(value: Any) -> Any:
    """Return a received value with all of its texts cleaned."""
    if isinstance(value, str):
        return clean(value)
    if isinstance(value, list):
        return [cleaned(item) for item in value]
    if isinstance(value, dict):
        return {name: cleaned(item) for name, item in value.items()}
    return value


# -- the check --------------------------------------------------------------------------------


def event(message: dict[str, Any]) -> Optional[AgentEvent]:
    """
    Return a received message as an event, None if this version does not know the event.

    :raises InvalidMessage: a field is missing or has another type.
    """
    name = message.get('event')
    if not isinstance(name, str):
        raise InvalidMessage(f"field 'event': expected str, got {_kind(name)}")
    if name not in _EVENTS:
        _check(message, _Numbered)
        return None
    _check(message, _EVENTS[name])
    return message  # type: ignore[return-value]


def answer(command: str, message: dict[str, Any]) -> dict[str, Any]:
    """
    Return the received answer to a command; one that is not ``ok`` is a ``Refusal``.

    :raises InvalidMessage: a field is missing or has another type.
    """
    refused = message.get('ok') is not True and command != 'log'
    _check(message, Refusal if refused else _ANSWERS.get(command, Empty))
    return message


def heartbeat(message: Any) -> HeartbeatAnswer:
    """
    Return the received answer to a heartbeat.

    :raises InvalidMessage: a field is missing or has another type.
    """
    _check(message, HeartbeatAnswer, 'heartbeat')
    return message  # type: ignore[no-any-return]


_hints = functools.lru_cache(maxsize=None)(get_type_hints)


def _check(value: Any, kind: Any, field: str = '') -> None:
    """
    Check that a value has a type of this module.

    :raises InvalidMessage: it has another type, or a number is not finite or too large.
    """
    options = get_args(kind)
    if is_typeddict(kind) and isinstance(value, dict):
        for name, expected in _hints(kind).items():
            where = f'{field}.{name}' if field else name
            if name in value:
                _check(value[name], expected, where)
            elif name in kind.__required_keys__:
                raise InvalidMessage(f"field '{where}' is missing")
        return
    if get_origin(kind) is Union:
        if value is None:
            return
        kind = options[0]
    elif get_origin(kind) is list and isinstance(value, list):
        for item in value:
            _check(item, options[0], field)
        return
    elif get_origin(kind) is Literal and value in options:
        return
    if kind in (int, float) and type(value) in (int, kind) and abs(value) <= LARGEST:
        return  # NaN and infinity are not less than anything
    if kind in (str, bool) and isinstance(value, kind):
        return
    raise InvalidMessage(
        f"field '{field}': expected {getattr(kind, '__name__', 'object')}, got {_kind(value)}")


def _kind(value: Any) -> str:
    """Name the type of a value, or the value of a number, which may be out of range."""
    if type(value) is int and abs(value) > LARGEST or type(value) is float and not math.isfinite(
            value):
        return 'a number out of range'
    return type(value).__name__

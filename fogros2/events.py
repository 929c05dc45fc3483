# SPDX-License-Identifier: Apache-2.0
"""
The agent's events and answers: the one definition of the messages that a machine sends.

A message is a JSON object. The agent builds it as one of these types, but does not import them
when it runs. The robot checks each received message once, in ``agent_client``, with
:func:`event` or :func:`answer`, because a hijacked machine may send anything. Keys that are not
defined here, and events of other names, come from a newer agent: the robot ignores them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args, get_type_hints, Literal, Optional, TypedDict, Union

from fogros2.untrusted import checked, InvalidMessage

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
    """A node's process ended; the agent starts it again if ``respawns``."""

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


class WatchEnded(_Numbered):
    """The program of a watch has exited with 0; ``reason`` is what it printed."""

    event: Literal['watched']
    what: str
    reason: str


class AgentEnding(_Numbered):
    """A signal ends the agent, and with it the nodes."""

    event: Literal['ending']
    reason: str


class AgentRestarted(_Numbered):
    """The agent died and was started again; the nodes of the dead agent have ended."""

    event: Literal['restarted']


class ConnectionChanged(TypedDict, total=False):
    """The robot's connection to the agent is lost, back, or given up because of ``error``."""

    event: Literal['connection']
    state: Literal['lost', 'back', 'absent']
    error: str


class Gap(TypedDict):
    """So many events are not in the agent's journal (any more), and the robot lacks them."""

    event: Literal['gap']
    count: int


class MachineLost(TypedDict):
    """
    The machine ended, stopped or was evicted, as its provider reports; the last event.

    Or it is lost: neither it nor its provider answers.
    """

    event: Literal['lost']
    reason: str


class GivenUp(TypedDict):
    """The launch is to end the machine as its ``on_exit`` says, and to go on without it."""

    event: Literal['given_up']
    reason: str


NodeEvent = Union[NodeStarted, NodeOutput, NodeExited, NodeRefused]
#: Events that an agent sends; the robot makes the others itself.
AgentEvent = Union[
    NodeEvent, WatchdogFired, VpnRepaired, EndFailed, PreemptionNotice, WatchEnded, AgentEnding,
    AgentRestarted]
Event = Union[AgentEvent, ConnectionChanged, Gap, MachineLost, GivenUp]


# -- answers ----------------------------------------------------------------------------------


class Empty(TypedDict):
    """The answer to a request that has no result."""


class Configured(TypedDict):
    """The machine's name, and the number of the next event."""

    machine: str
    next: int


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


_EVENTS: Mapping[str, Any] = {
    get_args(get_type_hints(kind)['event'])[0]: kind for kind in get_args(AgentEvent)}
_ANSWERS: Mapping[str, Any] = {
    'configure': Configured, 'start': StartedNodes, 'log': LogRange, 'status': Status}


# -- the check --------------------------------------------------------------------------------


def event(message: dict[str, Any]) -> Optional[AgentEvent]:
    """
    Return a received message as an event, None if this version does not know the event.

    :raises InvalidMessage: a field is missing or has another type.
    """
    name = message.get('event')
    if not isinstance(name, str):
        raise InvalidMessage(f"field 'event': expected str, got {type(name).__name__}")
    if name not in _EVENTS:
        checked(message, _Numbered)
        return None
    checked(message, _EVENTS[name])
    return message  # type: ignore[return-value]


def answer(command: str, message: dict[str, Any]) -> dict[str, Any]:
    """
    Return the received answer to a command; one that is not ``ok`` is a ``Refusal``.

    :raises InvalidMessage: a field is missing or has another type.
    """
    refused = message.get('ok') is not True and command != 'log'
    checked(message, Refusal if refused else _ANSWERS.get(command, Empty))
    return message

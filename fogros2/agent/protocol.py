# SPDX-License-Identifier: Apache-2.0
"""
The agent's protocol: JSON objects, one per line.

A request is ``{"id": 1, "command": ..., ...}``. A reply is ``{"id": 1, "ok": true, ...}`` or
``{"id": 1, "ok": false, "error", "hint", "kind"}``. Replies and events are in ``fogros2.events``.
``of`` in a request is the launch that makes it. If another launch has the machine, the agent sends
``{"error", "kind": "absent"}`` without ``ok``, as if it were not there, and closes the connection;
the agent that the launch knew has ended.

``configure``  any key of ``CONFIG``; restarts the lifetime and, with ``heartbeat``, the watchdog.
               With another ``launch`` than before, the former launch's nodes stop first, and
               its watches end. Refused (kind ``busy``) while the former launch sets the machine up
               or sends heartbeats, unless ``force`` names the former launch, which the robot knows
               to be dead.
               With ``again`` it claims nothing: refused (kind ``released``) unless its ``launch``
               still has the machine; the request may have been delayed until after a release.
``watch``      ``what``, ``argv``, run as root every ``interval`` (s, default 5). When it exits
               with 0, the agent sends one event ``watched`` with ``what`` and, as ``reason``, the
               output, and ends the watch. With ``repair``, a list of argv, it goes on instead, and
               runs these after each failure; ``down`` is a list of argv for the end. The watch
               ``notice`` is part of the configuration; its event is named so.
``start``      ``nodes``: list of NodeSpec; nodes with a known id are ignored. Replies when the
               setup files have been sourced and the processes started.
``stop``       ``nodes``: ids, or null for all; replies at once, ``exited`` events follow
``signal``     ``node``, ``signal``: 'SIGINT'
``status``     the agent's state; ``ping`` is cheaper and returns nothing
``log``        ``from`` seq: replies ``first`` and ``next`` (seqs that exist), then sends all
               events from there on; ``lost`` counts events that rotation has deleted
``release``    stop the nodes, end the watches, disarm the heartbeat, reply when done; with
               ``exit`` true the agent then exits. Does nothing if another launch has taken the
               machine over from ``launch``.

Heartbeats are UDP datagrams from the robot's VPN address: ``BEAT`` and its HMAC-SHA256 by the key
in ``heartbeat``, which a launch makes anew. The agent drops a datagram that has another HMAC, or a
number that is not above the last one's. It answers the others with ``ANSWER``.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import socket
import struct
import sys
import time

TYPE_CHECKING = False  # importing typing takes a megabyte of memory
if TYPE_CHECKING:
    from typing import Any, Optional

    Json = dict[str, Any]

MAX_LINE = 16 << 20
#: Bytes of one generation of the journal; two are kept.
LOG_BYTES = 64 << 20
#: Largest datagram that is looked at, in bytes.
DATAGRAM = 256
#: A heartbeat: its number, and the robot's monotonic time in seconds.
BEAT = struct.Struct('!Qd')
#: The answer: both of these, and the machine's time in seconds since the epoch.
ANSWER = struct.Struct('!Qdd')

#: Keys of the configuration: accepted types and default value.
CONFIG: dict[str, tuple[tuple[type, ...], Any]] = {
    'machine': ((str,), ''),
    'launch': ((str,), ''),
    'directory': ((str,), ''),
    'user': ((str,), ''),
    'on_exit': ((str,), 'delete'),
    'lifetime': ((int, float), 8 * 3600.0),
    'robot_timeout': ((int, float), 120.0),
    'boot_timeout': ((int, float), 1800.0),
    'end_command': ((list,), []),
    'heartbeat': ((dict, type(None)), None),
    'environment': ((dict,), {}),
    'setup': ((list,), []),
    # command of the watch for a preemption notice; fixed for a launch once it is not None
    'notice': ((list, type(None)), None),
    'log_bytes': ((int,), LOG_BYTES),
    # file that says, after a reboot, until when a launch has kept this machine; '' for none
    'kept_until': ((str,), ''),
}


class Refused(Exception):
    """A request that was refused: message, hint, kind."""

    def __init__(self, message: str, hint: str = '', kind: str = '') -> None:
        super().__init__(message)
        self.answer = {'error': message, 'hint': hint, 'kind': kind}


def dump(data: Any) -> bytes:
    """Return one line of JSON."""
    return json.dumps(data, separators=(',', ':')).encode() + b'\n'


def say(text: str) -> None:
    """Write a line to the agent's own log (standard error)."""
    with contextlib.suppress(OSError):
        print(time.strftime('%Y-%m-%dT%H:%M:%S'), text, file=sys.stderr, flush=True)


def words(argv: Any) -> list[str]:
    """
    Check that a value is a command line; return it.

    :raises Refused: it is not a list of strings.
    """
    if not isinstance(argv, list) or not all(isinstance(w, str) and '\0' not in w for w in argv):
        raise Refused(f'{json.dumps(argv)[:80]} is no list of words')
    return argv


def sign(key: str, data: bytes) -> bytes:
    """Return data followed by its HMAC; the key is hexadecimal."""
    return data + hmac.digest(bytes.fromhex(key), data, 'sha256')


def verify(key: str, form: struct.Struct, datagram: bytes) -> Optional[tuple[Any, ...]]:
    """Return the fields of a signed datagram; None if it has another HMAC or another form."""
    data = datagram[:form.size]
    return form.unpack(data) if hmac.compare_digest(sign(key, data), datagram) else None


def checked(new: Json) -> Json:
    """
    Check the types and values of a configuration; drop unknown keys.

    :raises Refused: a value has the wrong type or is invalid.
    """
    known: Json = {key: value for key, value in new.items() if key in CONFIG}
    for key, value in known.items():
        if not isinstance(value, CONFIG[key][0]) or isinstance(value, bool):
            raise Refused(f"'{key}' can't be {json.dumps(value)[:80]}")
        if isinstance(value, (int, float)) and not 0 < value < 1e10:
            raise Refused(f"'{key}' has to be above 0, not {value}")
        if isinstance(value, list):
            words(value)
    if known.get('on_exit', 'delete') not in ('delete', 'stop', 'keep'):
        raise Refused(f"'on_exit' can't be '{known['on_exit']}'", 'delete, stop or keep')
    for key, value in known.get('environment', {}).items():
        if not isinstance(value, str) or '=' in key or '\0' in key + value or not key:
            raise Refused(f"'environment' can't set {key!r}")
    heartbeat = known.get('heartbeat')
    if heartbeat:
        try:
            socket.inet_aton(heartbeat['bind'])
            socket.inet_aton(heartbeat['peer'])
            port, secret = heartbeat['port'], bytes.fromhex(heartbeat['key'])
            if not isinstance(port, int) or not 0 < port < 65536 or len(secret) < 16:
                raise ValueError('port or key')
        except (KeyError, OSError, TypeError, ValueError) as error:
            raise Refused(
                "'heartbeat' needs bind and peer, addresses, a port and a key") from error
    return known

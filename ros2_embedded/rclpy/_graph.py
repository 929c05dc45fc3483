# SPDX-License-Identifier: Apache-2.0
"""
The participant and what is known of the others.

DDS knows participants, readers and writers; which of them make up a node each participant says on
the topic ``ros_discovery_info`` (rmw_dds_common/msg/ParticipantEntitiesInfo).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import struct
import threading
from typing import NamedTuple

from rclpy import _dds, _rmw
from rclpy._dds import Endpoint

_HEADER = b'\x00\x01\x00\x00'
_INFO = 'rmw_dds_common/msg/ParticipantEntitiesInfo'


@dataclass(eq=False)
class NodeRecord:
    """A node of this participant, with the ids of its readers and writers."""

    namespace: str
    name: str
    readers: list[bytes] = field(default_factory=list)
    writers: list[bytes] = field(default_factory=list)


class NodeInfo(NamedTuple):
    """A node anywhere in the domain."""

    name: str
    namespace: str
    readers: list[bytes]
    writers: list[bytes]


def type_hash_data(type_name: str) -> bytes:
    """Give what an endpoint's USER_DATA says of its type (``package/msg/Name``)."""
    from rosidl_embedded.typehash import type_hash
    return f'typehash={type_hash(type_name)};'.encode()


def user_data_value(endpoint: Endpoint, key: str) -> str | None:
    """Find a value in an endpoint's USER_DATA, which is ``key=value;`` pairs."""
    pairs = endpoint.policies.user_data.decode(errors='replace').split(';')
    return dict(pair.split('=', 1) for pair in pairs if '=' in pair).get(key)


def _encode(guid: bytes, nodes: list[NodeRecord]) -> bytearray:
    buffer = bytearray(_HEADER) + guid + struct.pack('<I', len(nodes))
    for node in nodes:
        for text in (node.namespace, node.name):
            data = text.encode() + b'\0'
            buffer += struct.pack('<I', len(data)) + data + bytes(-len(data) % 4)
        for ids in (node.readers, node.writers):
            buffer += struct.pack('<I', len(ids)) + b''.join(ids)
    return buffer


def _decode(data: bytes) -> tuple[bytes, list[tuple[str, str, list[bytes], list[bytes]]]]:
    """Read ParticipantEntitiesInfo; ValueError or struct.error if it is none."""
    guid, place = data[4:20], 20

    def number() -> int:
        nonlocal place
        place += 4
        found: int = struct.unpack_from('<I', data, place - 4)[0]
        if found > len(data):
            raise ValueError('a damaged ros_discovery_info')
        return found

    def text() -> str:
        nonlocal place
        size = number()
        start, place = place, place + size + -size % 4
        return data[start:start + size - 1].decode(errors='replace')

    def ids() -> list[bytes]:
        nonlocal place
        count = number()
        start, place = place, place + 16 * count
        return [bytes(data[start + 16 * index:start + 16 * index + 16])
                for index in range(count)]

    return bytes(guid), [(text(), text(), ids(), ids()) for _ in range(number())]


class Graph:
    """
    A participant in a domain.

    :raises RCLError: if the environment asks for what there isn't.
    :raises DDSError: if the domain can't be joined.
    """

    def __init__(self, domain_id: int, enclave: str) -> None:
        _rmw.check_implementation()
        self.domain_id = domain_id
        _dds.open_domain(domain_id, _rmw.configuration(domain_id))
        self._closed = False
        self._lock = threading.RLock()
        self._nodes: list[NodeRecord] = []
        self._others: dict[bytes, list[tuple[str, str, list[bytes], list[bytes]]]] = {}
        self._builtin: dict[int, _dds.Builtin] = {}
        self._known: dict[int, dict[bytes, Endpoint | None]] = {}
        self._held = 0
        self._next_id = 0
        try:
            self.participant = _dds.create_participant(
                domain_id, f'enclave={enclave};'.encode())
            self.guid = _dds.guid(self.participant)
            policies = _dds.Policies(
                depth=1, transient_local=True, user_data=type_hash_data(_INFO))
            name = 'rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_'
            self._writer = _dds.Writer(self.participant, 'ros_discovery_info', name, policies)
            self._reader = _dds.Reader(
                self.participant, 'ros_discovery_info', name,
                policies._replace(depth=0, ignore_local=True))
        except _dds.DDSError:
            _dds.close_domain(domain_id)
            raise

    @property
    def condition(self) -> int:
        """What triggers when another participant says something; :meth:`update` takes it."""
        return self._reader.condition

    def close(self) -> None:
        """Leave the domain."""
        with self._lock:
            if not self._closed:
                self._closed = True
                _dds.delete(self.participant)
                _dds.close_domain(self.domain_id)

    # --- this participant ---

    @contextmanager
    def held(self) -> Iterator[None]:
        """Say what changes in this block all at once at its end."""
        with self._lock:
            self._held += 1
            try:
                yield
            finally:
                self._held -= 1
                self._publish()

    def _publish(self) -> None:
        if not self._held and not self._closed:
            self._writer.write(_encode(self.guid, self._nodes))

    def add_node(self, namespace: str, name: str) -> NodeRecord:
        """Announce a node."""
        with self._lock:
            record = NodeRecord(namespace, name)
            self._nodes.append(record)
            self._publish()
            return record

    def remove_node(self, record: NodeRecord) -> None:
        """Take a node back."""
        with self._lock:
            if record in self._nodes:
                self._nodes.remove(record)
                self._publish()

    def add_endpoints(self, record: NodeRecord, *endpoints: _dds.Reader | _dds.Writer) -> None:
        """Announce readers and writers of a node."""
        with self._lock:
            for endpoint in endpoints:
                ids = record.readers if isinstance(endpoint, _dds.Reader) else record.writers
                ids.append(endpoint.guid)
            self._publish()

    def remove_endpoints(self, record: NodeRecord, *endpoints: _dds.Reader | _dds.Writer) -> None:
        """Take readers and writers back."""
        with self._lock:
            for endpoint in endpoints:
                ids = record.readers if isinstance(endpoint, _dds.Reader) else record.writers
                if endpoint.guid in ids:
                    ids.remove(endpoint.guid)
            self._publish()

    def service_id(self) -> str:
        """Make an id for a client or a service, in rmw_cyclonedds's notation."""
        with self._lock:
            self._next_id += 1
            identity = self.guid[:12] + self._next_id.to_bytes(4, 'big')
        return f'{identity[0]:2x}.' + '.'.join(f'{byte:x}' for byte in identity[1:])

    # --- the whole domain ---

    def update(self) -> None:
        """Take what others said since the last time."""
        with self._lock:
            if self._closed:
                return
            taken = True
            while taken:
                taken = False
                for sample in self._reader.take():
                    taken = True
                    try:
                        guid, nodes = _decode(bytes(sample.data))
                    except (ValueError, struct.error):
                        continue
                    self._others[guid] = nodes

    def _alive(self, topic: int) -> dict[bytes, Endpoint | None]:
        if topic not in self._builtin:
            self._builtin[topic] = _dds.Builtin(self.participant, topic)
            self._known[topic] = {}
        self._builtin[topic].update(self._known[topic])
        return self._known[topic]

    def endpoints(self, writers: bool) -> list[Endpoint]:
        """List the writers, or the readers, of all topics."""
        with self._lock:
            if self._closed:
                return []
            topic = _dds.BUILTIN_PUBLICATION if writers else _dds.BUILTIN_SUBSCRIPTION
            return [found for found in self._alive(topic).values() if found is not None]

    def nodes(self) -> list[NodeInfo]:
        """List the nodes."""
        with self._lock:
            self.update()
            found = [NodeInfo(node.name, node.namespace, list(node.readers), list(node.writers))
                     for node in self._nodes]
            if self._closed:
                return found
            alive = self._alive(_dds.BUILTIN_PARTICIPANT)
            for guid, nodes in list(self._others.items()):
                if guid not in alive:
                    del self._others[guid]
                    continue
                found += [NodeInfo(name, namespace, readers, writers)
                          for namespace, name, readers, writers in nodes]
            return found

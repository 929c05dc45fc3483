# SPDX-License-Identifier: Apache-2.0
"""
The few functions of Eclipse Cyclone DDS's C library that rclpy needs.

The library is the one in ``cyclonedds``' wheel; its own Python layer isn't used, because it needs
the IDL of each type, imports for 0.1 s, and holds the interpreter's lock while it writes. Here a
topic's type is opaque, its samples are ready CDR, and every call releases the lock.
"""

import atexit
from collections.abc import Iterator
import ctypes as ct
import importlib.util
from pathlib import Path
import signal
import threading
from typing import Any, NamedTuple

from rclpy.exceptions import RCLError

INFINITE = 2 ** 63 - 1
CYCLONEDDS = 0x7fff0000 + 256  # the pseudo handles of dds_basic_types.h
BUILTIN_PARTICIPANT, BUILTIN_PUBLICATION, BUILTIN_SUBSCRIPTION = (
    0x7fff0000 + number for number in (1, 3, 4))
ANY_STATE = 0x7f
ALIVE = 16

# bits of a status mask (dds.h, DDS_*_STATUS_ID)
OFFERED_DEADLINE, REQUESTED_DEADLINE, OFFERED_QOS, REQUESTED_QOS, SAMPLE_LOST = (
    1 << bit for bit in range(1, 6))
LIVELINESS_LOST, LIVELINESS_CHANGED, PUBLICATION_MATCHED, SUBSCRIPTION_MATCHED = (
    1 << bit for bit in range(9, 13))


class DDSError(RCLError):
    """A call into Cyclone DDS failed."""


class _Bytes(ct.Structure):
    _fields_ = [('data', ct.c_void_p), ('size', ct.c_uint32)]


class _Descriptor(ct.Structure):
    """dds_topic_descriptor_t."""

    _fields_ = [('size', ct.c_uint32), ('align', ct.c_uint32), ('flagset', ct.c_uint32),
                ('nkeys', ct.c_uint32), ('typename', ct.c_char_p), ('keys', ct.c_void_p),
                ('nops', ct.c_uint32), ('ops', ct.c_void_p), ('meta', ct.c_char_p),
                ('information', _Bytes), ('mapping', _Bytes), ('representations', ct.c_uint32)]


class _Info(ct.Structure):
    """dds_sample_info_t."""

    _fields_ = [('sample_state', ct.c_uint), ('view_state', ct.c_uint),
                ('instance_state', ct.c_uint), ('valid_data', ct.c_bool),
                ('source_timestamp', ct.c_int64), ('instance_handle', ct.c_uint64),
                ('publication_handle', ct.c_uint64), ('disposed', ct.c_uint32),
                ('no_writers', ct.c_uint32), ('sample_rank', ct.c_uint32),
                ('generation_rank', ct.c_uint32), ('absolute_rank', ct.c_uint32)]


class _Iov(ct.Structure):
    _fields_ = [('base', ct.c_void_p), ('length', ct.c_size_t)]


class _Endpoint(ct.Structure):
    """dds_builtintopic_endpoint_t."""

    _fields_ = [('key', ct.c_uint8 * 16), ('participant_key', ct.c_uint8 * 16),
                ('participant_handle', ct.c_uint64), ('topic', ct.c_char_p),
                ('type', ct.c_char_p), ('qos', ct.c_void_p)]


class _Participant(ct.Structure):
    """dds_builtintopic_participant_t."""

    _fields_ = [('key', ct.c_uint8 * 16), ('qos', ct.c_void_p)]


class _Status(ct.Structure):
    """What all statuses begin with; those that have no third to fifth number leave them."""

    _fields_ = [('numbers', ct.c_int32 * 4), ('handle', ct.c_uint64)]


def _load() -> ct.CDLL:
    spec = importlib.util.find_spec('cyclonedds')
    if spec is None or spec.origin is None:
        raise ImportError("rclpy needs 'cyclonedds': pip install 'cyclonedds>=11,<12'")
    beside = Path(spec.origin).parent.parent / 'cyclonedds.libs'
    for path in sorted(beside.glob('libddsc*')):
        return ct.CDLL(str(path))
    raise ImportError(f"no libddsc in '{beside}': reinstall 'cyclonedds' from a wheel")


_lib = _load()
_E, _P, _U32, _I32, _I64, _Z = (
    ct.c_int32, ct.c_void_p, ct.c_uint32, ct.c_int32, ct.c_int64, ct.c_size_t)
_ENDPOINT = ct.POINTER(_Endpoint)
_SIGNATURES: list[tuple[str, Any, list[Any]]] = [  # functions, what they return and take
    ('dds_create_domain', _E, [_U32, ct.c_char_p]),
    ('dds_create_participant', _E, [_U32, _P, _P]),
    ('dds_create_topic', _E, [_E, _P, ct.c_char_p, _P, _P]),
    ('dds_create_reader dds_create_writer', _E, [_E, _E, _P, _P]),
    ('dds_create_readcondition', _E, [_E, _U32]),
    ('dds_create_guardcondition dds_create_waitset dds_delete dds_assert_liveliness', _E, [_E]),
    ('dds_set_guardcondition', _I32, [_E, ct.c_bool]),
    ('dds_take_guardcondition dds_get_status_changes dds_get_guid dds_get_instance_handle '
     'dds_get_entity_sertype dds_writecdr dds_get_publication_matched_status '
     'dds_get_subscription_matched_status dds_get_offered_deadline_missed_status '
     'dds_get_requested_deadline_missed_status dds_get_liveliness_lost_status '
     'dds_get_liveliness_changed_status dds_get_offered_incompatible_qos_status '
     'dds_get_requested_incompatible_qos_status dds_get_sample_lost_status', _I32, [_E, _P]),
    ('dds_waitset_attach', _I32, [_E, _E, ct.c_ssize_t]),
    ('dds_waitset_detach', _I32, [_E, _E]),
    ('dds_waitset_wait', _I32, [_E, _P, _Z, _I64]),
    ('dds_set_status_mask', _I32, [_E, _U32]),
    ('dds_takecdr', _I32, [_E, _P, _U32, _P, _U32]),
    ('dds_take_mask', _I32, [_E, _P, _P, _Z, _U32, _U32]),
    ('dds_return_loan', _I32, [_E, _P, _I32]),
    ('dds_wait_for_acks', _I32, [_E, _I64]),
    ('dds_get_matched_subscriptions dds_get_matched_publications', _I32, [_E, _P, _Z]),
    ('dds_get_matched_subscription_data dds_get_matched_publication_data', _ENDPOINT,
     [_E, ct.c_uint64]),
    ('dds_builtintopic_free_endpoint dds_free dds_delete_qos ddsi_serdata_unref', None, [_P]),
    ('dds_strretcode', ct.c_char_p, [_I32]),
    ('dds_create_qos', _P, []),
    ('dds_qset_userdata', None, [_P, ct.c_char_p, _Z]),
    ('dds_qset_history', None, [_P, ct.c_int, _I32]),
    ('dds_qset_reliability dds_qset_liveliness', None, [_P, ct.c_int, _I64]),
    ('dds_qset_durability dds_qset_ignorelocal', None, [_P, ct.c_int]),
    ('dds_qset_durability_service', None, [_P, _I64, ct.c_int, _I32, _I32, _I32, _I32]),
    ('dds_qset_lifespan dds_qset_deadline', None, [_P, _I64]),
    ('dds_qset_writer_data_lifecycle', None, [_P, ct.c_bool]),
    ('dds_qset_data_representation', None, [_P, _U32, _P]),
    ('dds_qget_userdata dds_qget_history dds_qget_reliability dds_qget_liveliness', ct.c_bool,
     [_P, _P, _P]),
    ('dds_qget_durability dds_qget_lifespan dds_qget_deadline', ct.c_bool, [_P, _P]),
    ('ddsi_serdata_from_ser_iov', _P, [_P, ct.c_int, _Z, _P, _Z]),
    ('ddsi_serdata_size', _U32, [_P]),
    ('ddsi_serdata_to_ser_ref', _P, [_P, _Z, _Z, _P]),
    ('ddsi_serdata_to_ser_unref', None, [_P, _P]),
]
for _names, _result, _arguments in _SIGNATURES:
    for _name in _names.split():
        _function = getattr(_lib, _name)
        _function.restype, _function.argtypes = _result, _arguments
_view = ct.pythonapi.PyMemoryView_FromMemory
_view.restype, _view.argtypes = ct.py_object, [_P, ct.c_ssize_t, ct.c_int]
_READ_ONLY = 0x100


def _checked(code: int, what: str) -> int:
    if code < 0:
        raise DDSError(f'failed to {what}: {_lib.dds_strretcode(code).decode()}')
    return code


# --- domains ------------------------------------------------------------------------------------

_domains: dict[int, tuple[int, int]] = {}  # domain id -> handle, users
_domains_lock = threading.Lock()


def open_domain(domain_id: int, config: str) -> None:
    """Create a domain for this process with a configuration, or share the one there is."""
    with _domains_lock:
        handle, users = _domains.get(domain_id, (0, 0))
        if not users:
            handle = _checked(_lib.dds_create_domain(domain_id, config.encode()),
                              f'create domain {domain_id}')
        _domains[domain_id] = (handle, users + 1)


def close_domain(domain_id: int) -> None:
    """Let go of a domain; its last user takes it down."""
    with _domains_lock:
        handle, users = _domains.pop(domain_id, (0, 0))
        if users > 1:
            _domains[domain_id] = (handle, users - 1)
        elif users:
            _lib.dds_delete(handle)


@atexit.register
def _close_all() -> None:
    """Say goodbye: without it other computers believe in this process until its lease ends."""
    if threading.current_thread() is threading.main_thread():
        # a second Ctrl-C would end this half-way, with a traceback
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    with _domains_lock:
        for handle, _ in _domains.values():
            _lib.dds_delete(handle)
        _domains.clear()


# --- quality of service -------------------------------------------------------------------------

class Policies(NamedTuple):
    """DDS's values of the policies that ROS 2 knows; durations in ns (0: unspecified)."""

    depth: int = 0  # 0: keep all; -1: unknown
    reliable: bool = True
    transient_local: bool = False
    lifespan: int = 0
    deadline: int = 0
    manual_liveliness: bool = False
    lease: int = 0
    user_data: bytes = b''
    ignore_local: bool = False


_REPRESENTATIONS = (ct.c_int16 * 1)(0)  # XCDR1


def _make_qos(policies: Policies) -> int:
    qos: int = _lib.dds_create_qos()
    history = (0, policies.depth) if policies.depth else (1, -1)
    _lib.dds_qset_writer_data_lifecycle(qos, False)
    _lib.dds_qset_history(qos, *history)
    _lib.dds_qset_reliability(qos, int(policies.reliable), INFINITE if policies.reliable else 0)
    if policies.transient_local:
        _lib.dds_qset_durability(qos, 1)
        _lib.dds_qset_durability_service(qos, 0, *history, -1, -1, -1)
    else:
        _lib.dds_qset_durability(qos, 0)
    if policies.lifespan:
        _lib.dds_qset_lifespan(qos, policies.lifespan)
    if policies.deadline:
        _lib.dds_qset_deadline(qos, policies.deadline)
    _lib.dds_qset_liveliness(
        qos, 2 if policies.manual_liveliness else 0, policies.lease or INFINITE)
    if policies.ignore_local:
        _lib.dds_qset_ignorelocal(qos, 1)
    _lib.dds_qset_data_representation(qos, 1, _REPRESENTATIONS)
    _lib.dds_qset_userdata(qos, policies.user_data, len(policies.user_data))
    return qos


def _read_qos(qos: int) -> Policies:
    kind, number, duration = ct.c_int(), ct.c_int32(), ct.c_int64()

    def span(function: Any) -> int:
        return duration.value if function(qos, ct.byref(duration)) else INFINITE

    depth = -1
    if _lib.dds_qget_history(qos, ct.byref(kind), ct.byref(number)):
        depth = number.value if kind.value == 0 else 0
    reliable = bool(_lib.dds_qget_reliability(qos, ct.byref(kind), ct.byref(duration))
                    and kind.value)
    durable = bool(_lib.dds_qget_durability(qos, ct.byref(kind)) and kind.value)
    lease, manual = INFINITE, False
    if _lib.dds_qget_liveliness(qos, ct.byref(kind), ct.byref(duration)):
        lease, manual = duration.value, kind.value == 2
    return Policies(depth, reliable, durable, span(_lib.dds_qget_lifespan),
                    span(_lib.dds_qget_deadline), manual, lease, _user_data(qos))


def _user_data(qos: int) -> bytes:
    value, size = ct.c_void_p(), ct.c_size_t()
    if not qos or not _lib.dds_qget_userdata(qos, ct.byref(value), ct.byref(size)):
        return b''
    data = ct.string_at(value, size.value) if value else b''
    _lib.dds_free(value)
    return data


# --- entities -----------------------------------------------------------------------------------

def create_participant(domain_id: int, user_data: bytes) -> int:
    """Create a participant with USER_DATA."""
    qos = _lib.dds_create_qos()
    _lib.dds_qset_userdata(qos, user_data, len(user_data))
    try:
        return _checked(_lib.dds_create_participant(domain_id, qos, None), 'create a participant')
    finally:
        _lib.dds_delete_qos(qos)


# a structure of one octet: Cyclone DDS looks at the first byte and passes on all of them
_OPS = (ct.c_uint32 * 3)(0x01 << 24 | 0x01 << 16, 0, 0)
_XCDR1_ONLY, _HAS_REPRESENTATIONS = 1, 1 << 7
_descriptors: dict[str, _Descriptor] = {}


def _create_topic(participant: int, name: str, type_name: str) -> int:
    descriptor = _descriptors.get(type_name)
    if descriptor is None:
        descriptor = _descriptors[type_name] = _Descriptor(
            size=1, align=1, flagset=_HAS_REPRESENTATIONS, typename=type_name.encode(), nops=2,
            ops=ct.addressof(_OPS), meta=b'', representations=_XCDR1_ONLY)
    return _checked(
        _lib.dds_create_topic(participant, ct.byref(descriptor), name.encode(), None, None),
        f"create topic '{name}' of type '{type_name}'")


def delete(entity: int) -> None:
    """Delete an entity and what belongs to it; one that is gone already is fine."""
    _lib.dds_delete(entity)


def guid(entity: int) -> bytes:
    """Give an entity's 16 bytes of identity."""
    value = (ct.c_uint8 * 16)()
    _checked(_lib.dds_get_guid(entity, value), 'get an entity id')
    return bytes(value)


def instance_handle(entity: int) -> int:
    """Give an entity's 64-bit handle."""
    value = ct.c_uint64()
    _checked(_lib.dds_get_instance_handle(entity, ct.byref(value)), 'get an instance handle')
    return value.value


class Endpoint(NamedTuple):
    """A reader or writer somewhere in the domain."""

    guid: bytes
    participant: bytes
    topic: str
    type: str
    policies: Policies


def _endpoint(found: _Endpoint) -> Endpoint:
    return Endpoint(
        bytes(found.key), bytes(found.participant_key), found.topic.decode(errors='replace'),
        found.type.decode(errors='replace'), _read_qos(found.qos))


class _Entity:
    """A reader or a writer."""

    def __init__(self, participant: int, topic: str, type_name: str, policies: Policies,
                 create: Any) -> None:
        self.topic = topic
        self._topic = _create_topic(participant, topic, type_name)
        qos = _make_qos(policies)
        try:
            self.handle = _checked(
                create(participant, self._topic, qos, None), f"use topic '{topic}'")
        except DDSError:
            delete(self._topic)
            raise
        finally:
            _lib.dds_delete_qos(qos)
        self.guid = guid(self.handle)
        self.watched = 0  # statuses that somebody waits for
        self.watch(0)

    def status(self, name: str) -> list[int]:
        """Take status ``name``: its numbers in dds.h's order."""
        value = _Status()
        function = getattr(_lib, f'dds_get_{name}_status')
        _checked(function(self.handle, ct.byref(value)), f'get status {name}')
        return list(value.numbers)

    def status_changes(self) -> int:
        """Give the mask of the statuses that changed since they were last taken."""
        mask = ct.c_uint32()
        _lib.dds_get_status_changes(self.handle, ct.byref(mask))
        return mask.value

    def watch(self, mask: int) -> None:
        """Let the entity itself trigger a wait set on these statuses."""
        _checked(_lib.dds_set_status_mask(self.handle, mask), 'watch statuses')

    def _matched(self, function: Any) -> list[int]:
        count = 16
        while True:
            handles = (ct.c_uint64 * count)()
            found = _checked(function(self.handle, handles, count), 'list matches')
            if found <= count:
                return list(handles[:found])
            count = found + 16

    def close(self) -> None:
        """Delete it."""
        delete(self.handle)
        delete(self._topic)


class Writer(_Entity):
    """Writes samples of ready CDR."""

    def __init__(self, participant: int, topic: str, type_name: str, policies: Policies) -> None:
        super().__init__(participant, topic, type_name, policies, _lib.dds_create_writer)
        sertype = ct.c_void_p()
        _checked(_lib.dds_get_entity_sertype(self.handle, ct.byref(sertype)), 'get a type')
        self._sertype = sertype.value

    def write(self, buffer: bytearray) -> None:
        """
        Write a sample.

        :param buffer: the encapsulation header and the CDR; padded here to a multiple of 4.
        :raises DDSError: if it could not be written.
        """
        if missing := -len(buffer) % 4:
            buffer += bytes(missing)
        first = ct.c_char.from_buffer(buffer)
        size = len(buffer)
        vector = _Iov(ct.addressof(first), size)
        sample = _lib.ddsi_serdata_from_ser_iov(self._sertype, 2, 1, ct.byref(vector), size)
        del first
        if not sample:
            raise DDSError('failed to publish: the message could not be stored')
        _checked(_lib.dds_writecdr(self.handle, sample), 'publish')

    def matched(self) -> list[int]:
        """Give the handles of the readers it writes to."""
        return self._matched(_lib.dds_get_matched_subscriptions)

    def matched_endpoint(self, handle: int) -> Endpoint | None:
        """Describe a matched reader."""
        return _matched_endpoint(_lib.dds_get_matched_subscription_data, self.handle, handle)

    def wait_for_acks(self, timeout: int) -> bool:
        """Wait until all readers have everything, or for timeout ns."""
        return int(_lib.dds_wait_for_acks(self.handle, timeout)) == 0

    def assert_liveliness(self) -> None:
        """Say that the publisher is alive."""
        _checked(_lib.dds_assert_liveliness(self.handle), 'assert liveliness')


class Sample(NamedTuple):
    """A sample that was taken: its bytes, when it was written (ns), and by whom."""

    data: Any
    source_timestamp: int
    publication: int


_COPIED = 16384  # below this many bytes a copy is cheaper than a view


class Reader(_Entity):
    """Takes samples as CDR."""

    def __init__(self, participant: int, topic: str, type_name: str, policies: Policies) -> None:
        super().__init__(participant, topic, type_name, policies, _lib.dds_create_reader)
        self.condition = _checked(
            _lib.dds_create_readcondition(self.handle, ANY_STATE), 'create a read condition')

    def take(self) -> Iterator[Sample]:
        """
        Take the next sample: yields it once, or not at all.

        Its data may be a view that is valid only until the iterator goes on.
        """
        info, sample = _Info(), ct.c_void_p()
        while _lib.dds_takecdr(self.handle, ct.byref(sample), 1, ct.byref(info), ANY_STATE) > 0:
            try:
                if not info.valid_data:  # an instance's end, not a message
                    continue
                size = _lib.ddsi_serdata_size(sample)
                vector = _Iov()
                reference = _lib.ddsi_serdata_to_ser_ref(sample, 0, size, ct.byref(vector))
                try:
                    if size < _COPIED:
                        data: Any = ct.string_at(vector.base, size)
                    else:
                        data = _view(vector.base, size, _READ_ONLY)
                    yield Sample(data, info.source_timestamp, info.publication_handle)
                    return
                finally:
                    _lib.ddsi_serdata_to_ser_unref(reference, ct.byref(vector))
            finally:
                _lib.ddsi_serdata_unref(sample)

    def matched(self) -> list[int]:
        """Give the handles of the writers it reads from."""
        return self._matched(_lib.dds_get_matched_publications)

    def matched_endpoint(self, handle: int) -> Endpoint | None:
        """Describe a matched writer."""
        return _matched_endpoint(_lib.dds_get_matched_publication_data, self.handle, handle)


def _matched_endpoint(function: Any, entity: int, handle: int) -> Endpoint | None:
    found = function(entity, handle)
    if not found:
        return None
    try:
        return _endpoint(found.contents)
    finally:
        _lib.dds_builtintopic_free_endpoint(found)


class Builtin:
    """Reads what Cyclone DDS knows of participants, publications or subscriptions."""

    def __init__(self, participant: int, topic: int) -> None:
        self._participants = topic == BUILTIN_PARTICIPANT
        self._kind: Any = ct.POINTER(_Participant if self._participants else _Endpoint)
        self.handle = _checked(
            _lib.dds_create_reader(participant, topic, None, None), 'read a built-in topic')

    def update(self, known: dict[bytes, Any]) -> None:
        """Bring up to date what is alive, by guid: an endpoint, or None for a participant."""
        count = 256
        samples, infos = (ct.c_void_p * count)(), (_Info * count)()
        number = count
        while number == count:
            number = _checked(_lib.dds_take_mask(
                self.handle, samples, infos, count, count, ANY_STATE), 'read the graph')
            for pointer, info in zip(samples[:number], infos[:number]):
                one = ct.cast(pointer, self._kind).contents  # type: ignore[arg-type]
                key = bytes(one.key)
                if info.instance_state != ALIVE:
                    known.pop(key, None)
                elif info.valid_data:
                    known[key] = None if self._participants else _endpoint(one)
            _lib.dds_return_loan(self.handle, samples, number)


class Guard:
    """A condition that a program triggers."""

    def __init__(self) -> None:
        self.handle = _checked(_lib.dds_create_guardcondition(CYCLONEDDS), 'create a guard')

    def trigger(self) -> None:
        """Wake who waits for it."""
        _lib.dds_set_guardcondition(self.handle, True)

    def take(self) -> bool:
        """Reset it; say whether it was triggered."""
        value = ct.c_bool()
        _lib.dds_take_guardcondition(self.handle, ct.byref(value))
        return value.value

    def close(self) -> None:
        """Delete it."""
        delete(self.handle)


class WaitSet:
    """Waits until one of the attached handles triggers."""

    def __init__(self) -> None:
        self.handle = _checked(_lib.dds_create_waitset(CYCLONEDDS), 'create a wait set')
        self.attached = set[int]()

    def attach(self, handles: set[int]) -> None:
        """Let it wait for exactly these."""
        for handle in self.attached - handles:
            _lib.dds_waitset_detach(self.handle, handle)
        for handle in handles - self.attached:
            _lib.dds_waitset_attach(self.handle, handle, handle)
        self.attached = set(handles)

    def wait(self, timeout: int) -> set[int]:
        """Wait for timeout ns; give the handles that triggered."""
        count = len(self.attached)
        triggered = (ct.c_ssize_t * count)()
        number = _lib.dds_waitset_wait(self.handle, triggered, count, timeout)
        if number < 0:
            return set()
        return set(triggered[:min(number, count)])

    def close(self) -> None:
        """Delete it."""
        delete(self.handle)

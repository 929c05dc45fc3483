# SPDX-License-Identifier: Apache-2.0
"""Services."""

from collections.abc import Callable
from functools import partial
import struct
import time
from typing import Any, NamedTuple

from rclpy._dds import Reader, Writer
from rclpy._entity import Work
from rclpy._graph import user_data_value
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import RCLError
from rclpy.qos import QoSProfile
from rclpy.service_introspection import Introspected
from rosidl_embedded import cdr

REQUEST_HEADER = struct.Struct('<Qq')  # rmw_cyclonedds: the client's writer, a sequence number
READER_WAIT = 0.1  # seconds a response waits for the client's reader to be discovered


class RequestId(NamedTuple):
    """Which request of which client."""

    writer_guid: int
    sequence_number: int
    publication: int

    @property
    def gid(self) -> bytes:
        """The client's id, as published to others."""
        return struct.pack('<QQ', self.writer_guid, self.publication)


class ServiceInfo(NamedTuple):
    """What is known of a request."""

    source_timestamp: int
    received_timestamp: int
    request_id: RequestId


class Service(Introspected):
    """Answers requests; made by :meth:`.Node.create_service`."""

    def __init__(self, service_impl: tuple[Reader, Writer], srv_type: Any, srv_name: str,
                 callback: Callable[[Any, Any], Any], callback_group: CallbackGroup,
                 qos_profile: QoSProfile, logger_name: str) -> None:
        super().__init__(*service_impl)
        self._reader, self._writer = service_impl
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.callback = callback
        self.callback_group = callback_group
        self.qos_profile = qos_profile
        self._logger_name = logger_name

    def _handle(self) -> int | None:
        return None if self._destroyed else self._reader.condition

    def _take(self, executor: Any) -> Work | None:
        def parse(data: Any) -> tuple[int, int, Any]:
            return (*REQUEST_HEADER.unpack_from(data, 4),
                    cdr.deserialize(data, self.srv_type.Request, 20))

        sample, parsed = self._read(parse, f"a request to service '{self.srv_name}'")
        if sample is None:
            return None
        client, number, request = parsed
        info = ServiceInfo(sample.source_timestamp, time.time_ns(),
                           RequestId(client, number, sample.publication))
        self._tell(1, info.request_id.gid, number, request=request)
        return (self.callback, (request, self.srv_type.Response()),
                partial(self.send_response, header=info))

    def _reader_is_known(self, publication: int) -> bool | None:
        """Whether the client's reader is matched; None if the client is gone."""
        client = self._reader.matched_endpoint(publication)
        if client is None:
            return None
        identity = user_data_value(client, 'clientid')
        if identity is None:
            return True
        return any(reader is not None and user_data_value(reader, 'clientid') == identity
                   for reader in map(self._writer.matched_endpoint, self._writer.matched()))

    def send_response(self, response: Any, header: ServiceInfo | RequestId) -> None:
        """
        Answer a request.

        :raises TypeError: if it is another type's response.
        """
        if not isinstance(response, self.srv_type.Response):
            raise TypeError(f"Service '{self.srv_name}': the callback gave "
                            f'{type(response)}, not {self.srv_type.Response}')
        self._check_alive()
        request = header.request_id if isinstance(header, ServiceInfo) else header
        data = cdr.serialize(response, cdr.HEADER + REQUEST_HEADER.pack(*request[:2]))
        limit = time.monotonic() + READER_WAIT
        while (known := self._reader_is_known(request.publication)) is False:
            if time.monotonic() > limit:
                raise RCLError('failed to send response: timeout')
            time.sleep(0.001)
        if known:
            self._writer.write(data)
            self._tell(2, request.gid, request.sequence_number, response=response)

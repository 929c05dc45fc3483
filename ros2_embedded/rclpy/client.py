# SPDX-License-Identifier: Apache-2.0
"""Clients of services."""

import threading
import time
from typing import Any

from rclpy import _dds
from rclpy._dds import Reader, Writer
from rclpy._entity import Work
from rclpy._graph import user_data_value
from rclpy.callback_groups import CallbackGroup
from rclpy.context import Context
from rclpy.qos import QoSProfile
from rclpy.service import REQUEST_HEADER
from rclpy.service_introspection import Introspected
from rclpy.task import Future
from rosidl_embedded import cdr

_numbers = iter(range(1, 2 ** 63))


class Client(Introspected):
    """Calls a service; made by :meth:`.Node.create_client`."""

    def __init__(self, context: Context, client_impl: tuple[Reader, Writer], srv_type: Any,
                 srv_name: str, qos_profile: QoSProfile, callback_group: CallbackGroup,
                 logger_name: str) -> None:
        self.context = context
        super().__init__(*client_impl)
        self._reader, self._writer = client_impl
        self._identity = _dds.instance_handle(self._writer.handle)
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.qos_profile = qos_profile
        self.callback_group = callback_group
        self._logger_name = logger_name
        self._pending_requests: dict[int, Future] = {}
        self._lock = threading.Lock()

    def _handle(self) -> int | None:
        return None if self._destroyed else self._reader.condition

    def _take(self, executor: Any) -> Work | None:
        def parse(data: Any) -> tuple[Future | None, int, Any]:
            client, number = REQUEST_HEADER.unpack_from(data, 4)
            with self._lock:
                future = self._pending_requests.get(number)
            if future is None or client != self._identity:
                return None, number, None  # nobody waits for it any more; another client's
            return future, number, cdr.deserialize(data, self.srv_type.Response, 20)

        sample, parsed = self._read(parse, f"a response of service '{self.srv_name}'")
        future, number, response = parsed or (None, 0, None)
        if future is None:
            return None
        self._tell(3, self._writer.guid, number, response=response)
        future._set_executor(executor)
        return future.set_result, (response,), None

    def call(self, request: Any, timeout_sec: float | None = None) -> Any:
        """
        Call the service and wait; an executor has to run in another thread.

        :param timeout_sec: limit of the wait.
        :returns: the response; None if the time was over.
        :raises TypeError: if it is another type's request.
        """
        if not isinstance(request, self.srv_type.Request):
            raise TypeError()
        event = threading.Event()
        future = self.call_async(request)
        future.add_done_callback(lambda _: event.set())
        if not event.wait(timeout_sec):
            self.remove_pending_request(future)
        return future.result()

    def call_async(self, request: Any) -> Future:
        """
        Call the service; the future is done when the response is there.

        :raises TypeError: if it is another type's request.
        """
        if not isinstance(request, self.srv_type.Request):
            raise TypeError()
        self._check_alive()
        future = Future()
        with self._lock:
            number = next(_numbers)
            self._pending_requests[number] = future
        future.add_done_callback(self.remove_pending_request)
        prefix = cdr.HEADER + REQUEST_HEADER.pack(self._identity, number)
        try:
            self._tell(0, self._writer.guid, number, request=request)
            self._writer.write(cdr.serialize(request, prefix))
        except (AssertionError, _dds.DDSError):
            self.remove_pending_request(future)
            raise
        return future

    def remove_pending_request(self, future: Future) -> None:
        """Wait no longer for a response."""
        with self._lock:
            for number, pending in self._pending_requests.items():
                if pending is future:
                    del self._pending_requests[number]
                    break

    def service_is_ready(self) -> bool:
        """Say whether there is a server that hears and answers this client."""
        self._check_alive()
        servers = set()
        for handle in self._writer.matched():
            endpoint = self._writer.matched_endpoint(handle)
            if endpoint is not None:
                servers.add(user_data_value(endpoint, 'serviceid') or endpoint.participant)
        for handle in self._reader.matched():
            endpoint = self._reader.matched_endpoint(handle)
            if endpoint is not None and (
                    user_data_value(endpoint, 'serviceid') or endpoint.participant) in servers:
                return True
        return False

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
        """Wait until :meth:`service_is_ready`, or for a number of seconds."""
        limit = None if timeout_sec is None else time.monotonic() + timeout_sec
        while not self.service_is_ready():
            if not self.context.ok() or limit is not None and time.monotonic() >= limit:
                return False
            time.sleep(0.005)
        return True

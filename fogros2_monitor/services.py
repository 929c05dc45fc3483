# SPDX-License-Identifier: Apache-2.0
"""Call services of the graph from threads other than the executor's, which must go on."""

from __future__ import annotations

from collections.abc import Collection
import threading
from typing import Any

from rclpy.client import Client
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.task import Future

from fogros2.errors import FogError
from fogros2.waiting import wait_until

#: Number of calls without an answer, of all viewers together.
CALLS = 64
#: Largest request of a viewer in bytes.
REQUEST = 4_000_000
#: Time-out of the discovery of a service, and of its answer to a viewer, in seconds.
READY, ANSWER = 2.0, 60.0


class CallError(FogError):
    """A call without an answer."""


class Services:
    """
    The clients of services, one for each service that was called.

    :param node: has the clients.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._clients: dict[str, Client] = {}
        self._pending: dict[Future, str] = {}
        self._free = threading.Semaphore(CALLS)
        self._ended = threading.Event()

    def call(self, name: str, cls: Any, request: Any, timeout: float) -> Any:
        """
        Call a service; return its response.

        :param cls: class of the service.
        :param timeout: of the answer, in seconds.
        :raises CallError: there is no answer.
        """
        answered = threading.Event()
        try:
            with self._lock:
                if self._ended.is_set():
                    raise CallError('the bridge ends')
                if name not in self._clients:
                    self._clients[name] = self._node.create_client(cls, name)
                client = self._clients[name]
            wait_until(client.service_is_ready, timeout=READY, what=f'service {name}',
                       cancel=self._ended)
            with self._lock:
                if client not in self._clients.values():
                    raise CallError('it is gone')
                future = client.call_async(request)
                self._pending[future] = name
        except RuntimeError as error:  # ours, or of a client that is gone
            raise CallError(f'{name} cannot be called: {error}') from error
        future.add_done_callback(lambda _: answered.set())
        answered.wait(timeout)
        with self._lock:
            del self._pending[future]
        if not future.done():
            client.remove_pending_request(future)
            raise CallError(f'{name} is gone' if future.cancelled() else
                            f'{name} did not answer within {timeout:g} s')
        if future.exception() is not None:
            raise CallError(f'{name}: {future.exception()}')
        return future.result()

    def call_serialized(self, name: str, cls: Any, payload: bytes) -> bytes:
        """
        Call a service with a viewer's request, which may be any bytes.

        :raises CallError: the bytes are no request, or there is no answer.
        """
        if len(payload) > REQUEST:
            raise CallError(f'{name}: the request has more than {REQUEST / 1e6:g} MB')
        try:
            request = deserialize_message(payload, cls.Request)
        except (RuntimeError, ValueError) as error:  # of the middleware, or of a string
            raise CallError(f'{name}: the bytes are no request: {error}') from error
        if not self._free.acquire(blocking=False):
            raise CallError(f'{name}: {CALLS} calls have no answer yet')
        try:
            answer: bytes = serialize_message(self.call(name, cls, request, ANSWER))
        finally:
            self._free.release()
        return answer

    def keep(self, names: Collection[str]) -> None:
        """End the calls of other services than these, which are gone; destroy their clients."""
        with self._lock:
            clients = [self._clients.pop(name) for name in self._clients.keys() - {*names}]
            futures = [future for future, name in self._pending.items() if name not in names]
        for future in futures:
            future.cancel()
        for client in clients:
            self._node.destroy_client(client)

    def close(self) -> None:
        """End all calls: viewers' threads wait for them."""
        self._ended.set()
        self.keep(())

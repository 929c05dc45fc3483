# SPDX-License-Identifier: Apache-2.0
"""Call services of the graph from threads other than the executor's, which must go on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import contextlib
import threading
from typing import Any

from foxglove import ServiceRequest
from rclpy.client import Client
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.task import Future

from fogros2.errors import FogError
from fogros2.waiting import wait_until

#: Number of calls of all viewers without an answer, and largest request in bytes.
CALLS, REQUEST = 64, 4_000_000
#: Time-out of the answer to a viewer's call, in seconds.
ANSWER = 60.0


class Services:
    """
    The clients of services, one for each service that was called.

    :param node: has the clients.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._clients: dict[str, Client] = {}
        self._free = threading.Semaphore(CALLS)
        self._ended = threading.Event()

    def call(self, requests: Mapping[str, tuple[Any, Any]], timeout: float) -> dict[str, Any]:
        """
        Call services at once; return the responses that come in time, by the services' names.

        :param requests: class and request of each service.
        :param timeout: in seconds.
        """
        with self._lock:
            for name in requests.keys() - self._clients.keys():
                self._clients[name] = self._node.create_client(requests[name][0], name)
            clients = {name: self._clients[name] for name in requests}
        sent: dict[str, Future] = {}

        def complete() -> bool:
            waiting = {name: client for name, client in clients.items()
                       if self._clients.get(name) == client  # else it is gone
                       and not (name in sent and sent[name].done())}
            for name, client in waiting.items():
                if name not in sent and client.service_is_ready():
                    sent[name] = client.call_async(requests[name][1])
            return not waiting

        with contextlib.suppress(RuntimeError):  # ours, or of a client that is just destroyed
            wait_until(complete, timeout=timeout, what='services', cancel=self._ended,
                       interval=0.002, longest=0.05)
        for name, future in sent.items():
            clients[name].remove_pending_request(future)
        return {name: future.result() for name, future in sent.items()
                if future.done() and future.exception() is None}

    def answer(self, cls: Any, given: ServiceRequest) -> bytes:
        """
        Call a service with a viewer's request, which may be any bytes.

        :param cls: class of the service.
        :raises RuntimeError: the bytes are no request, or there is no answer.
        """
        if len(given.payload) > REQUEST or not self._free.acquire(blocking=False):
            raise FogError(f'services take {REQUEST / 1e6:g} MB, and {CALLS} calls at once')
        try:
            name, request = given.service_name, deserialize_message(given.payload, cls.Request)
            if answers := self.call({name: (cls, request)}, ANSWER):
                return bytes(serialize_message(answers[name]))
            raise FogError(f'{name} is gone, or did not answer within {ANSWER:g} s')
        finally:
            self._free.release()

    def prune(self, served: Callable[[str], bool]) -> None:
        """Destroy the clients of services that nobody serves any more, which ends their calls."""
        with self._lock:
            clients = [self._clients.pop(name) for name in [*self._clients] if not served(name)]
        for client in clients:
            self._node.destroy_client(client)

    def close(self) -> None:
        """End all calls: viewers' threads wait for them."""
        self._ended.set()

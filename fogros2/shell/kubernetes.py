# SPDX-License-Identifier: Apache-2.0
"""
Run commands in a pod through the API server: the image needs no SSH server, the pod no open port.

One ``exec`` carries all commands (see ``multiplexer``), so a command takes one round trip.
"""

from __future__ import annotations

import contextlib
import threading
from typing import Optional

from fogros2.errors import ConnectError, DeadlineExceeded, FogError
from fogros2.shell.kubernetes_link import Link
from fogros2.shell.remote import MultiplexedShell
from fogros2.waiting import wait_until

#: Time-out of one attempt to connect, in seconds.
_ATTEMPT = 10.0


class KubernetesShell(MultiplexedShell):
    """
    A Shell for endpoints of kind 'kubernetes', whose host is ``namespace/pod@context``.

    :param name: the machine's name, for messages.
    :param timeout: seconds for which to try to connect.
    """

    @staticmethod
    def warm() -> None:
        """Start to import the client; see :func:`fogros2.shell.warm`."""
        threading.Thread(target=_load, name='fog-load', daemon=True).start()

    def _connect(self, timeout: float, cancel: Optional[threading.Event]) -> Link:
        """Open a connection; wait for an API server that restarts."""
        last: list[FogError] = []

        def attempt() -> Optional[Link]:
            try:
                return Link(self.endpoint, name=self.name, timeout=min(timeout, _ATTEMPT))
            except (ConnectError, DeadlineExceeded) as error:
                last[:] = [error]
                return None

        try:
            return wait_until(attempt, timeout=timeout, interval=0.1, cancel=cancel,
                              what=f"a connection to '{self.name}'")
        except DeadlineExceeded as error:
            raise last[0] if last else error from error


def _load() -> None:
    with contextlib.suppress(FogError, ImportError):
        from fogros2 import kubernetes_client
        kubernetes_client.connect()
        import websocket  # noqa: F401

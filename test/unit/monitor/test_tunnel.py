# SPDX-License-Identifier: Apache-2.0
"""A tunnel over a real Shell to a real port."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
import socket
import threading

import pytest

from fogros2.model import Endpoint
from fogros2.shell.local import LocalShell
from fogros2_monitor.tunnel import Tunnel


@pytest.fixture
def echo() -> Iterator[int]:
    """Serve a port that says everything twice."""
    def answer(link):
        with link, contextlib.suppress(OSError):
            while block := link.recv(65536):
                link.sendall(block * 2)

    def serve():
        with contextlib.suppress(OSError):
            while True:
                link, _ = listener.accept()
                threading.Thread(target=answer, args=(link,), daemon=True).start()

    with socket.create_server(('127.0.0.1', 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)
        thread.join(60)


@contextlib.contextmanager
def tunnel(port: int) -> Iterator[tuple[int, list[str]]]:
    said: list[str] = []
    shell = LocalShell(Endpoint('local'), name='here')
    made = Tunnel(shell, ('127.0.0.1', port), say=said.append)
    try:
        yield made.port, said
    finally:
        made.close()
        shell.close()
        assert made.ended.is_set()


def received(link: socket.socket, size: int) -> bytes:
    data = b''
    while len(data) < size:
        block = link.recv(size - len(data))
        if not block:
            break
        data += block
    return data


def test_tunnel_forwards_bytes_in_both_directions(echo):
    blocks = [os.urandom(size) for size in (1, 10, 32768, 200_000)]
    with tunnel(echo) as (port, said):
        links = [socket.create_connection(('127.0.0.1', port), timeout=20) for _ in range(2)]
        for block in blocks:
            for link in links:
                threading.Thread(target=link.sendall, args=(block,)).start()
            for link in links:
                answer = received(link, 2 * len(block))
                assert len(answer) == 2 * len(block)
                assert sorted(answer) == sorted(block * 2)
        for link in links:
            link.close()
    assert said == []


def test_unreachable_port_is_reported():
    # a port that is taken and refuses connections: no other program can answer there
    with socket.socket() as taken:
        taken.bind(('127.0.0.1', 0))
        closed = taken.getsockname()[1]
        with tunnel(closed) as (port, said):
            with socket.create_connection(('127.0.0.1', port), timeout=20) as link:
                assert link.recv(1) == b''
    assert said == [f'nothing answers at 127.0.0.1:{closed} there']


def test_closed_tunnel_ends_its_connections(echo):
    with tunnel(echo) as (port, _):
        link = socket.create_connection(('127.0.0.1', port), timeout=20)
        link.sendall(b'x')
        assert received(link, 2) == b'xx'
    with link:
        assert link.recv(1) == b''

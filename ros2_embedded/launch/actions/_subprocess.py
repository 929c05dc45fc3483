# SPDX-License-Identifier: Apache-2.0
"""Starts processes in the event loop, on pipes or on pseudo-terminals."""
from __future__ import annotations

import asyncio
import functools
import os
from typing import Any, Callable, cast, Dict, List, Optional, Tuple

OnData = Callable[[bytes], None]


class Protocol(asyncio.SubprocessProtocol):
    """
    Hands on what a process writes.

    :param on_start: called with the process's id as soon as there is one.
    """

    def __init__(
        self, on_start: Callable[[int], None], on_stdout: OnData, on_stderr: OnData
    ) -> None:
        self.complete: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self.__on_start = on_start
        self.on_data = {1: on_stdout, 2: on_stderr}
        self.__transport: Optional[asyncio.SubprocessTransport] = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.__transport = cast(asyncio.SubprocessTransport, transport)
        self.__on_start(self.__transport.get_pid())

    def pipe_data_received(self, fd: int, data: bytes) -> None:
        self.on_data[fd](data)

    def process_exited(self) -> None:
        assert self.__transport is not None
        if not self.complete.done():
            self.complete.set_result(cast(int, self.__transport.get_returncode()))


class _TerminalReader(asyncio.Protocol):

    def __init__(self, on_data: OnData) -> None:
        self.__on_data = on_data

    def data_received(self, data: bytes) -> None:
        self.__on_data(data)


async def start_process(
    make_protocol: Callable[[], Protocol], *, cmd: List[str], cwd: Optional[str],
    env: Optional[Dict[str, str]], shell: bool, emulate_tty: bool
) -> Tuple[asyncio.SubprocessTransport, Protocol]:
    """
    Start a process, in this process group, with a pipe as standard input.

    :param shell: whether ``cmd``, joined by spaces, goes to a shell.
    :param emulate_tty: whether standard output and error are pseudo-terminals.
    :raises OSError: if it can't be started.
    """
    loop = asyncio.get_running_loop()
    # What isn't meant to be inherited is marked so; closing one by one would only take time.
    kwargs: Dict[str, Any] = {'cwd': cwd, 'env': env, 'close_fds': False}
    masters: List[int] = []
    slaves: List[int] = []
    try:
        if emulate_tty:
            for name in ('stdout', 'stderr'):
                master, slave = os.openpty()
                masters.append(master)
                slaves.append(slave)
                kwargs[name] = slave
        if shell:
            transport, protocol = await loop.subprocess_shell(
                make_protocol, ' '.join(cmd), **kwargs)
        else:
            transport, protocol = await loop.subprocess_exec(make_protocol, *cmd, **kwargs)
    except BaseException:
        for master in masters:
            os.close(master)
        raise
    finally:
        for slave in slaves:
            os.close(slave)
    for fd, master in enumerate(masters, 1):
        await loop.connect_read_pipe(
            functools.partial(_TerminalReader, protocol.on_data[fd]),
            os.fdopen(master, 'rb', 0))
    return transport, protocol

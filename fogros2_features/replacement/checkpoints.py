# SPDX-License-Identifier: Apache-2.0
"""Save the folders of a machine's nodes at intervals, and restore them where the nodes start."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
import contextlib
import logging
from pathlib import Path
import threading
import time
from typing import Any, Optional, Protocol
import zlib

from launch import LaunchContext

from fogros2.errors import FogError, ShellError
from fogros2.model import Endpoint, MachineSpec, NodeSpec
from fogros2.runtime.node_spec import full_name
from fogros2.shell import connect, Shell
from fogros2_features.replacement.options import Options
from fogros2_features.replacement.snapshots import Checkpoint

#: Seconds that the nodes have to answer ``~/checkpoint``.
ANSWER = 5.0


class Nodes(Protocol):
    """The nodes of one machine, as a session has them."""

    spec: MachineSpec
    own: Options
    #: See ``machine_state``.
    phase: str

    @property
    def shell(self) -> Optional[Shell]:
        """The shell of the machine, None while the machine does not run the nodes."""

    def nodes(self) -> list[NodeSpec]:
        """Return the nodes that have started."""

    def request(self, function: Callable[[], Any]) -> None:
        """Run a coroutine function; the launch waits for it on its way down."""


class Checkpoints:
    """
    The checkpoints of one machine, on launch's event loop.

    :param store: folder of the snapshots.
    :param suffix: of a folder on the robot that was there before.
    :param in_thread: runs a blocking function in a thread.
    """

    def __init__(
        self, session: Nodes, context: LaunchContext, store: Path, suffix: str,
        cancel: Optional[threading.Event], *, in_thread: Callable[..., asyncio.Future[Any]],
        logger: logging.Logger,
    ) -> None:
        self.robot = connect(Endpoint('local'), name='robot')
        self._session = session
        self._context = context
        self._store = store
        self._suffix = suffix
        self._cancel = cancel
        self._in_thread = in_thread
        self._logger = logger
        self._folders: dict[str, Checkpoint] = {}
        self._clients: dict[str, Any] = {}
        self._order = asyncio.Lock()
        #: The last warning of a folder, while it is not copied.
        self._warned: dict[str, str] = {}
        if session.own.checkpoint:
            self.add(session.own.checkpoint)

    def __bool__(self) -> bool:
        return bool(self._folders)

    @property
    def folders(self) -> list[str]:
        """The folders."""
        return list(self._folders)

    def add(self, folder: str) -> None:
        """Add a folder, as ``check_folder`` returns it."""
        if not self._folders:
            self._later()
        # a number, because the path may be too long for a file name
        self._folders[folder] = Checkpoint(
            folder, self._store / f'{zlib.crc32(folder.encode()):08x}', self._cancel)

    def _later(self, duration: float = 0.0) -> None:
        interval = self._session.own.checkpoint_interval
        # a state is as old as the begin of its copy, until the next copy, which may take longer
        self._context.asyncio_loop.call_later(
            max(interval - 3 * duration, interval / 10), self._due)

    def _due(self) -> None:
        async def save() -> None:
            begin = self._context.asyncio_loop.time()
            await self.take()
            self._later(self._context.asyncio_loop.time() - begin)
        if not (self._context.is_shutdown or self._session.phase == 'over'):
            self._session.request(save)

    async def take(self) -> None:
        """Copy the folders of the machine now, unless a node refuses."""
        ready = await self.ask() if self._session.shell else False
        # the machine may have been interrupted meanwhile
        if ready is not False and (shell := self._session.shell):
            await self.save(shell, still=bool(ready))

    async def ask(self) -> Optional[bool]:
        """
        Ask the nodes that offer ``~/checkpoint`` to make their files consistent.

        :return: None if no node offers it; False if one has refused or did not answer.
        """
        nodes = self._session.nodes() if self else []
        answers: list[bool] = await self._in_thread(self._ask, nodes) if nodes else []
        return all(answers) if answers else None

    def _ask(self, nodes: list[NodeSpec]) -> list[bool]:
        from launch_ros.ros_adapters import get_ros_node
        from rclpy.exceptions import InvalidHandle, NameValidationException
        from std_srvs.srv import Trigger
        waits, until = [], time.monotonic() + ANSWER
        try:
            for name in map(full_name, nodes):
                if name not in self._clients:
                    self._clients[name] = None
                    # without name=, the name is a program's, such as slam.py, and no ROS name
                    with contextlib.suppress(NameValidationException, ValueError):
                        self._clients[name] = get_ros_node(self._context).create_client(
                            Trigger, f'{name}/checkpoint')
                client = self._clients[name]
                if client is not None and client.service_is_ready():
                    future, answered = client.call_async(Trigger.Request()), threading.Event()
                    future.add_done_callback(lambda _, answered=answered: answered.set())
                    waits.append((future, answered))
        except InvalidHandle:
            return [False]  # the launch is ending and has destroyed its node
        return [answered.wait(max(0.0, until - time.monotonic())) and future.result().success
                for future, answered in waits]

    async def save(self, shell: Shell, *, still: bool) -> None:
        """Copy the folders of a machine, or of the robot; warn of a folder that is not copied."""
        await self._each(lambda folder: folder.save(shell, still=still), 'has no new checkpoint')

    async def restore(self, shell: Shell) -> None:
        """Write the newest snapshots to a machine, or to the robot; warn if there is none."""
        robot = shell is self.robot

        def act(folder: Checkpoint) -> None:
            # said once: nodes leave a machine by way of the robot
            if not folder.restore(shell, self._suffix if robot else '') and robot:
                raise ShellError('the launch has no copy of it',
                                 'do the nodes write there, and not to a folder of a container?')

        await self._each(act, 'is not restored')

    async def _each(self, act: Callable[[Checkpoint], object], failed: str) -> None:
        async with self._order:
            for folder in list(self._folders.values()):
                try:
                    await self._in_thread(act, folder)
                    self._warned.pop(folder.folder, None)
                except FogError as error:
                    text = f'{self._session.spec.name}: {folder.folder} {failed}: {error}'
                    if text != self._warned.get(folder.folder) and not self._context.is_shutdown:
                        self._logger.warning(text)
                    self._warned[folder.folder] = text

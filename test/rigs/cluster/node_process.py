# SPDX-License-Identifier: Apache-2.0
"""The node's program as a child of this process, as root for any user."""

from __future__ import annotations

from collections.abc import Mapping
import json
import os
from pathlib import Path
import secrets
import select
import socket
import subprocess
import sys
import tempfile
from typing import Any, Optional

from fogros2 import process
from fogros2.errors import FogError
from fogros2.model import Command
from rigs.cluster import node


class ClusterError(FogError):
    """The cluster of the tests doesn't do what it should."""


class NodeProcess:
    """
    A running node; it ends with this process at the latest.

    :param folder: the node's, see ``node``; gone once the node has ended.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._errors = tempfile.TemporaryFile()
        self._child = process.start(
            Command((sys.executable, '-I', node.__file__, str(folder)), sudo=True),
            environment=os.environ, stdin=subprocess.PIPE, stderr=self._errors.fileno())

    def await_line(self, timeout: float) -> Optional[dict[str, Any]]:
        """
        Return the next thing the node says, None when it has ended.

        :raises ClusterError: it failed, was killed, or said nothing.
        """
        assert self._child.stdout is not None
        if not select.select([self._child.stdout], [], [], timeout)[0]:
            raise ClusterError(f'the node has not answered within {timeout:g} s')
        line = self._child.stdout.readline()
        said: Optional[dict[str, Any]] = json.loads(line) if line else None
        if said and 'failed' in said:
            raise ClusterError(f"the tests' cluster: {said['failed']}")
        if said is None and (status := self._child.wait(60.0)) != 0:
            self._errors.seek(0)
            lines = self._errors.read().decode(errors='replace').splitlines()[-15:]
            raise ClusterError('\n'.join((
                f"the tests' cluster: its node ended with exit status {status}", *lines)))
        return said

    def wait(self, timeout: float = 300.0) -> None:
        """
        Wait for a node that ends by itself.

        :raises ClusterError: it failed.
        """
        try:
            while self.await_line(timeout) is not None:
                pass
        finally:
            self.stop()

    def stop(self) -> None:
        """End it with all that runs in it, and wait until everything is gone."""
        assert self._child.stdin is not None and self._child.stdout is not None
        self._child.stdin.close()
        self._child.wait(60.0)
        self._child.stdout.close()
        self._errors.close()


def run_node(
    runs: Path, plan: Mapping[str, Any], files: Mapping[str, str], *, name: str = '',
) -> NodeProcess:
    """
    Start a node in a new folder.

    :param runs: the folder of all nodes of this user.
    :param plan: see ``node.Node``.
    :param files: name below the node's folder, contents.
    :param name: of the node's folder.
    """
    runs.mkdir(parents=True, exist_ok=True)
    folder = runs / (name or secrets.token_hex(3))
    folder.mkdir(mode=0o700)
    for name, text in {**files, 'node.json': json.dumps(
            {**plan, 'owner': [os.getuid(), os.getgid()]})}.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), 'w') as file:
            file.write(text)
    return NodeProcess(folder)


def ask(folder: Path, question: Mapping[str, Any], timeout: float = 70.0) -> dict[str, Any]:
    """Have the node in a folder carry out a command, see ``node.Node.answer``."""
    with socket.socket(socket.AF_UNIX) as caller:
        caller.settimeout(timeout)
        # the path may be longer than an address may be: by way of the open folder it isn't
        opened = os.open(folder, os.O_PATH)
        try:
            caller.connect(f'/proc/self/fd/{opened}/control')
        finally:
            os.close(opened)
        with caller.makefile('rwb') as stream:
            stream.write(json.dumps(question).encode() + b'\n')
            stream.flush()
            line = stream.readline()
    if not line:
        raise ClusterError('the node ended before it answered')
    reply: dict[str, Any] = json.loads(line)
    return reply

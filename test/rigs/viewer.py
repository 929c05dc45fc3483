# SPDX-License-Identifier: Apache-2.0
"""Foxglove's own client (npm's ``@foxglove/ws-protocol``, run by Node), driven by a test."""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path
import queue
import shutil
import subprocess
import sys
import threading
import time
from typing import Any, Optional

#: Seconds in which a registry has to answer.
TIMEOUT = 40.0


def install(source: Path, cache: Path) -> str:
    """
    Install the client where it isn't yet.

    :param source: folder with its ``package.json`` and its programs.
    :param cache: folder to install it to.
    :return: why it can't be, '' if it is there.
    """
    cache.mkdir(parents=True, exist_ok=True)
    wanted = (source / 'package.json').read_bytes()
    with open(cache / 'lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # several runs of tests may come at once
        done = cache / 'installed.json'
        if not done.exists() or done.read_bytes() != wanted:
            npm = program('npm')
            if npm is None:
                return 'needs npm'
            shutil.copy(source / 'package.json', cache)
            try:
                made = subprocess.run(
                    [npm, 'install', '--no-package-lock', '--no-audit', '--no-fund',
                     f'--cache={cache / "npm"}',
                     '--fetch-retries=1', f'--fetch-timeout={TIMEOUT * 500:.0f}'],
                    cwd=cache, env=_environment(), capture_output=True, text=True,
                    stdin=subprocess.DEVNULL, timeout=TIMEOUT)
            except subprocess.TimeoutExpired:
                return f'npm reaches no registry within {TIMEOUT:g} s'
            if made.returncode:
                return f'npm could not install the client: {(made.stderr or made.stdout)[-300:]}'
            done.write_bytes(wanted)
        for each in source.glob('*.mjs'):
            # to where its modules are found from, unless it is there: another run may read it
            target = cache / each.name
            if not target.exists() or target.read_bytes() != each.read_bytes():
                shutil.copy(each, target)
    return ''


def program(name: str) -> Optional[str]:
    """Return the path of ``node`` or ``npm``, None without."""
    return shutil.which(name, path=_environment()['PATH'])


def _environment() -> dict[str, str]:
    """Return variables with the computer's own Node first: it knows its registry."""
    own = os.path.dirname(sys.executable)
    others = [folder for folder in os.environ.get('PATH', '').split(os.pathsep) if folder != own]
    return {**os.environ, 'PATH': os.pathsep.join([*others, own])}


class Viewer:
    """
    A viewer in a process of its own.

    :param cache: where :func:`install` put the client.
    :param url: the bridge's, ``ws://`` or ``wss://``.
    """

    def __init__(self, cache: Path, url: str) -> None:
        node = program('node')
        assert node is not None
        self._process = subprocess.Popen(
            [node, str(cache / 'viewer.mjs'), url], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, text=True, env=_environment())
        self._told: queue.Queue[dict[str, Any]] = queue.Queue()
        self._kept: list[dict[str, Any]] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._told.put(json.loads(line))

    def wish(self, **what: Any) -> None:
        """Have it do something; see viewer.mjs."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(what) + '\n')
        self._process.stdin.flush()

    def until(self, key: str, value: Any = None) -> dict[str, Any]:
        """Return the next of what it tells that has ``key``, and under it ``value`` if given."""
        def fits(told: dict[str, Any]) -> bool:
            return key in told and value in (None, told[key])

        for told in self._kept:
            if fits(told):
                self._kept.remove(told)
                return told
        deadline = time.monotonic() + 60.0
        while True:
            told = self._told.get(timeout=max(0.0, deadline - time.monotonic()))
            if fits(told):
                return told
            self._kept.append(told)

    def unread(self) -> list[dict[str, Any]]:
        """Return what it has told so far and nobody has waited for."""
        while not self._told.empty():
            self._kept.append(self._told.get())
        return self._kept

    def look(self, topic: str) -> dict[str, Any]:
        """Look at a topic once it is there; return its channel."""
        channel = self.until('channel', topic)
        self.wish(subscribe=topic)
        return channel

    def message(self, topic: str) -> Any:
        """Return the next message of a topic, bytes in base64 where it isn't CDR."""
        return self.until('topic', topic)['message']

    def close(self) -> None:
        """Send it away."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(60)
        self._process.stdout.close()

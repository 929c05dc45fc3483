# SPDX-License-Identifier: Apache-2.0
"""``ros2 launch`` as a process of a test's own, and what it says."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
from importlib import metadata
import os
import signal
import subprocess
import sys
import threading
import time
from typing import Any, Optional

from fogros2.waiting import wait_until

ROS2 = 'ros2'
#: Part of a script that is a node: the bytes that the launch's VPN has carried.
VPN_TRAFFIC = """
import os
from pathlib import Path


def vpn_traffic():
    # .../launches/ID/dds.xml
    launch = next(os.environ[name] for name in (
        'FASTRTPS_DEFAULT_PROFILES_FILE', 'CYCLONEDDS_URI', 'ZENOH_SESSION_CONFIG_URI')
        if name in os.environ).split('/')[-2]
    return sum(int(path.read_text()) for path in Path(
        f'/sys/class/net/fog{launch}/statistics').glob('[rt]x_bytes'))
"""


def embedded() -> bool:
    """Return whether the tests run on the wheels of ROS 2, with our own launch."""
    try:
        metadata.distribution('ros2-embedded')
    except metadata.PackageNotFoundError:
        return False
    return True


class Launched:
    """
    A ``ros2 launch`` process, its output read all the time.

    :param words: what follows ``ros2 launch``, or another program.
    :param environment: its variables, this process's unless given.
    :param prefix: words before ``ros2``, such as what leads into a network namespace.
    """

    def __init__(
        self, *words: str, environment: Optional[Mapping[str, str]] = None,
        prefix: Sequence[str] = (), program: Sequence[str] = (ROS2, 'launch'),
    ) -> None:
        self.said: list[str] = []
        #: When each line came, on ``time.monotonic``'s clock.
        self.times: list[float] = []
        self.child = subprocess.Popen(
            [*WITH_SIGINT, *prefix, *program, *words], stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors='replace',
            env=None if environment is None else dict(environment))
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.child.stdout is not None
        for line in self.child.stdout:
            # a computer of the tests is a container, and has no control groups (version 2)
            if 'DDS filter failed' in line and ' robot: ' not in line:
                continue
            self.times.append(time.monotonic())
            self.said.append(line)

    def since(self, begin: float, words: str) -> list[tuple[float, str]]:
        """Return the lines with ``words`` that came after ``begin``, each with its time."""
        return [(at, line) for at, line in zip(list(self.times), list(self.said))
                if at > begin and words in line]

    @property
    def text(self) -> str:
        """All that it has said so far."""
        return ''.join(list(self.said))

    @property
    def errors(self) -> list[str]:
        """The lines it has logged as errors."""
        return [line.rstrip() for line in list(self.said) if '[ERROR]' in line]

    @property
    def clean(self) -> bool:
        """Whether nothing that it has said would worry a user; Ctrl-C is a warning to launch."""
        others = self.text.replace('[WARNING] [launch]: user interrupted with ctrl-c', '')
        return self.errors == [] and 'WARNING' not in others and 'Traceback' not in others

    def wait_for(self, words: str, *, times: int = 1, timeout: float = 180.0) -> None:
        """
        Wait until lines with ``words`` came.

        :raises AssertionError: the launch ended before.
        """
        def there() -> bool:
            ended = self.child.poll() is not None
            if ended:
                self._reader.join(5.0)
            if sum(words in line for line in list(self.said)) >= times:
                return True
            assert not ended, f'the launch ended before {words!r}:\n{self.text}'
            return False

        try:
            wait_until(there, timeout=timeout, what=repr(words), longest=0.05)
        except RuntimeError as error:
            raise AssertionError(f'{error}:\n{self.text}') from error

    def interrupt(self) -> None:
        """Press Ctrl-C."""
        self.child.send_signal(signal.SIGINT)

    def ended(self, timeout: float = 180.0) -> int:
        """
        Wait for its end and return the exit status.

        :raises AssertionError: it goes on.
        """
        try:
            code = self.child.wait(timeout)
        except subprocess.TimeoutExpired:
            raise AssertionError(f'the launch goes on:\n{self.text}') from None
        self._reader.join(5.0)
        return code

    def kill(self) -> None:
        """End it and all that it started here with SIGKILL."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.child.pid, signal.SIGKILL)
        self.child.kill()  # it may not have come to make the group
        self.ended(60.0)


@contextlib.contextmanager
def launching() -> Iterator[Callable[..., Launched]]:
    """Yield what starts launches; those that still run at the block's end are ended, in order."""
    started: list[Launched] = []

    def start(*words: str, **named: Any) -> Launched:
        started.append(Launched(*words, **named))
        return started[-1]

    try:
        yield start
    finally:
        for launch in started:
            if launch.child.poll() is None:
                launch.interrupt()
        for launch in started:
            try:
                launch.ended()
            finally:
                launch.kill()


def ros2(
    *words: str, environment: Optional[Mapping[str, str]] = None, timeout: float = 180.0,
    prefix: Sequence[str] = (),
) -> subprocess.CompletedProcess[str]:
    """Run ``ros2`` with these words and return what it left; nobody is there to be asked."""
    return subprocess.run(
        [*prefix, ROS2, *words], stdin=subprocess.DEVNULL, capture_output=True, text=True,
        timeout=timeout, env=None if environment is None else dict(environment))


#: The background jobs of a shell ignore SIGINT, and what nohup starts ignores SIGHUP.
#: A group of its own, not a session: sudo's ticket is the terminal's, and goes for its session.
WITH_SIGINT: Sequence[str] = (
    sys.executable, '-c', 'import os, signal, sys; '
    'os.setpgrp(); signal.signal(signal.SIGINT, signal.default_int_handler); '
    'signal.signal(signal.SIGHUP, signal.SIG_DFL); '
    'os.execvp(sys.argv[1], sys.argv[1:])')

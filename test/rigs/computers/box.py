# SPDX-License-Identifier: Apache-2.0
"""The box as a test holds it: a context manager around the process that does the work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
import json
import os
from pathlib import Path
import secrets
import subprocess
import sys
import tempfile
import threading
from typing import Any, ClassVar, Optional

from fogros2 import process
from fogros2.model import Command
from fogros2.provider.container import root as container_root
from fogros2.waiting import wait_until
from rigs.computers.network import ROBOT, ROBOT_ELSEWHERE, ROUTER
from rigs.computers.server import PORT


@dataclasses.dataclass(frozen=True)
class Instance:
    """
    What a box knows of an instance.

    :param computer: whether its computer is on.
    :param asked: when its start was asked for (seconds since the epoch).
    :param ready: when its SSH server answered, 0 before.
    :param reason: code of what made it end.
    """

    id: str
    region: str
    state: str
    type: str
    image: str
    zone: str
    spot: bool
    public: str
    private: str
    reason: str
    computer: bool
    asked: float
    ready: float
    tags: Mapping[str, str]


@dataclasses.dataclass(frozen=True)
class Call:
    """A request to the box's AWS, and the error code it was answered with, '' for none."""

    service: str
    region: str
    action: str
    error: str


class Box:
    """
    A cloud in a box: its API, and for each instance a container that is its computer.

    An instance boots with its key and its user data (a small cloud-init, see ``guest.py``), has a
    real sshd, its metadata service, its firewall enforced, its disk kept over a stop, and
    ends when something in it says ``shutdown``. Images are copies of disks. Every address is one
    of TEST-NET-2 in a network namespace that nothing leads out of; the robot has a namespace
    beside it, behind something like a home's NAT.

    It takes root (or sudo without a password), podman and ``werkzeug``. All of it goes when
    the block ends, or the process of the test, however that happens.

    :param mounts: folders of this computer that every instance sees, read-only; None for this
        Python environment and ROS 2, as an image made for it would have them.
    :param volumes: an instance may mount disks, which are loop devices of this computer.
    """

    #: Module of the process.
    SERVER: ClassVar[str]
    #: Regions whose API hosts the robot can connect to.
    REGIONS: ClassVar[Sequence[str]]

    def __init__(
        self, *, mounts: Optional[Sequence[str]] = None, volumes: bool = False,
    ) -> None:
        self.mark = secrets.token_hex(2)
        self.endpoint = ''
        self.robot = ''
        self._settings = {
            'mark': self.mark, 'regions': list(self.REGIONS), 'volumes': volumes,
            'mounts': container_root.environment_mounts(None) if mounts is None
            else list(mounts)}
        self._child: Optional[subprocess.Popen[str]] = None
        self._folder: Optional[tempfile.TemporaryDirectory[str]] = None
        self._lock = threading.Lock()

    def __enter__(self: Any) -> Any:
        """Open the box; a second or two."""
        self._folder = tempfile.TemporaryDirectory(prefix='fogt-box-')
        words = process.argv(Command(
            (sys.executable, '-m', self.SERVER), sudo=True))
        with open(self.log, 'w') as log:
            # a group, no session: sudo's ticket is the terminal's, and Ctrl-C there the test's
            self._child = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True,
                preexec_fn=os.setpgrp)
        try:
            opened = self._ask(self._settings)
        except BaseException:
            self.close()
            raise
        self.endpoint = f"http://127.0.0.1:{opened['port']}"
        self.robot = str(opened['robot'])
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Take everything away; returns when it is gone."""
        child, self._child = self._child, None
        if child is not None:
            assert child.stdin is not None and child.stdout is not None
            try:
                child.stdin.close()
                child.wait(90.0)
            finally:
                child.stdout.close()
                if child.poll() is None:
                    child.kill()
                    child.wait(60.0)
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    @property
    def log(self) -> Path:
        """The file that the box's process complains to."""
        assert self._folder is not None, 'the box is closed'
        return Path(self._folder.name, 'log')

    def _ask(self, order: Mapping[str, Any]) -> Any:
        with self._lock:
            child = self._child
            assert child is not None and child.stdin is not None and child.stdout is not None, \
                'the box is closed'
            child.stdin.write(json.dumps(order) + '\n')
            child.stdin.flush()
            line = child.stdout.readline()
        if not line:
            raise RuntimeError(f'the box died:\n{self.log.read_text()}')
        answer = json.loads(line)
        if not answer['ok']:
            raise RuntimeError(f"{answer['error']}\n{self.log.read_text()}")
        return answer['value']

    # -- how to reach it ------------------------------------------------------------------

    @property
    def inside(self) -> str:
        """Address (HTTP) of the API for programs on the robot."""
        return f'http://{ROUTER}:{PORT}'

    @property
    def checkip(self) -> str:
        """Address (HTTP) that tells a program on the robot which address it comes from."""
        return f'{self.inside}/checkip'

    def on_robot(self, words: Sequence[str]) -> list[str]:
        """Return the command line that runs ``words`` on the robot, as this user."""
        # `ip netns exec` hides the control groups of the host
        inside = ['ip', 'netns', 'exec', self.robot, 'sh', '-c',
                  'mount -t cgroup2 cgroup2 /sys/fs/cgroup && exec "$@"', 'sh']
        if os.geteuid() == 0:
            return [*inside, *words]
        # sudo has a path of its own, and its loader drops the libraries'
        kept = [f'{name}={os.environ[name]}' for name in ('PATH', 'LD_LIBRARY_PATH')
                if name in os.environ]
        return ['sudo', '-n', '--preserve-env', *inside, 'setpriv', f'--reuid={os.getuid()}',
                f'--regid={os.getgid()}', '--init-groups', '--', 'env', *kept, *words]

    def move_robot(self, *, back: bool = False) -> str:
        """Give the robot another address, and return it."""
        address = ROBOT if back else ROBOT_ELSEWHERE
        self._ask({'do': 'move_robot', 'address': address})
        return address

    # -- what happened --------------------------------------------------------------------

    def calls(self) -> list[Call]:
        """Return the requests so far."""
        return [Call(**call) for call in self._ask({'do': 'calls'})]

    def forget_calls(self) -> None:
        """Begin anew with the record of requests."""
        self._ask({'do': 'clear_calls'})

    def instances(self) -> list[Instance]:
        """Return every instance there ever was."""
        return [Instance(**found) for found in self._ask({'do': 'instances'})]

    def alive(self) -> list[Instance]:
        """Return the instances that somebody pays for."""
        return [found for found in self.instances() if found.state != 'terminated']

    def wait_for(
        self, instance: str, *states: str, timeout: float = 30.0, computer: bool = False,
    ) -> Instance:
        """
        Wait until an instance is in one of these states.

        :param computer: and its computer is on.
        :raises DeadlineExceeded: it isn't.
        """
        def look() -> Optional[Instance]:
            found = next(i for i in self.instances() if i.id == instance)
            fits = found.state in states and (found.computer or not computer)
            return found if fits else None

        return wait_until(look, timeout=timeout, longest=0.1,
                          what=f"{instance} to be {' or '.join(states)}")

    def run(self, instance: str, script: str, *, check: bool = True) -> str:
        """
        Run a script on an instance as root, not by SSH, and return what it printed.

        :param check: raise an error if it fails, as one that ends the instance may.
        """
        return str(self._ask({'do': 'run', 'instance': instance, 'script': script,
                              'check': check}))

    def user_data(self, instance: str) -> bytes:
        """Return what the launch gave an instance for its first boot."""
        return bytes.fromhex(self._ask({'do': 'user data', 'instance': instance}))

    # -- what goes wrong ------------------------------------------------------------------

    def interrupt(self, instance: str, *, notice: float) -> None:
        """Take a spot instance away, told to it ``notice`` seconds before."""
        self._ask({'do': 'interrupt', 'instance': instance, 'notice': notice})

    def slow(self, pattern: str = '', seconds: float = 0.0) -> None:
        """Carry out requests so late whose method, path and body fit the pattern; '' for none."""
        self._ask({'do': 'slow', 'pattern': pattern, 'seconds': seconds})

    def held(self) -> int:
        """Return how many slow requests are under way."""
        return int(self._ask({'do': 'held'}))

    def set_boot_delay(self, seconds: float) -> None:
        """Let the next instances take that long to boot."""
        self._ask({'do': 'boot_delay', 'seconds': seconds})

# SPDX-License-Identifier: Apache-2.0
"""Call podman or docker: choose one that works here, with its flags; translate its errors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import dataclasses
import json
import math
import os
from pathlib import Path
import re
import resource
import threading
from typing import Any, Optional, TypeVar

from fogros2 import process
from fogros2.errors import CommandError, ConfigurationError, PrerequisiteError, ProviderError
from fogros2.model import Command, Result

T = TypeVar('T')
ENGINES = ('podman', 'docker')
DOCKER_SOCKET = Path('/var/run/docker.sock')
#: How an engine had to be called in this process, by its name.
_WORKED: dict[str, Engine] = {}
#: Remedies by what an engine's messages contain, in lower case; the first one applies.
_HINTS = {
    'overlay.*(invalid argument|not supported)|(invalid argument|not supported).*overlay':
        "this root file system can't be overlaid: name an image with image='...'",
    'network of its own': 'network= takes a bridge network: podman network ls',
    'packet filter': 'use a kernel with nftables for bridges (nf_tables, bridge family)',
    'short-name.*did not resolve|manifest unknown|pull access denied|name unknown':
        "image= takes the name of an image, such as 'docker.io/library/ros:jazzy-ros-base'",
    'no space left': 'the disk is full',
    'exec format error': f'the image has to be for {os.uname().machine} processors',
    'rlimit|cgroup': 'see `ros2 fog doctor`',
    '/dev/net/tun': 'sudo modprobe tun',
    'address already|already allocated': 'that port is taken: choose another',
    'no such network|network.*not found|not found.*network':
        'podman network ls (or docker network ls) shows those there are',
}


@dataclasses.dataclass(frozen=True)
class Engine:
    """
    A container engine, and how to call it on this computer.

    :param name: podman or docker.
    :param flags: options between the program's name and the sub-command.
    :param sudo: whether it needs root.
    """

    name: str
    flags: tuple[str, ...] = ()
    sudo: bool = True

    def argv(self, *words: str) -> tuple[str, ...]:
        """Return the command line of a sub-command."""
        return (self.name, *self.flags, *words)

    def call(self, *words: str, what: str, timeout: float = 60.0, check: bool = True,
             data: bytes = b'', variables: Sequence[str] = (), kept: float = math.inf,
             cancel: Optional[threading.Event] = None) -> Result:
        """
        Run a sub-command.

        :param variables: of its environment, as NAME=VALUE.
        :param kept: see :func:`fogros2.process.run`.
        :raises ProviderError: the sub-command failed, and ``check`` is set.
        """
        argv = self.argv(*words)
        if variables:
            argv = ('env', *variables, *argv)  # sudo passes none on
        command = Command(argv, sudo=self.sudo, input=data, what=what)
        try:
            return process.run(command, timeout=timeout, check=check, cancel=cancel, kept=kept)
        except CommandError as error:
            raise translate(error) from error

    def inspect(self, names: Sequence[str]) -> list[dict[str, Any]]:
        """Return the engine's reports of containers; omit containers that do not exist."""
        result = self.call('container', 'inspect', *names, what='look at containers', check=False)
        reports = json.loads(result.stdout) if result.stdout.strip() else []
        if result.returncode != 0 and not gone(result.stderr):
            raise ProviderError(f'{self.name} failed: {process.last_error(result.stderr)}',
                                sudo_hint(result.stderr))
        return [dict(entry) for entry in reports or ()]


def gone(text: str) -> bool:
    """Return whether an engine's message says that there is no such container."""
    return 'no such container' in text.lower() or 'no such object' in text.lower()


def stopped(text: str) -> bool:
    """Return whether docker's program says that its service does not run."""
    return bool(re.search('docker daemon|docker api', text.lower())) \
        and 'permission denied' not in text.lower()


def sudo_hint(text: str) -> str:
    """Return the remedy if sudo refused, or ''."""
    if 'password is required' in text or 'a terminal is required' in text:
        return process.PASSWORD[1]
    return ''


def architecture(engine: Engine, image: str) -> str:
    """
    Return the processor architecture of an image, as ``uname -m`` has it.

    :returns: '' for an image that is not on this computer yet, and for other architectures.
    """
    result = engine.call('image', 'inspect', '--format', '{{.Architecture}}', image,
                         what='looking at the image', check=False)
    return {'amd64': 'x86_64', 'arm64': 'aarch64'}.get(result.stdout.strip(), '')


def check_architecture(engine: Engine, image: str) -> None:
    """
    Check that programs of an image run on this computer.

    :raises ConfigurationError: it is for another processor architecture, without an emulator.
    """
    built, here = architecture(engine, image), os.uname().machine
    if built in ('', here):
        return
    tried = engine.call('run', '--rm', '--network', 'none', '--entrypoint', '/bin/sh', *limits(),
                        image, '-c', ':', what='trying the image', check=False)
    if 'exec format error' in tried.stderr.lower():
        raise ConfigurationError(
            f"the image '{image}' is for {built} processors, and this computer has {here}",
            f'{engine.name} rmi {image}, then get the one for {here}')


def translate(error: CommandError) -> ProviderError:
    """Return the error for an engine's failure, with a remedy if one is known."""
    text = error.result.stderr
    hint = next((hint for pattern, hint in _HINTS.items()
                 if re.search(pattern, text.lower(), re.DOTALL)), sudo_hint(text))
    return ProviderError(f'{error.command.what} failed: {process.last_error(text)}', hint)


def select(wanted: str, image: str = '') -> Engine:
    """
    Return the engine to create a machine with: the requested one, or the first that is installed.

    :raises PrerequisiteError: it is not installed.
    """
    if wanted == 'podman' or (wanted == 'auto' and (not image or process.which('podman'))):
        if not process.which('podman'):
            raise PrerequisiteError('podman not found on this computer',
                                    'sudo apt-get install podman')
        return podman()
    if not process.which('docker'):
        raise PrerequisiteError(
            'no container engine found on this computer', 'sudo apt-get install podman')
    return docker()


def installed() -> Iterator[Engine]:
    """Yield the engines that can have containers."""
    if process.which('podman'):
        yield podman()
    if process.which('docker') and (DOCKER_SOCKET.exists() or os.environ.get('DOCKER_HOST')):
        yield docker()


def named(name: str) -> Engine:
    """Return the engine that a machine's id names."""
    return _WORKED.get(name) or (podman() if name == 'podman' else docker())


def podman() -> Engine:
    """Return podman, with the flags for this computer's control groups."""
    return Engine('podman', flags_for(
        unified=Path('/sys/fs/cgroup/cgroup.controllers').exists(),
        systemd=Path('/run/systemd/system').exists(),
        runc=process.which('runc') is not None))


def docker() -> Engine:
    """Return docker; with sudo, if this user cannot write to its socket."""
    return Engine('docker', sudo=not (
        os.environ.get('DOCKER_HOST') or os.access(DOCKER_SOCKET, os.W_OK)))


def tried(engine: Engine, create: Callable[[Engine], T]) -> T:
    """
    Create a container by the first way to call an engine that works; remember it for this process.

    :raises ProviderError: of the last way, or no other way would help.
    """
    ways = candidates(engine)
    way = next(ways)
    while True:
        try:
            result = create(way)
            _WORKED[engine.name] = way
            return result
        except ProviderError as error:
            another = next(ways, None)
            if another is None or not is_runtime_trouble(error):
                raise
            way = another


def candidates(engine: Engine) -> Iterator[Engine]:
    """
    Yield ways to call an engine: the one that worked before, the one for the control groups, and
    then other ones, because some computers do not show their control groups.
    """
    engines = [_WORKED.get(engine.name, engine), engine]
    if engine.name == 'podman':
        for runtime in ((), ('--runtime', 'crun'), ('--runtime', 'runc')):
            if not runtime or process.which(runtime[1]):
                engines += [dataclasses.replace(engine, flags=(*runtime, *manager))
                            for manager in ((), ('--cgroup-manager', 'cgroupfs'))]
    return iter(dict.fromkeys(engines))


def is_runtime_trouble(error: ProviderError) -> bool:
    """Return whether other flags may help: the runtime does not fit the control groups."""
    text = str(error).lower()
    # a hook of ours fails with any runtime
    return 'hook' not in text and any(
        word in text for word in ('cgroup', 'oci runtime', 'sd-bus', 'dbus', 'systemd'))


def answers(engine: Engine) -> None:
    """
    Check that the service of an engine runs on this computer, if it has one.

    Docker Desktop runs containers in a virtual machine, and docker without root in a network
    namespace: this computer can't reach their addresses there, nor filter their packets.

    :raises PrerequisiteError: it does not run, or elsewhere, or this user may not use it.
    """
    if engine.name == 'docker':
        result = engine.call('version', what='asking docker', check=False)
        if result.returncode != 0:
            raise PrerequisiteError(
                f'docker does not answer: {process.last_error(result.stderr)}',
                sudo_hint(result.stderr) or 'sudo systemctl start docker')
        if re.search('^Server: Docker Desktop|^ rootlesskit:', result.stdout, re.MULTILINE):
            raise PrerequisiteError(
                'Docker Desktop and rootless docker have no network that this computer reaches',
                'sudo apt-get install podman, or run docker as root')


def flags_for(*, unified: bool, systemd: bool, runc: bool) -> tuple[str, ...]:
    """
    Return podman's flags for a computer's control groups.

    :param unified: only control groups version 2 exist; crun refuses a mixture.
    :param systemd: systemd is the first process, and manages the groups.
    """
    flags: list[str] = []
    if not unified and runc:
        flags += ['--runtime', 'runc']
    if not systemd:
        flags += ['--cgroup-manager', 'cgroupfs']
    return tuple(flags)


def limits() -> tuple[str, ...]:
    """
    Return the flags for resource limits that this computer can grant.

    An engine's defaults can be above this computer's limits, and raising a limit needs
    CAP_SYS_RESOURCE. Podman lowers its process limit to the kernel's maximum process id first.
    """
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    processes = resource.getrlimit(resource.RLIMIT_NPROC)[1]
    largest = int(Path('/proc/sys/kernel/pid_max').read_text())
    words = []
    if files != resource.RLIM_INFINITY:
        words += ['--ulimit', f'nofile={min(files, 1 << 20)}:{min(files, 1 << 20)}']
    if processes != resource.RLIM_INFINITY:
        words += ['--ulimit', f'nproc={min(processes, largest)}:{min(processes, largest)}']
    return tuple(words)

# SPDX-License-Identifier: Apache-2.0
"""Podman and docker: which one works here, with which flags, and what they say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
import json
import os
from pathlib import Path
import resource
import threading
from typing import Any, Optional

from fogros2 import process
from fogros2.errors import CommandError, ConfigurationError, PrerequisiteError, ProviderError
from fogros2.model import Command, Result

ENGINES = ('podman', 'docker')
DOCKER_SOCKET = Path('/var/run/docker.sock')
_LOCK = threading.Lock()
_WORKED: dict[str, Engine] = {}


@dataclasses.dataclass(frozen=True)
class Engine:
    """
    A container engine as it has to be called here.

    :param name: podman or docker.
    :param flags: words after the program's name, before the sub-command.
    :param sudo: whether it takes root.
    """

    name: str
    flags: tuple[str, ...] = ()
    sudo: bool = True

    def argv(self, *words: str) -> tuple[str, ...]:
        """Return the command line of a sub-command."""
        return (self.name, *self.flags, *words)

    def call(self, *words: str, what: str, timeout: float = 60.0, check: bool = True,
             data: bytes = b'', cancel: Optional[threading.Event] = None) -> Result:
        """
        Run a sub-command.

        :raises ProviderError: it failed and ``check`` is set.
        """
        command = Command(self.argv(*words), sudo=self.sudo, input=data, what=what)
        try:
            return process.run(command, timeout=timeout, check=check, cancel=cancel)
        except CommandError as error:
            raise translate(error) from error

    def inspect(self, names: Sequence[str]) -> list[dict[str, Any]]:
        """Return what the engine knows of containers; those that are gone are left out."""
        result = self.call('container', 'inspect', *names, what='look at containers', check=False)
        found = json.loads(result.stdout) if result.stdout.strip() else []
        if result.returncode != 0 and not gone(result.stderr):
            raise ProviderError(f'{self.name} failed: {last_line(result.stderr)}',
                                sudo_hint(result.stderr))
        return [dict(entry) for entry in found or ()]


def gone(text: str) -> bool:
    """Return whether an engine's message says that there is no such container."""
    return 'no such container' in text.lower() or 'no such object' in text.lower()


def last_line(text: str) -> str:
    """Return the line of an engine's messages that tells what went wrong."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.lower().startswith('error')]
    return (errors or lines or ['no reason given'])[-1]


def sudo_hint(text: str) -> str:
    """Return the remedy if sudo refused, or ''."""
    if 'password is required' in text or 'a terminal is required' in text:
        return 'run `sudo -v` first, or allow it without a password'
    return ''


def architecture(engine: Engine, image: str) -> str:
    """
    Return the processor architecture of an image, as ``uname -m`` has it.

    :returns: '' for an image that is not on this computer yet, and for rare architectures.
    """
    found = engine.call('image', 'inspect', '--format', '{{.Architecture}}', image,
                        what='looking at the image', check=False)
    return {'amd64': 'x86_64', 'arm64': 'aarch64'}.get(found.stdout.strip(), '')


def check_architecture(engine: Engine, image: str) -> None:
    """
    Check that programs of an image run on this computer.

    :raises ConfigurationError: it is for another processor architecture, and nothing emulates it.
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
    """Return an engine's failure as one line with a remedy where one is known."""
    text = error.result.stderr
    hint = sudo_hint(text)
    low = text.lower()
    if 'overlay' in low and ('invalid argument' in low or 'not supported' in low):
        hint = "this root file system can't be overlaid: name an image with image='...'"
    elif 'no space left' in low:
        hint = 'the disk is full'
    elif 'exec format error' in low:
        hint = f'the image has to be for {os.uname().machine} processors'
    elif 'rlimit' in low or 'cgroup' in low:
        hint = 'see `ros2 fog doctor`'
    elif '/dev/net/tun' in low:
        hint = 'sudo modprobe tun'
    elif 'address already' in low or 'already allocated' in low:
        hint = 'that address or port is taken: choose another'
    elif 'network not found' in low or 'no such network' in low or (
            'network' in low and 'not found' in low):
        hint = 'podman network ls (or docker network ls) shows those there are'
    return ProviderError(f'{error.command.what} failed: {last_line(text)}', hint)


def select(wanted: str, image: Optional[str]) -> Engine:
    """
    Return the engine to create with: the one that is wanted, or the first that works.

    :raises PrerequisiteError: there is none.
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
    """Yield the engines that may have containers."""
    if process.which('podman'):
        yield podman()
    if process.which('docker') and (DOCKER_SOCKET.exists() or os.environ.get('DOCKER_HOST')):
        yield docker()


def named(name: str) -> Engine:
    """Return the engine that a machine's id names."""
    with _LOCK:
        worked = _WORKED.get(name)
    return worked or (podman() if name == 'podman' else docker())


def podman() -> Engine:
    """Return podman with the flags this computer's control groups ask for."""
    return Engine('podman', flags_for(
        unified=Path('/sys/fs/cgroup/cgroup.controllers').exists(),
        systemd=Path('/run/systemd/system').exists(),
        runc=process.which('runc') is not None))


def docker() -> Engine:
    """Return docker, with sudo where its socket is root's alone."""
    return Engine('docker', sudo=not (
        os.environ.get('DOCKER_HOST') or os.access(DOCKER_SOCKET, os.W_OK)))


def candidates(engine: Engine) -> Iterator[Engine]:
    """
    Yield ways to call an engine, the likeliest first: what worked before, what fits the control
    groups, then what works on computers that tell nothing of the kind.
    """
    with _LOCK:
        worked = _WORKED.get(engine.name)
    found = [worked] if worked else []
    found.append(engine)
    if engine.name == 'podman':
        for runtime in ((), ('--runtime', 'crun'), ('--runtime', 'runc')):
            if not runtime or process.which(runtime[1]):
                found += [dataclasses.replace(engine, flags=(*runtime, *manager))
                          for manager in ((), ('--cgroup-manager', 'cgroupfs'))]
    return iter(dict.fromkeys(found))


def remember(engine: Engine) -> None:
    """Keep for this process how an engine had to be called."""
    with _LOCK:
        _WORKED[engine.name] = engine


def is_runtime_trouble(error: ProviderError) -> bool:
    """Return whether other flags may help: the runtime and the control groups don't fit."""
    text = str(error).lower()
    return any(word in text for word in ('cgroup', 'oci runtime', 'sd-bus', 'dbus', 'systemd'))


def answers(engine: Engine) -> None:
    """
    Check that an engine that is a service runs.

    :raises PrerequisiteError: it doesn't, or isn't ours to use.
    """
    if engine.name == 'docker':
        result = engine.call('version', what='asking docker', check=False)
        if result.returncode != 0:
            raise PrerequisiteError(
                f'docker does not answer: {last_line(result.stderr)}',
                sudo_hint(result.stderr) or 'sudo systemctl start docker')


def flags_for(*, unified: bool, systemd: bool, runc: bool) -> tuple[str, ...]:
    """
    Return podman's flags for a computer's control groups.

    :param unified: control groups version 2 alone; crun refuses a mixture.
    :param systemd: systemd is the first process; it hands out the groups.
    """
    flags: list[str] = []
    if not unified and runc:
        flags += ['--runtime', 'runc']
    if not systemd:
        flags += ['--cgroup-manager', 'cgroupfs']
    return tuple(flags)


def limits() -> tuple[str, ...]:
    """
    Return flags for limits that this computer may grant.

    An engine's own defaults can be above ours; raising a limit takes CAP_SYS_RESOURCE. Podman
    lowers its own process limit to the kernel's largest process number first.
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

# SPDX-License-Identifier: Apache-2.0
"""
Build images for pods that contain what a launch would install: a pod's disk cannot be kept.

``recipe`` decides, ``build`` acts. The tag is the hash of the image's content, so
``container_image='REGISTRY/fogros2:{dependencies}'`` names the image for a launch.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import json
import os
from pathlib import Path
import re
from typing import Optional

from fogros2 import process
from fogros2.errors import CommandError, ConfigurationError, PrerequisiteError, ProviderError
from fogros2.model import Command
from fogros2.provider.kubernetes.boot import UID
from fogros2.provider.kubernetes.options import IMAGE

#: Programs that build and push images, in order of preference, with their Debian packages.
ENGINES = {'podman': 'podman', 'docker': 'docker.io', 'buildah': 'buildah'}
NAME = 'fogros2'
#: Seconds for the build, and for the push.
STEP_TIMEOUT = 3600.0

_REGISTRY = re.compile(r'[a-z0-9][a-z0-9.-]*(:[0-9]+)?(/[a-z0-9._-]+)*')


@dataclasses.dataclass(frozen=True)
class Recipe:
    """
    How to build an image.

    :param reference: its name with registry and tag.
    :param base: the base image.
    :param containerfile: its text; the build needs no other file.
    """

    reference: str
    base: str
    containerfile: str


def recipe(
    registry: str, *, dependencies: str, script: str, base: str = IMAGE,
) -> Recipe:
    """
    Return how to build the image for a robot's machines.

    :param registry: such as 'registry.example/robots'.
    :param dependencies: hash of the image's content, its tag.
    :param script: script for sh that installs the packages, as root.
    :param base: base image.
    :raises ConfigurationError: a value is invalid.
    """
    if not _REGISTRY.fullmatch(registry):
        raise ConfigurationError(f"'{registry}' can't be a registry",
                                 "such as 'registry.example/robots' or 'localhost:5000'")
    if not base or base.startswith('-') or any(c.isspace() for c in base):
        raise ConfigurationError(f"'{base}' can't be the image to begin with",
                                 'such as docker.io/library/ros:jazzy-ros-base')
    lines = ['# what a robot installs on a machine otherwise, at each launch', f'FROM {base}',
             'USER root', f'LABEL fogros2-dependencies={dependencies}',
             f"RUN {json.dumps(['sh', '-ec', script])}", 'RUN rm -rf /var/lib/apt/lists/*',
             # the first launch then need not create its user
             f'RUN grep -q "^fog:" /etc/passwd || useradd -m -u {UID} fog']
    return Recipe(f'{registry}/{NAME}:{dependencies}', base, '\n'.join([*lines, '']))


def engine(wanted: str = 'auto') -> str:
    """
    Return the program that builds images on this computer.

    :param wanted: one of ``ENGINES``, or 'auto' for the first that is installed.
    :raises PrerequisiteError: the engine is not installed.
    """
    for name in ENGINES if wanted == 'auto' else (wanted,):
        if process.which(name):
            return name
    names = ', '.join(ENGINES) if wanted == 'auto' else wanted
    package = ENGINES['podman' if wanted == 'auto' else wanted]
    raise PrerequisiteError(f'{names} not found on this computer',
                            f'sudo apt-get install {package}')


def build(
    what: Recipe, folder: Path, *, program: str, push: bool = True,
    on_output: Optional[Callable[[str], None]] = None,
) -> str:
    """
    Write, build and push an image; return its reference, for ``container_image=``.

    :param folder: folder for the Containerfile, which stays there.
    :param program: result of ``engine``.
    :param on_output: callback for each line of the program's output.
    :raises PrerequisiteError: the folder cannot be written.
    :raises ProviderError: the build failed, or the registry refused the image.
    """
    file = folder / 'Containerfile'
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(what.containerfile)
    except OSError as error:
        raise PrerequisiteError(f'{folder} can not be written: {error.strerror}',
                                '--folder names another') from error
    # with the paths of the user's logins to registries
    login = {name: os.environ[name] for name in ('REGISTRY_AUTH_FILE', 'DOCKER_CONFIG')
             if os.environ.get(name)}
    steps: list[tuple[str, str, tuple[str, ...]]] = [(
        what.base, 'building', ('build', '-t', what.reference, '-f', str(file), str(folder)))]
    if push:
        steps.append((what.reference, 'pushing', ('push', what.reference)))
    for image, verb, words in steps:
        command = Command((program, *words), environment=login, what=f'{verb} {what.reference}')
        try:
            process.run(command, timeout=STEP_TIMEOUT, on_output=on_output)
        except CommandError as error:
            output = error.result.stderr
            raise ProviderError(f'{command.what} failed: {_reason(output)}',
                                _hint(output, image, program, words[0])) from error
    return what.reference


def _reason(output: str) -> str:
    """Return the last error of a program's output; earlier ones belong to its retries."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if re.match(r'error\b', line, re.I)]
    return (errors or lines or ['it says nothing'])[-1]


def _hint(output: str, image: str, program: str, step: str) -> str:
    """
    Return the remedy for a failure.

    :param image: the image that the program pulled or pushed.
    :param step: 'build' or 'push'.
    """
    registry = image.partition('/')[0] if re.match(r'[^/]*[.:][^/]*/|localhost/', image) \
        else 'docker.io'
    text = _reason(output).lower()
    pushes = step == 'push'
    if re.search(r'unauthorized|denied|authentication required|no basic auth|forbidden', text) \
            and 'permission denied' not in text:
        return f'{program} login {registry}' if pushes else \
            f'is there an image {image}? If it takes a login: {program} login {registry}'
    if re.search(r'connection refused|no such host|timeout|network is unreachable|lookup ', text):
        return f'is {registry} right, and reachable from here?' if pushes else \
            f'is there an image {image}, and is {registry} reachable? --base names another'
    if 'server gave http response' in text:
        return f'{registry} speaks no TLS: let {program} know that it is an insecure registry'
    if 'permission denied' in text:
        return f'let this user use {program}, or run this as root'
    if not pushes and re.search(r'manifest unknown|not found|no such image', text):
        return f'is there an image {image}? --base names another'
    return ''

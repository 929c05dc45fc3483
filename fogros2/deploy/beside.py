# SPDX-License-Identifier: Apache-2.0
"""Step 9: start a machine's containers, and download the images that nodes run in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import threading

from fogros2 import container_scripts, containers
from fogros2.deploy.job import Job
from fogros2.errors import CommandError, PrerequisiteError
from fogros2.model import NodeSpec
from fogros2.shell import Shell


class Containers:
    """
    The container engine, the containers and the images of one machine; thread-safe.

    :param directory: the agent's directory on the machine.
    :param configuration: path of the middleware's configuration on the machine.
    """

    def __init__(self, job: Job, shell: Shell, directory: str, configuration: str) -> None:
        self._job = job
        self._shell = shell
        self._directory = directory
        self._configuration = configuration
        self._lock = threading.Lock()
        self._engine = False
        #: Name in the engine by (name in the launch file, middleware).
        self._images: dict[tuple[str, str], str] = {}

    def start(self, environment: Callable[[], Mapping[str, str]]) -> None:
        """
        Start a machine's containers, and download the images of the nodes that start later.

        Installs a container engine if the machine has none.

        :param environment: waits for the VPN interface and the middleware's configuration, which
            a node reads when it starts; returns the environment variables of the machine's nodes.
        :raises CommandError: a container does not start.
        :raises PrerequisiteError: the machine cannot install an engine, or download an image.
        """
        job = self._job
        # pushed now: nodes that start later run in these images, and stop before this undo
        job.undoing('containers', self._remove)
        if job.spec.containers:
            self._start_containers(environment)
        self._get(job.launch.images(job.name))

    def _start_containers(self, environment: Callable[[], Mapping[str, str]]) -> None:
        job, launch = self._job, self._job.launch.id
        variables = f'{self._directory}/container-variables'
        lines = [containers.parse(line) for line in job.spec.containers]
        with self._lock, job.step('containers') as detail:
            images = [self._image(each.image, self._lacking(each)) for each in lines]
            for text, path in (
                    (container_scripts.FOLLOW, f'{self._directory}/{containers.FOLLOWER}'),
                    (containers.dds_variables(environment()), variables)):
                self._shell.put(text.encode(), path, mode=0o600, timeout=job.timeouts.command)
            for number, (container, image) in enumerate(zip(lines, images)):
                self._shell.run(
                    containers.run(container, number, launch, image, self._configuration,
                                   variables),
                    timeout=job.timeouts.install, cancel=job.cancel)
            detail.append(f'{len(lines)}')

    def _lacking(self, container: containers.Container) -> str:
        """Return the middleware that a container's image must have, '' for any."""
        if not containers.on_machine_network(container) \
                or containers.sets(container, 'RMW_IMPLEMENTATION'):
            return ''
        return self._job.launch.dds().rmw

    def inside(self, nodes: Sequence[NodeSpec]) -> list[NodeSpec]:
        """
        Download the images of nodes; return the nodes with the commands of their containers.

        :raises PrerequisiteError: the machine cannot install an engine, or download an image.
        :raises Unsupported: no engine can run on the machine.
        """
        images = self._get(node.image for node in nodes if node.image)
        return [node if not node.image else containers.inside(
            node, images[node.image], self._job.launch.id,
            self._job.spec.workspace or '', self._configuration, self._job.spec.environment)
            for node in nodes]

    def _get(self, images: Iterable[str]) -> dict[str, str]:
        """Download images that nodes run in; return each image's name in the engine."""
        found = dict.fromkeys(images, '')
        if not found:
            return found
        rmw = self._job.launch.dds().rmw
        with self._lock:
            for image in found:
                if (image, rmw) not in self._images:
                    self._job.provider.check_containers(self._job.spec)
                    with self._job.step(f'image {image}'):
                        self._image(image, rmw)
                found[image] = self._images[image, rmw]
        return found

    def _image(self, image: str, rmw: str = '') -> str:
        """Return the engine's name of an image; download the image if it is missing."""
        job = self._job
        if (image, rmw) not in self._images:
            self._ensure_engine()
            try:
                printed = self._shell.run(containers.fetch(image, rmw), cancel=job.cancel,
                                          timeout=job.timeouts.install).stdout
            except CommandError as error:
                raise PrerequisiteError(
                    f"'{job.name}' can't get the image '{image}': "
                    f'{containers.reason(error.result.stderr)}',
                    "build it for the machine's processors too, or choose another machine"
                    if 'processors, and the machine has' in error.result.stderr else
                    'is its name right, and may anybody download it?') from error
            self._images[image, rmw] = printed.split()[-1]
        return self._images[image, rmw]

    def _ensure_engine(self) -> None:
        job = self._job
        if self._engine or self._shell.run(
                containers.find(), timeout=job.timeouts.command,
                cancel=job.cancel).stdout.strip():
            self._engine = True
            return
        try:
            self._shell.run(containers.install(), timeout=job.timeouts.install, cancel=job.cancel)
        except CommandError as error:
            raise PrerequisiteError(
                f"'{job.name}' has neither podman nor docker, and podman can't be installed: "
                f'{error}', 'take an image with one of them') from error
        self._engine = True

    def _remove(self) -> None:
        if self._engine and self._job.survives:
            self._job.tidy(self._shell, [containers.remove(self._job.launch.id)])

# SPDX-License-Identifier: Apache-2.0
"""Start a machine's containers, and download the images that nodes run in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import threading

from fogros2.deploy.context import Context
from fogros2.deploy.machine_job import MachineJob, Step
from fogros2.deploy.undo import CONTAINERS
from fogros2.errors import CommandError, PrerequisiteError
from fogros2.host import container_scripts, containers
from fogros2.host.installer import apt_install
from fogros2.model import NodeSpec


class Containers(Step):
    """The container engine, the containers and the images of one machine; thread-safe."""

    def __init__(self, context: Context, job: MachineJob) -> None:
        super().__init__(context, job)
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
        job.may_make(CONTAINERS)
        if job.spec.containers:
            self._start_containers(environment)
        self._get(self._context.images)

    def _start_containers(self, environment: Callable[[], Mapping[str, str]]) -> None:
        job, timeouts = self._job, self._context.timeouts
        variables = f'{job.directory}/container-variables'
        lines = [containers.parse(line) for line in job.spec.containers]
        with self._lock, job.step('containers') as detail:
            images = [self._image(each.image, self._lacking(each)) for each in lines]
            for text, path in (
                    (container_scripts.FOLLOW, f'{job.directory}/{containers.FOLLOWER}'),
                    (containers.dds_variables(environment()), variables)):
                job.shell.put(text.encode(), path, mode=0o600, timeout=timeouts.command)
            for number, (container, image) in enumerate(zip(lines, images)):
                job.run(
                    containers.run(container, number, self._context.launch_id, image, job.dds_file,
                                   variables), timeout=timeouts.install)
            detail.append(f'{len(lines)}')

    def _lacking(self, container: containers.Container) -> str:
        """Return the middleware that a container's image must have, '' for any."""
        if not containers.on_machine_network(container) \
                or containers.sets(container, 'RMW_IMPLEMENTATION'):
            return ''
        return self._context.dds.rmw

    def inside(self, nodes: Sequence[NodeSpec]) -> list[NodeSpec]:
        """
        Download the images of nodes; return the nodes with the commands of their containers.

        :raises PrerequisiteError: the machine cannot install an engine, or download an image.
        :raises Unsupported: no engine can run on the machine.
        """
        images = self._get(node.image for node in nodes if node.image)
        return [node if not node.image else containers.inside(
            node, images[node.image], self._context.launch_id, self._job.spec.workspace or '',
            self._job.dds_file, self._job.spec.environment)
            for node in nodes]

    def _get(self, images: Iterable[str]) -> dict[str, str]:
        """Download images that nodes run in; return each image's name in the engine."""
        digests = dict.fromkeys(images, '')
        if not digests:
            return digests
        rmw = self._context.dds.rmw
        with self._lock:
            for image in digests:
                if (image, rmw) not in self._images:
                    self._context.provider.check_containers(self._job.spec)
                    with self._job.step(f'image {image}'):
                        self._image(image, rmw)
                digests[image] = self._images[image, rmw]
        return digests

    def _image(self, image: str, rmw: str = '') -> str:
        """Return the engine's name of an image; download the image if it is missing."""
        job = self._job
        if (image, rmw) not in self._images:
            self._ensure_engine()
            try:
                printed = job.run(
                    containers.fetch(image, rmw), timeout=self._context.timeouts.install)
            except CommandError as error:
                raise PrerequisiteError(
                    f"'{job.name}' can't get the image '{image}': "
                    f'{containers.reason(error.result.stderr)}',
                    "build it for the machine's processors too, or choose another machine"
                    if 'processors, and the machine has' in error.result.stderr else
                    'is its name right, and may anybody download it?') from error
            self._images[image, rmw] = (printed.split() or [image])[-1]
        return self._images[image, rmw]

    def _ensure_engine(self) -> None:
        job = self._job
        timeouts = self._context.timeouts
        if not self._engine:
            job.note(CONTAINERS)
        if not self._engine and not job.run(containers.FIND, timeout=timeouts.command).strip():
            try:
                # the configuration of podman may name crun, and its package may bring another
                job.run(apt_install(['podman', 'crun']), timeout=timeouts.install)
            except CommandError as error:
                raise PrerequisiteError(
                    f"'{job.name}' has neither podman nor docker, and podman can't be installed: "
                    f'{error}', 'take an image with one of them') from error
        self._engine = True

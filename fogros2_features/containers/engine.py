# SPDX-License-Identifier: Apache-2.0
"""Start a machine's containers, and download the images that nodes run in."""

from __future__ import annotations

from collections.abc import Sequence

from fogros2.errors import CommandError, PrerequisiteError
from fogros2.feature import RunningMachine
from fogros2.host.installer import apt_install
from fogros2.model import NodeSpec
from fogros2.waiting import Timeouts
from fogros2_features.containers import commands
from fogros2_features.containers.commands import Container

_TIMEOUTS = Timeouts()


class Engine:
    """The container engine, the containers and the images of one machine."""

    def __init__(self, running: RunningMachine) -> None:
        self._running = running
        self._works = False
        #: Name in the engine by (name in the launch file, middleware).
        self._images: dict[tuple[str, str], str] = {}

    @property
    def _rmw(self) -> str:
        """The launch's middleware."""
        return self._running.environment['RMW_IMPLEMENTATION']

    def start(self, containers: Sequence[Container]) -> None:
        """
        Start containers; install a container engine if the machine has none.

        :raises CommandError: a container does not start.
        :raises PrerequisiteError: the machine cannot install an engine, or download an image.
        """
        if not containers:
            return
        running = self._running
        variables = f'{running.directory}/container-variables'
        with running.step('containers') as detail:
            images = [self._image(each.image, self._lacking(each)) for each in containers]
            for text, path in (
                    (commands.follower(running.launch),
                     f'{running.directory}/{commands.FOLLOWER}'),
                    (commands.dds_variables(running.environment), variables)):
                running.shell.put(text.encode(), path, mode=0o600, timeout=_TIMEOUTS.command)
            for number, (container, image) in enumerate(zip(containers, images)):
                running.run(
                    commands.run(container, number, running.launch, image, running.dds_file,
                                 variables), timeout=_TIMEOUTS.install)
            detail.append(f'{len(containers)}')

    def _lacking(self, container: Container) -> str:
        """Return the middleware that a container's image must have, '' for any."""
        if not commands.on_machine_network(container) \
                or commands.sets(container, 'RMW_IMPLEMENTATION'):
            return ''
        return self._rmw

    def inside(self, nodes: Sequence[NodeSpec]) -> list[NodeSpec]:
        """
        Download the images of nodes; return the nodes with the commands of their containers.

        :raises PrerequisiteError: the machine cannot install an engine, or download an image.
        :raises Unsupported: no engine can run on the machine.
        """
        return [self._inside(node, image) if (image := commands.image_of(node).get('image'))
                else node for node in nodes]

    def _inside(self, node: NodeSpec, image: str) -> NodeSpec:
        running = self._running
        if (image, self._rmw) not in self._images:
            running.provider.check_containers(running.spec)
            with running.step(f'image {image}'):
                self._image(image, self._rmw)
        return commands.inside(
            node, self._images[image, self._rmw], running.launch, running.spec.workspace or '',
            running.dds_file, running.spec.environment)

    def _image(self, image: str, rmw: str) -> str:
        """Return the engine's name of an image; download the image if it is missing."""
        if (image, rmw) not in self._images:
            self._ensure_engine()
            try:
                printed = self._running.run(
                    commands.fetch(image, rmw), timeout=_TIMEOUTS.install)
            except CommandError as error:
                raise PrerequisiteError(
                    f"'{self._running.spec.name}' can't get the image '{image}': "
                    f'{commands.reason(error.result.stderr)}',
                    "build it for the machine's processors too, or choose another machine"
                    if 'processors, and the machine has' in error.result.stderr else
                    'is its name right, and may anybody download it?') from error
            self._images[image, rmw] = (printed.split() or [image])[-1]
        return self._images[image, rmw]

    def _ensure_engine(self) -> None:
        if self._works:
            return
        running = self._running
        running.makes(commands.NAME)
        if not running.run(commands.FIND, timeout=_TIMEOUTS.command).strip():
            try:
                # the configuration of podman may name crun, and its package may bring another
                running.run(apt_install(['podman', 'crun']), timeout=_TIMEOUTS.install)
            except CommandError as error:
                raise PrerequisiteError(
                    f"'{running.spec.name}' has neither podman nor docker, and podman can't be "
                    f'installed: {error}', 'take an image with one of them') from error
        self._works = True

# SPDX-License-Identifier: Apache-2.0
"""Start a machine's containers, and download the images that nodes run in."""

from __future__ import annotations

from collections.abc import Sequence

from fogros2 import process
from fogros2.errors import CommandError, PrerequisiteError
from fogros2.feature import ReachedMachine, RunningMachine
from fogros2.host.installer import apt_install
from fogros2.model import NodeSpec
from fogros2.waiting import Timeouts
from fogros2_features.containers import commands
from fogros2_features.containers.commands import Container

_TIMEOUTS = Timeouts()


class Engine:
    """The container engine, the containers and the images of one machine."""

    def __init__(self) -> None:
        self._works = self._recorded = False
        #: Name in the engine by (name in the launch file, middleware).
        self._images: dict[tuple[str, str], str] = {}

    def fetch(
        self, reached: ReachedMachine, containers: Sequence[Container], nodes: Sequence[NodeSpec],
    ) -> None:
        """
        Download images; install a container engine if the machine has none.

        :raises PrerequisiteError: the machine cannot install an engine, or download an image.
        :raises Unsupported: no engine can run on the machine.
        """
        wanted = [(each.image, _lacking(each, reached.rmw)) for each in containers] + [
            (image, reached.rmw) for node in nodes
            if (image := commands.image_of(node).get('image'))]
        for image, rmw in wanted:
            if (image, rmw) not in self._images:
                reached.provider.check_containers(reached.spec)
                with reached.step(f'image {image}'):
                    self._images[image, rmw] = self._image(reached, image, rmw)

    def start(self, running: RunningMachine, containers: Sequence[Container]) -> None:
        """
        Start containers, whose images are there.

        :raises CommandError: a container does not start.
        """
        if not containers:
            return
        self._record(running)
        variables = f'{running.directory}/container-variables'
        with running.step('containers') as detail:
            for text, path in (
                    (commands.follower(running.launch),
                     f'{running.directory}/{commands.FOLLOWER}'),
                    (commands.dds_variables(running.environment), variables)):
                running.shell.put(text.encode(), path, mode=0o600, timeout=_TIMEOUTS.command)
            for number, container in enumerate(containers):
                image = self._images[container.image, _lacking(container, running.rmw)]
                running.run(
                    commands.run(container, number, running.launch, image, running.dds_file,
                                 variables), timeout=_TIMEOUTS.install)
            detail.append(f'{len(containers)}')

    def inside(self, running: RunningMachine, nodes: Sequence[NodeSpec]) -> list[NodeSpec]:
        """
        Return nodes with the commands of their containers; download missing images.

        :raises PrerequisiteError: the machine cannot install an engine, or download an image.
        :raises Unsupported: no engine can run on the machine.
        """
        self.fetch(running, (), nodes)
        result = []
        for node in nodes:
            image = commands.image_of(node).get('image')
            if image:
                self._record(running)
                node = commands.inside(
                    node, self._images[image, running.rmw], running.launch,
                    running.spec.workspace or '', running.dds_file, running.spec.environment)
            result.append(node)
        return result

    def _record(self, running: RunningMachine) -> None:
        if not self._recorded:
            running.makes(commands.NAME)
            self._recorded = True

    def _image(self, reached: ReachedMachine, image: str, rmw: str) -> str:
        """Return the engine's name of an image; download the image if it is missing."""
        self._ensure_engine(reached)
        try:
            printed = reached.run(commands.fetch(image, rmw), timeout=_TIMEOUTS.install)
        except CommandError as error:
            raise PrerequisiteError(
                f"'{reached.spec.name}' can't get the image '{image}': "
                f'{process.last_error(error.result.stderr)}',
                "build it for the machine's processors too, or choose another machine"
                if 'processors, and the machine has' in error.result.stderr else
                'is its name right, and may anybody download it?') from error
        return (printed.split() or [image])[-1]

    def _ensure_engine(self, reached: ReachedMachine) -> None:
        if self._works:
            return
        if not reached.run(commands.FIND, timeout=_TIMEOUTS.command).strip():
            try:
                # the configuration of podman may name crun, and its package may bring another
                reached.run(apt_install(['podman', 'crun']), timeout=_TIMEOUTS.install)
            except CommandError as error:
                raise PrerequisiteError(
                    f"'{reached.spec.name}' has neither podman nor docker, and podman can't be "
                    f'installed: {error}', 'take an image with one of them') from error
        self._works = True


def _lacking(container: Container, rmw: str) -> str:
    """Return the middleware that a container's image must have, '' for any."""
    if not commands.on_machine_network(container) \
            or commands.sets(container, 'RMW_IMPLEMENTATION'):
        return ''
    return rmw

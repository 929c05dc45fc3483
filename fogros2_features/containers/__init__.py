# SPDX-License-Identifier: Apache-2.0
"""
Containers beside a machine's nodes, and nodes in container images.

In reading order: ``docker_lines`` reads command lines, ``scripts`` run on the machine,
``commands`` has the commands, ``engine`` runs them on one machine, ``parsing`` reads the element
of XML and YAML, and ``elements`` registers it with launch.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import contextlib
import inspect
from typing import Any, ClassVar, Optional, TYPE_CHECKING

from fogros2.errors import ConfigurationError, ConnectError
from fogros2.feature import (
    Feature,
    LaunchPart,
    Program,
    ReachedMachine,
    RunningLaunch,
    RunningMachine,
)
from fogros2.model import Command, MachineSpec, NodeSpec
from fogros2_features.containers import commands
from fogros2_features.containers.commands import Container
from fogros2_features.containers.engine import Engine

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

#: The engines of machines, by the launch's id and the machine's name.
_ENGINES: dict[tuple[str, str], Engine] = {}


class Containers(Feature):
    """``add_docker_container`` of machines, ``image=`` of nodes."""

    always: ClassVar[bool] = True
    machine_list = ('docker_containers', 'docker_container')
    containers = ('docker_containers', 'image')

    @staticmethod
    def options(docker_containers: Sequence[SomeSubstitutionsType] = ()) -> tuple[Container, ...]:
        """
        Return the containers that run from before the machine's nodes start until these end.

        :param docker_containers: ``docker run`` command lines.
        """
        return tuple(commands.parse(str(line)) for line in docker_containers)

    @staticmethod
    def item(
        cmd: Optional[SomeSubstitutionsType] = None, *, image: str = '', **parts: Any,
    ) -> SomeSubstitutionsType:
        """
        Run a container on the machine, from before its nodes start until they have ended.

        This is the method ``add_docker_container`` of machines. ROS nodes in the container
        communicate with the launch's nodes: by default the container uses the machine's network
        and the variables and configuration of the middleware.

        :param cmd: a ``docker run`` command line.
        :param image: instead of ``cmd``, the container's image, with any of ``command``,
            ``ports``, ``environment``, ``volumes``, ``gpus``, ``restart``, ``name``: see
            :func:`fogros2_features.containers.commands.described`.
        :raises ConfigurationError: neither or both were given.
        """
        if bool(cmd) == bool(image) or cmd and parts:
            raise ConfigurationError(
                'add_docker_container takes a command line, or image= and the rest by name',
                "such as 'docker run --net=host IMAGE'")
        if image:
            try:
                cmd = commands.described(image, **parts)
            except TypeError as error:
                raise ConfigurationError(
                    f'add_docker_container: {error}',
                    f"there are: {', '.join(inspect.signature(commands.described).parameters)}"
                ) from error
        assert cmd is not None
        return cmd

    @staticmethod
    def node_options(
        image: Optional[SomeSubstitutionsType] = None,
        image_options: Sequence[SomeSubstitutionsType] = (),
    ) -> Optional[Container]:
        """
        Return the container of a node, None for none.

        :param image: container image that the node runs in on the machine, such as
            'ros:jazzy-perception', with the machine's network, DDS configuration and workspace.
        :param image_options: more options for ``docker run``, such as ['--gpus=all']; a
            substitution separates them by commas.
        """
        return commands.node_container(str(image), [*map(str, image_options)]) if image else None

    def in_launch(self, launch: RunningLaunch) -> LaunchPart:
        """Return what checks that containers fit the launch's middleware."""
        return _Part(launch)

    def check(self, spec: MachineSpec, own: Sequence[Container]) -> None:
        """Check that the machine can run containers."""
        if own:
            _check_machine(spec)

    def check_node(self, spec: MachineSpec, node: NodeSpec, own: Sequence[Container]) -> None:
        """Check that the machine can run the node's image."""
        given = commands.image_of(node)
        if given.get('image_options') and 'image' not in given:
            raise ConfigurationError(
                f"image_options={given['image_options']!r} is no list of options for an image",
                "such as image='ros:jazzy-perception', image_options=['--gpus=all']")
        if 'image' in given:
            if node.shell:
                raise ConfigurationError(
                    f"a node in the image '{given['image']}' can't run in a shell of the machine",
                    'leave shell= out')
            _check_machine(spec)

    def beside(self, spec: MachineSpec, own: Sequence[Container]) -> Sequence[NodeSpec]:
        """Return the processes that follow the containers."""
        return [commands.follow(each, number) for number, each in enumerate(own)]

    def installing(
        self, reached: ReachedMachine, nodes: Sequence[NodeSpec], own: Sequence[Container],
    ) -> None:
        """Download the images."""
        engine = _ENGINES[reached.launch, reached.spec.name] = Engine()
        engine.fetch(reached, own, nodes)

    @contextlib.contextmanager
    def machine(self, running: RunningMachine, own: Sequence[Container]) -> Iterator[None]:
        """Start the containers."""
        key = running.launch, running.spec.name
        engine = _ENGINES[key]
        try:
            engine.start(running, own)
            yield
        finally:
            if _ENGINES.get(key) is engine:  # not that of a machine in its place
                del _ENGINES[key]

    def starting(
        self, running: RunningMachine, nodes: Sequence[NodeSpec], own: Sequence[Container],
    ) -> Sequence[NodeSpec]:
        """Return nodes with the commands of their containers; download missing images."""
        engine = _ENGINES.get((running.launch, running.spec.name))
        if engine is None:
            raise ConnectError(f"the launch has given '{running.spec.name}' up meanwhile")
        return engine.inside(running, nodes)

    def clean_up(self, launch: str) -> Sequence[Command]:
        """Return the command that removes all containers of a launch."""
        return [commands.remove(launch)]


class _Part(LaunchPart):
    """Check the containers of a launch's machines."""

    def __init__(self, launch: RunningLaunch) -> None:
        self._launch = launch

    def beside(self, own: Any, machine: Optional[str]) -> Iterable[Program]:
        """Check that no container needs another middleware's configuration."""
        if machine is not None:
            given = self._launch.spec(machine).features.get(commands.NAME, {})
            for each in Containers.options(**given):
                commands.check(each, self._launch.environment['RMW_IMPLEMENTATION'])
        return ()


def _check_machine(spec: MachineSpec) -> None:
    # imported for the first machine: it imports much
    from fogros2.deploy.robot import provider
    provider(spec.provider).check_containers(spec)

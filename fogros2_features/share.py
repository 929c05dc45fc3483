# SPDX-License-Identifier: Apache-2.0
"""Pass topics between launches whose machines are on one host, by relays of ``fogros2_share``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import dataclasses
import json
from typing import Any, Optional, TYPE_CHECKING

from fogros2 import plugin_system, ros_names
from fogros2.errors import ConfigurationError, Unsupported
from fogros2.feature import Feature, LaunchPart, Program, RunningLaunch
from fogros2.model import CreateRequest, MachineSpec, NodeSpec

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType


class Share(Feature):
    """``share=['/map']``: topics that a machine has in common with others on its host."""

    @staticmethod
    def options(share: Optional[Sequence[SomeSubstitutionsType]] = None) -> tuple[str, ...]:
        """
        Return the topics.

        :param share: names, such as '/map'.
        """
        return tuple(dict.fromkeys(ros_names.check_name(str(topic)) for topic in share or ()))

    def check(self, spec: MachineSpec, own: Sequence[str]) -> None:
        """Check that the machine has a host."""
        if own and not _folders(spec):
            raise Unsupported(
                f"'{spec.name}' can't share topics: it has no host with machines of other robots",
                "use ContainerInstance(on=SSHInstance('gpu-box')), or leave share= out")

    def request(self, request: CreateRequest, own: Sequence[str]) -> CreateRequest:
        """Have the machine created for these topics."""
        return dataclasses.replace(request, common=own)

    def in_launch(self, launch: RunningLaunch) -> LaunchPart:
        """Return what runs the relay."""
        return Relay(launch)


class Relay(LaunchPart):
    """The relay of a launch, beside the nodes of the machine that shares topics."""

    def __init__(self, launch: RunningLaunch) -> None:
        self._launch = launch
        self._machine: Optional[str] = None

    def beside(self, own: Any, machine: Optional[str]) -> Iterable[Program]:
        """Return the relay with the first node of the machine."""
        if machine is None or machine == self._machine:
            return ()
        spec = self._launch.spec(machine)
        topics = Share.options(**spec.features.get('share', {}))
        if not topics:
            return ()
        if self._machine is not None:
            # two relays would send each other's messages round and round
            raise ConfigurationError(
                f"'{machine}' is the second machine of this launch with share=",
                'one machine shares topics for all nodes of a launch')
        self._machine = machine
        return [Program(NodeSpec(
            id=f'share-{machine}', name='share', package='fogros2', executable='share',
            respawn=True, respawn_delay=1.0,
            arguments=(json.dumps({'topics': topics, 'folders': _folders(spec)}),)), machine)]


def _folders(spec: MachineSpec) -> Sequence[str]:
    folders: Sequence[str] = plugin_system.load(
        'fogros2.provider', spec.provider).capabilities.share_folders
    return folders

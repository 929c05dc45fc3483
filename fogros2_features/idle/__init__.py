# SPDX-License-Identifier: Apache-2.0
"""End a machine that nobody uses, while its launch goes on; ``program`` decides on the machine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import secrets
from typing import Optional, TYPE_CHECKING

from fogros2 import plugin_system
from fogros2.describe.values import parse_duration
from fogros2.errors import ConfigurationError
from fogros2.feature import contained, Feature, RunningMachine
from fogros2.model import MachineSpec, NodeSpec
from fogros2_features.idle import program

if TYPE_CHECKING:
    from fogros2.describe.machines import Scalar


class IdleTimeout(Feature):
    """``idle_timeout='10m'``: the time without use after which a machine ends."""

    @staticmethod
    def options(idle_timeout: Optional[Scalar] = None) -> Optional[float]:
        """
        Return the time in seconds.

        :param idle_timeout: seconds, or text such as '10m'.
        """
        return None if idle_timeout is None else parse_duration(
            'idle_timeout', str(idle_timeout))

    def check(self, spec: MachineSpec, own: float) -> None:
        """Check that what uses the machine can be measured, and that nobody needs it later."""
        if plugin_system.load('fogros2.provider', spec.provider).capabilities.account:
            raise ConfigurationError(
                f"'{spec.name}' is a machine of another robot, whose launch ends it",
                'leave idle_timeout= out')
        if contained(spec.features):
            raise _not_measured(spec)
        if spec.options.get('fleet'):
            raise ConfigurationError('robots of fleet= use the machine after the launch',
                                     'leave idle_timeout= out')

    def check_node(self, spec: MachineSpec, node: NodeSpec, own: float) -> None:
        """Check that the node's use can be measured."""
        if contained(node.features):
            raise _not_measured(spec)

    def starting(
        self, running: RunningMachine, nodes: Sequence[NodeSpec], own: float,
    ) -> Sequence[NodeSpec]:
        """Let the time begin anew."""
        running.watch(
            'idle',
            ['python3', '-IS', '-c', Path(program.__file__).read_text(), running.interface.name,
             running.directory, str(own), secrets.token_hex(4)],
            # not what the machine says, which may be anything
            program.interval(own),
            lambda reason: running.give_up(f'nobody has used it for {own:g} s'))
        return nodes


def _not_measured(spec: MachineSpec) -> ConfigurationError:
    return ConfigurationError(
        f"the machine '{spec.name}' has an idle_timeout and runs a container: nothing measures "
        'what a container computes',
        'leave idle_timeout= out, or run the nodes without containers')

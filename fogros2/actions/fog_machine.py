# SPDX-License-Identifier: Apache-2.0
"""FogMachine: a machine as an action, for XML and YAML, which contain only actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Optional, TYPE_CHECKING

from launch import Action, LaunchContext

from fogros2.describe import keywords, values
from fogros2.errors import naming
from fogros2.runtime.coordinator import Coordinator

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import CloudInstance


class FogMachine(Action):
    """
    A machine to which nodes can refer by name after this action was executed.

    :param provider: 'container', 'ssh', 'aws', 'kubernetes' or another installed provider; 'robot'
        runs the machine's nodes on the robot.
    :param given: keywords of that provider's class. If the provider is a substitution, keywords
        that its class lacks may be empty strings.
    :raises ConfigurationError: a value that is known already is wrong.
    """

    def __init__(
        self, provider: SomeSubstitutionsType, given: Mapping[str, Any], **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self._provider = provider
        self._given = dict(given)
        #: The machine's name as the launch file gives it.
        self.name = self._given.get('name', 'fog_machine')
        #: The machine; None until the provider is resolved.
        self.machine: Optional[CloudInstance] = None
        if isinstance(provider, str):
            self.machine = self._made(provider, self._given)

    def execute(self, context: LaunchContext) -> None:
        """Create the machine's description, and register its name with the launch."""
        machine = self.described(context)
        # resolves the name, so that nodes can refer to it
        machine.spec(context)
        Coordinator.of(context).know(machine)

    def described(self, context: LaunchContext) -> CloudInstance:
        """Return the machine's description."""
        if self.machine is None:
            provider = values.resolve(context, self._provider)
            parameters = keywords.keywords(keywords.machine_class(provider))
            self.machine = self._made(provider, {
                name: value for name, value in self._given.items()
                if name in parameters or not self._is_empty(context, value)})
        return self.machine

    def _made(self, provider: str, given: Mapping[str, Any]) -> CloudInstance:
        with naming(self.name if isinstance(self.name, str) else ''):
            return keywords.make(provider, given)

    @staticmethod
    def _is_empty(context: LaunchContext, value: Any) -> bool:
        return bool(values.is_text(value)) and values.resolve(context, value) == ''

# SPDX-License-Identifier: Apache-2.0
"""Run the republishers of streams, encoders and decoders, as processes of the launch."""

from __future__ import annotations

import asyncio
from typing import Any, Optional

from launch import LaunchContext, Substitution
from launch.actions import ExecuteProcess
from launch.substitutions import TextSubstitution
from launch_ros.substitutions import ExecutableInPackage, FindPackagePrefix, FindPackageShare

from fogros2.actions import private
from fogros2.errors import ConfigurationError
from fogros2.model import NodeSpec, Text

_PLACES = {'share': FindPackageShare, 'prefix': FindPackagePrefix}


class Carrier(ExecuteProcess):
    """
    A process that republishes a stream, encoded or decoded.

    It is a process action and not a :class:`launch_ros.actions.Node`: the namespaces, remappings
    and parameters that a group sets for its nodes must not change it.
    """

    def __init__(self, spec: NodeSpec) -> None:
        command: list[list[Substitution]] = [_word(word) for word in spec.arguments]
        if spec.package:
            command.insert(0, [ExecutableInPackage(
                package=spec.package, executable=spec.executable)])
        environment: dict[Any, Any] = {  # a dict does not match launch's union type
            key: _word(value) for key, value in spec.environment.items()}
        super().__init__(
            cmd=command, name=spec.name, additional_env=environment, respawn=spec.respawn,
            respawn_delay=spec.respawn_delay, sigterm_timeout=str(spec.sigterm_timeout),
            sigkill_timeout=str(spec.sigkill_timeout))
        #: The id of its node in the stream.
        self.node = spec.id

    def get_asyncio_future(self) -> Optional[asyncio.Future[Any]]:
        """Return None: this process must not keep the launch alive when all others have ended."""
        return None


class RobotCarrier(Carrier):
    """A republisher on the robot; it starts when the machine at the other end is up."""

    def __init__(self, spec: NodeSpec, up: asyncio.Future[bool]) -> None:
        super().__init__(spec)
        self._up = up

    async def _ExecuteLocal__execute_process(self, context: LaunchContext) -> None:
        if await asyncio.shield(self._up) and not context.is_shutdown:
            await getattr(super(), private.EXECUTE_PROCESS)(context)
            return
        future = private.completed(self)
        if future is not None and not future.done():
            future.set_result(None)


def _word(text: Text) -> list[Substitution]:
    if isinstance(text, str):
        return [TextSubstitution(text=text)]
    found: list[Substitution] = []
    for part in text:
        if isinstance(part, str):
            found.append(TextSubstitution(text=part))
            continue
        (kind, package), = part.items()
        if kind not in _PLACES:
            raise ConfigurationError(
                f"an image transport's node names a {kind} that travels",
                'give its settings as parameters')
        found.append(_PLACES[kind](package))
    return found

# SPDX-License-Identifier: Apache-2.0
"""A process that FogROS2 adds to a launch: a helper of a machine, a program of a feature."""

from __future__ import annotations

import asyncio
import shlex
from typing import Any, Optional

from launch import Substitution
from launch.actions import ExecuteProcess
from launch.substitutions import TextSubstitution
from launch_ros.substitutions import ExecutableInPackage, FindPackagePrefix, FindPackageShare

from fogros2.errors import ConfigurationError
from fogros2.launch_internals import private
from fogros2.model import NodeSpec, Text

#: Fields of a NodeSpec that a process action has not.
_LOST = ('files', 'folders', 'shell', 'features')
_PACKAGE_PATHS = {'share': FindPackageShare, 'prefix': FindPackagePrefix}


class AddedProcess(ExecuteProcess):
    """
    A process that FogROS2 adds to the launch.

    It is a process action and not a :class:`launch_ros.actions.Node`: the namespaces, remappings
    and parameters that a group sets for its nodes must not change it.

    :param up: the process starts when it is done, or never if its result is False.
    """

    def __init__(self, spec: NodeSpec, up: Optional[asyncio.Future[bool]] = None) -> None:
        if lost := [name for name in _LOST if getattr(spec, name)]:
            raise ConfigurationError(
                f"the program '{spec.name}' of a feature has {', '.join(lost)}, which FogROS2 "
                'does not pass on', 'use arguments, environment, cwd or prefix')
        command: list[list[Substitution]] = [_substitutions(text) for text in spec.arguments]
        if spec.package:
            command.insert(0, [ExecutableInPackage(
                package=spec.package, executable=spec.executable)])
        environment: dict[Any, Any] = {  # a dict does not match launch's union type
            key: _substitutions(value) for key, value in spec.environment.items()}
        super().__init__(
            cmd=command, name=spec.name, additional_env=environment, respawn=spec.respawn,
            prefix=[part for text in spec.prefix for part in (
                *_substitutions(shlex.quote(text) if isinstance(text, str) else text),
                TextSubstitution(text=' '))] or None,
            cwd=None if spec.cwd is None else _substitutions(spec.cwd),
            emulate_tty=spec.emulate_tty, respawn_max_retries=spec.respawn_max_retries,
            respawn_delay=spec.respawn_delay, sigterm_timeout=str(spec.sigterm_timeout),
            sigkill_timeout=str(spec.sigkill_timeout))
        #: The id of its node.
        self.node = spec.id
        #: See NodeSpec; launch itself gives no signal to children.
        self.passes_signals = spec.passes_signals
        if up is not None:
            private.delay_start(self, lambda: asyncio.shield(up))

    def get_asyncio_future(self) -> Optional[asyncio.Future[Any]]:
        """Return None: this process must not keep the launch alive when all others have ended."""
        return None


def _substitutions(text: Text) -> list[Substitution]:
    if isinstance(text, str):
        return [TextSubstitution(text=text)]
    substitutions: list[Substitution] = []
    for part in text:
        if isinstance(part, str):
            substitutions.append(TextSubstitution(text=part))
            continue
        (kind, package), = part.items()
        if kind not in _PACKAGE_PATHS:
            raise ConfigurationError(
                f"a program of a feature uses a {kind}, which can't be sent to a machine",
                'pass its settings as parameters')
        substitutions.append(_PACKAGE_PATHS[kind](package))
    return substitutions

# SPDX-License-Identifier: Apache-2.0
"""What can be executed."""
from __future__ import annotations

import itertools
import os
import re
from typing import Any, Iterable

from .._base import Action, SomeSubstitutionsType, Substitution
from ..launch_context import LaunchContext
from ..substitutions import LaunchConfiguration, normalized_default
from ..utilities import normalize_to_list_of_substitutions as normalize
from ..utilities import perform_substitutions

__all__ = ['Executable']

Environment = list[tuple[list[Substitution], list[Substitution]]]

_numbers = itertools.count(1)


def _normalize_environment(environment: dict[Any, Any] | None) -> Environment | None:
    return None if environment is None else [
        (normalize(name), normalize(value)) for name, value in environment.items()]


class Executable:
    """
    A command to execute; what exactly is known, as ``final_...``, once it is prepared.

    :param prefix: words to put before it, split as a shell does; by default the launch
        configuration 'launch-prefix', for executables that 'launch-prefix-filter' matches.
    :param name: by default the executable's file name; a number makes it unique.
    :param env: the whole environment, by default the launch's.
    :param additional_env: what to add to it.
    :param arguments: further words of the command.
    """

    def __init__(
        self, *, cmd: Iterable[SomeSubstitutionsType],
        prefix: SomeSubstitutionsType | None = None, name: SomeSubstitutionsType | None = None,
        cwd: SomeSubstitutionsType | None = None, env: dict[Any, Any] | None = None,
        additional_env: dict[Any, Any] | None = None,
        arguments: Iterable[SomeSubstitutionsType] | None = None
    ) -> None:
        self.cmd = [normalize(word) for word in (*cmd, *(arguments or ()))]
        self.prefix = normalize(
            LaunchConfiguration('launch-prefix', default='') if prefix is None else prefix)
        self.__prefix_filter = None if prefix is not None else normalize(
            LaunchConfiguration('launch-prefix-filter', default=''))
        self.name = normalized_default(name)
        self.cwd = normalized_default(cwd)
        self.env = _normalize_environment(env)
        self.additional_env = _normalize_environment(additional_env)
        self.arguments = arguments
        self.final_cmd: list[str] | None = None
        self.final_cwd: str | None = None
        self.final_env: dict[str, str] | None = None
        self.final_name: str | None = None

    def prepare(self, context: LaunchContext, action: Action) -> None:
        """Work out the final command, name, directory and environment."""
        cmd = [perform_substitutions(context, word) for word in self.cmd]
        prefix = perform_substitutions(context, self.prefix)
        if prefix and (self.__prefix_filter is None or re.match(
                perform_substitutions(context, self.__prefix_filter), os.path.basename(cmd[0]))):
            import shlex
            cmd = shlex.split(prefix) + cmd
        name = os.path.basename(cmd[0]) if self.name is None else (
            perform_substitutions(context, self.name))
        env = dict(context.environment) if self.env is None else {}
        for key, value in (*(self.env or ()), *(self.additional_env or ())):
            env[perform_substitutions(context, key)] = perform_substitutions(context, value)
        self.final_cmd = cmd
        self.final_name = f'{name}-{next(_numbers)}'
        self.final_cwd = None if self.cwd is None else perform_substitutions(context, self.cwd)
        self.final_env = env

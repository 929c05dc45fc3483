# SPDX-License-Identifier: Apache-2.0
"""What can be executed."""
from __future__ import annotations

import itertools
import os
import re
from typing import Dict, Iterable, List, Optional, Tuple

from .._aliases import alias_submodules
from .._base import Action, SomeSubstitutionsType, Substitution
from ..launch_context import LaunchContext
from ..substitutions import LaunchConfiguration, normalized_default
from ..utilities import normalize_to_list_of_substitutions as normalize
from ..utilities import perform_substitutions

__all__ = ['Executable']

SomeEnvironment = Dict[SomeSubstitutionsType, SomeSubstitutionsType]
Environment = List[Tuple[List[Substitution], List[Substitution]]]

_numbers = itertools.count(1)


def _normalize_environment(environment: Optional[SomeEnvironment]) -> Optional[Environment]:
    if environment is None:
        return None
    return [(normalize(name), normalize(value)) for name, value in environment.items()]


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
        prefix: Optional[SomeSubstitutionsType] = None,
        name: Optional[SomeSubstitutionsType] = None,
        cwd: Optional[SomeSubstitutionsType] = None,
        env: Optional[SomeEnvironment] = None, additional_env: Optional[SomeEnvironment] = None,
        arguments: Optional[Iterable[SomeSubstitutionsType]] = None
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
        self.final_cmd: Optional[List[str]] = None
        self.final_cwd: Optional[str] = None
        self.final_env: Optional[Dict[str, str]] = None
        self.final_name: Optional[str] = None

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


alias_submodules(__name__, __all__)

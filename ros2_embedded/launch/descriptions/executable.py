# SPDX-License-Identifier: Apache-2.0
"""A command with its directory and environment."""
from __future__ import annotations

import itertools
import os
import re
from typing import Dict, Iterable, List, Optional, Tuple, TYPE_CHECKING

from ..launch_context import LaunchContext
from ..some_substitutions_type import SomeSubstitutionsType
from ..substitution import Substitution
from ..substitutions import LaunchConfiguration
from ..utilities import normalize_to_list_of_substitutions as normalize
from ..utilities import perform_substitutions

if TYPE_CHECKING:
    from ..action import Action

SomeEnvironment = Dict[SomeSubstitutionsType, SomeSubstitutionsType]
Environment = List[Tuple[List[Substitution], List[Substitution]]]

_numbers = itertools.count(1)


def _normalize_environment(environment: Optional[SomeEnvironment]) -> Optional[Environment]:
    if environment is None:
        return None
    return [(normalize(name), normalize(value)) for name, value in environment.items()]


class Executable:
    """
    A command to execute.

    :param cmd: the words of the command.
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
        self.__cmd = [normalize(word) for word in (*cmd, *(arguments or ()))]
        self.__prefix = normalize(
            LaunchConfiguration('launch-prefix', default='') if prefix is None else prefix)
        self.__prefix_filter = None if prefix is not None else normalize(
            LaunchConfiguration('launch-prefix-filter', default=''))
        self.__name = None if name is None else normalize(name)
        self.__cwd = None if cwd is None else normalize(cwd)
        self.__env = _normalize_environment(env)
        self.__additional_env = _normalize_environment(additional_env)
        self.__arguments = arguments
        self.__final_cmd: Optional[List[str]] = None
        self.__final_cwd: Optional[str] = None
        self.__final_env: Optional[Dict[str, str]] = None
        self.__final_name: Optional[str] = None

    @property
    def name(self) -> Optional[List[Substitution]]:
        """The name as it was given."""
        return self.__name

    @property
    def prefix(self) -> List[Substitution]:
        """The words before the command."""
        return self.__prefix

    @property
    def cmd(self) -> List[List[Substitution]]:
        """The words of the command; may be extended before :meth:`prepare`."""
        return self.__cmd

    @property
    def cwd(self) -> Optional[List[Substitution]]:
        """The working directory as it was given."""
        return self.__cwd

    @property
    def env(self) -> Optional[Environment]:
        """The environment as it was given."""
        return self.__env

    @property
    def additional_env(self) -> Optional[Environment]:
        """The additional environment as it was given."""
        return self.__additional_env

    @property
    def arguments(self) -> Optional[Iterable[SomeSubstitutionsType]]:
        """The further words as they were given."""
        return self.__arguments

    @property
    def final_name(self) -> Optional[str]:
        """The unique name, once prepared."""
        return self.__final_name

    @property
    def final_cmd(self) -> Optional[List[str]]:
        """The command, once prepared."""
        return self.__final_cmd

    @property
    def final_cwd(self) -> Optional[str]:
        """The working directory, once prepared; None for the launch's."""
        return self.__final_cwd

    @property
    def final_env(self) -> Optional[Dict[str, str]]:
        """The whole environment, once prepared."""
        return self.__final_env

    def prepare(self, context: LaunchContext, action: Action) -> None:
        """Work out the final command, name, directory and environment."""
        cmd = [perform_substitutions(context, word) for word in self.__cmd]
        executable = os.path.basename(cmd[0])
        prefix = perform_substitutions(context, self.__prefix)
        if prefix and (self.__prefix_filter is None or re.match(
                perform_substitutions(context, self.__prefix_filter), executable)):
            import shlex
            cmd = shlex.split(prefix) + cmd
            executable = os.path.basename(cmd[0])
        name = executable if self.__name is None else (
            perform_substitutions(context, self.__name))
        env = dict(context.environment) if self.__env is None else {}
        for key, value in (*(self.__env or ()), *(self.__additional_env or ())):
            env[perform_substitutions(context, key)] = perform_substitutions(context, value)
        self.__final_cmd = cmd
        self.__final_name = f'{name}-{next(_numbers)}'
        self.__final_cwd = None if self.__cwd is None else (
            perform_substitutions(context, self.__cwd))
        self.__final_env = env

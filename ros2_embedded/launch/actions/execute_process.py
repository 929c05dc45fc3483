# SPDX-License-Identifier: Apache-2.0
"""The action that executes a command."""
from __future__ import annotations

import shlex
from typing import Any, Dict, Iterable, List, Optional, TYPE_CHECKING

from ..action import ParsedAction
from ..descriptions import Executable
from ..frontend.entity import Entity
from ..frontend.expose import expose_action
from ..some_substitutions_type import SomeSubstitutionsType
from ..substitution import Substitution
from ..substitutions import TextSubstitution
from ._simple import Shutdown
from .execute_local import ExecuteLocal

if TYPE_CHECKING:
    from ..frontend import Parser


@expose_action('executable')
class ExecuteProcess(ExecuteLocal):
    """
    Executes a command; see :class:`launch.descriptions.Executable` for how it is described.

    Before it executes, ``name``, ``cmd``, ``cwd`` and ``env`` are substitutions; then texts.
    """

    def __init__(
        self, *, cmd: Iterable[SomeSubstitutionsType],
        prefix: Optional[SomeSubstitutionsType] = None,
        name: Optional[SomeSubstitutionsType] = None,
        cwd: Optional[SomeSubstitutionsType] = None,
        env: Optional[Dict[SomeSubstitutionsType, SomeSubstitutionsType]] = None,
        additional_env: Optional[Dict[SomeSubstitutionsType, SomeSubstitutionsType]] = None,
        **kwargs: Any
    ) -> None:
        super().__init__(process_description=Executable(
            cmd=cmd, prefix=prefix, name=name, cwd=cwd, env=env,
            additional_env=additional_env), **kwargs)

    @classmethod
    def _parse_cmdline(cls, cmd: str, parser: Parser) -> List[SomeSubstitutionsType]:
        """Split a command line into words, as a shell does; substitutions stay whole."""
        words: List[SomeSubstitutionsType] = []
        word: List[Substitution] = []

        def end_word() -> None:
            nonlocal word
            if word:
                words.append(word)
            word = []

        for sub in parser.parse_substitution(cmd):
            if not isinstance(sub, TextSubstitution):
                word.append(sub)
                continue
            if sub.text[:1].isspace():
                end_word()
            for number, token in enumerate(shlex.split(sub.text)):
                if number:
                    end_word()
                word.append(TextSubstitution(text=token))
            if sub.text[-1:].isspace():
                end_word()
        end_word()
        return words

    @classmethod
    def parse(
        cls, entity: Entity, parser: Parser, ignore: Optional[List[str]] = None
    ) -> ParsedAction:
        """
        Return this class and the keyword arguments that a frontend's entity gives.

        :param ignore: arguments that a derived class reads itself.
        """
        _, kwargs = super().parse(entity, parser)
        ignored = ignore or ()

        def read(name: str, attribute: str, data_type: Any = str) -> Any:
            if name in ignored:
                return None
            return entity.get_attr(attribute, data_type=data_type, optional=True)

        if 'cmd' not in ignored:
            kwargs['cmd'] = cls._parse_cmdline(entity.get_attr('cmd'), parser)
        for name, attribute in (
            ('cwd', 'cwd'), ('name', 'name'), ('prefix', 'launch-prefix'),
            ('output', 'output'), ('respawn', 'respawn')
        ):
            text = read(name, attribute)
            if text is not None:
                kwargs[name] = parser.parse_substitution(text)
        on_exit = read('on_exit', 'on_exit')
        if on_exit is not None:
            if on_exit != 'shutdown':
                raise ValueError(
                    'Attribute on_exit of Entity node expected to be shutdown but got '
                    f'`{on_exit}`Other on_exit actions not yet supported')
            kwargs['on_exit'] = [Shutdown()]
        for name in ('respawn_delay', 'sigkill_timeout', 'sigterm_timeout'):
            seconds = read(name, name, float)
            if seconds is not None:
                if seconds < 0.0:
                    raise ValueError(
                        f'Attribute {name} of Entity node expected to be a non-negative value '
                        f'but got `{seconds}`')
                kwargs[name] = seconds if name == 'respawn_delay' else str(seconds)
        for name, kind in (
            ('respawn_max_retries', int), ('shell', bool), ('emulate_tty', bool)
        ):
            value = read(name, name, kind)
            if value is not None:
                kwargs[name] = value
        variables = read('additional_env', 'env', List[Entity])
        if variables is not None:
            kwargs['additional_env'] = {
                tuple(parser.parse_substitution(variable.get_attr('name'))):
                parser.parse_substitution(variable.get_attr('value'))
                for variable in variables}
            for variable in variables:
                variable.assert_entity_completely_parsed()
        return cls, kwargs

    @property
    def name(self) -> Any:
        """The unique name once prepared, before that as it was given."""
        return self.__final('name')

    @property
    def cmd(self) -> Any:
        """The command once prepared, before that as substitutions."""
        return self.__final('cmd')

    @property
    def cwd(self) -> Any:
        """The working directory once prepared, before that as it was given."""
        return self.__final('cwd')

    @property
    def env(self) -> Any:
        """The environment once prepared, before that as it was given."""
        return self.__final('env')

    @property
    def additional_env(self) -> Any:
        """The additional environment as it was given."""
        return self.process_description.additional_env

    def __final(self, name: str) -> Any:
        final = getattr(self.process_description, f'final_{name}')
        return getattr(self.process_description, name) if final is None else final

# SPDX-License-Identifier: Apache-2.0
"""The action that executes a command."""
from __future__ import annotations

import shlex
from typing import Any, Iterable, TYPE_CHECKING

from .._base import ParsedAction, SomeSubstitutionsType, Substitution
from ..descriptions import Executable
from ..frontend.expose import expose_action
from ..frontend.type_utils import Entity
from ..substitutions import TextSubstitution
from ._simple import parse_pairs, Shutdown
from .execute_local import ExecuteLocal

if TYPE_CHECKING:
    from ..frontend import Parser


@expose_action('executable')
class ExecuteProcess(ExecuteLocal):
    """
    Executes a command; see :class:`launch.descriptions.Executable` for how it is described.

    Before it executes, ``name``, ``cmd``, ``cwd`` and ``env`` are substitutions; then texts.
    """

    _texts = {'cwd': 'cwd?', 'name': 'name?', 'prefix': 'launch-prefix?', 'output': 'output?',
              'respawn': 'respawn?'}
    _typed = {'respawn_delay': float, 'sigkill_timeout': float, 'sigterm_timeout': float,
              'respawn_max_retries': int, 'shell': bool, 'emulate_tty': bool}

    def __init__(
        self, *, cmd: Iterable[SomeSubstitutionsType],
        prefix: SomeSubstitutionsType | None = None, name: SomeSubstitutionsType | None = None,
        cwd: SomeSubstitutionsType | None = None, env: dict[Any, Any] | None = None,
        additional_env: dict[Any, Any] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(process_description=Executable(
            cmd=cmd, prefix=prefix, name=name, cwd=cwd, env=env,
            additional_env=additional_env), **kwargs)

    @classmethod
    def _parse_cmdline(cls, cmd: str, parser: Parser) -> list[SomeSubstitutionsType]:
        """Split a command line into words, as a shell does; substitutions stay whole."""
        words: list[SomeSubstitutionsType] = []
        word: list[Substitution] = []

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
        cls, entity: Entity, parser: Parser, ignore: list[str] | None = None
    ) -> ParsedAction:
        """
        Return the class and the keyword arguments that a frontend's entity gives.

        :param ignore: arguments that a derived class reads itself.
        """
        _, kwargs = super().parse(entity, parser)
        ignored = ignore or ()
        kwargs = {name: value for name, value in kwargs.items() if name not in ignored}
        if 'cmd' not in ignored:
            kwargs['cmd'] = cls._parse_cmdline(entity.get_attr('cmd'), parser)
        for name in {'respawn_delay', 'sigkill_timeout', 'sigterm_timeout'} & kwargs.keys():
            if kwargs[name] < 0.0:
                raise ValueError(
                    f'Attribute {name} of Entity node expected to be a non-negative value '
                    f'but got `{kwargs[name]}`')
            if name != 'respawn_delay':
                kwargs[name] = str(kwargs[name])
        on_exit = None if 'on_exit' in ignored else entity.get_attr('on_exit', optional=True)
        if on_exit not in (None, 'shutdown'):
            raise ValueError('Attribute on_exit of Entity node expected to be shutdown but got '
                             f'`{on_exit}`Other on_exit actions not yet supported')
        if on_exit is not None:
            kwargs['on_exit'] = [Shutdown()]
        if 'additional_env' not in ignored:
            kwargs['additional_env'] = parse_pairs(entity, parser, 'env')
        return cls, kwargs

    def __final(self, name: str) -> Any:
        final = getattr(self.process_description, f'final_{name}')
        return getattr(self.process_description, name) if final is None else final

    name = property(lambda self: self.__final('name'))
    cmd = property(lambda self: self.__final('cmd'))
    cwd = property(lambda self: self.__final('cwd'))
    env = property(lambda self: self.__final('env'))
    additional_env = property(lambda self: self.process_description.additional_env)

# SPDX-License-Identifier: Apache-2.0
"""Finds the parser for a launch file, and builds what its entities describe."""
from __future__ import annotations

import functools
import importlib
import os
from typing import Any, Iterable

from ros2cli.entry_points import load_entry_points

from .._base import Action, InvalidLaunchFileError
from ..launch_description import LaunchDescription
from .expose import instantiate_action
from .parse_substitution import (
    parse_if_substitutions,
    parse_substitution,
    replace_escaped_characters,
)
from .type_utils import Entity


class InvalidFrontendLaunchFileError(InvalidLaunchFileError):
    pass


class Parser:
    """
    Base of the frontends' parsers.

    Entry points: ``launch.frontend.launch_extension`` names modules that expose actions and
    substitutions, ``launch.frontend.parser`` parsers beside those for XML and YAML.
    """

    @staticmethod
    @functools.cache
    def load_launch_extensions() -> None:
        """Import, once, all that exposes actions and substitutions."""
        importlib.import_module('launch_ros')
        load_entry_points('launch.frontend.launch_extension')

    @staticmethod
    @functools.cache
    def _parsers() -> dict[str, type[Parser]]:
        parsers = {name: importlib.import_module(f'launch_{name}').Parser
                   for name in ('xml', 'yaml')}
        parsers.update(load_entry_points('launch.frontend.parser'))
        return dict(sorted(parsers.items()))

    def parse_action(self, entity: Entity) -> Action:
        self.load_launch_extensions()
        try:
            return instantiate_action(entity, self)
        except Exception as exc:
            vars(exc).setdefault('line', entity.line)
            raise

    parse_substitution = staticmethod(parse_substitution)
    parse_if_substitutions = staticmethod(parse_if_substitutions)
    escape_characters = staticmethod(replace_escaped_characters)

    def parse_description(self, entity: Entity) -> LaunchDescription:
        if entity.type_name != 'launch':
            raise RuntimeError("Expected 'launch' as root tag")
        self.load_launch_extensions()
        deprecated = entity.get_attr('deprecated', optional=True)
        return LaunchDescription(
            [self.parse_action(child) for child in entity.children], deprecated_reason=deprecated)

    @classmethod
    def get_available_extensions(cls) -> Iterable[str]:
        return cls._parsers().keys()

    @classmethod
    def may_parse(cls, filename: str) -> bool:
        return any(filename.endswith('.' + end) for end in cls.get_file_extensions())

    @classmethod
    def is_filename_valid(cls, filename: str) -> bool:
        return bool(cls.get_parsers_from_filename(filename))

    @classmethod
    def get_parsers_from_filename(cls, filename: str) -> list[type[Parser]]:
        return [parser for parser in cls._parsers().values() if parser.may_parse(filename)]

    @classmethod
    def load(cls, file: Any) -> tuple[Entity, Parser]:
        """
        Read a file, by path or open, with the parsers that claim it, or else with any.

        :return: the root entity, and the parser that read it.
        :raises InvalidFrontendLaunchFileError: if none could.
        """
        if isinstance(file, (str, bytes, os.PathLike)):
            with open(file, encoding='utf-8') as opened:
                return cls.load(opened)
        name = getattr(file, 'name', '')
        errors: list[Exception] = []
        for parser in cls.get_parsers_from_filename(name) or cls._parsers().values():
            try:
                return parser.load(file)
            except Exception as exc:  # noqa: BLE001 - Each format has its own errors.
                errors.append(exc)
                file.seek(0)
        raise InvalidFrontendLaunchFileError(likely_errors=errors, path=name)

    @classmethod
    def get_file_extensions(cls) -> set[str]:
        """Return how the names of this parser's files end, without the dot."""
        return set()

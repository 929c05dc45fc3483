# SPDX-License-Identifier: Apache-2.0
"""Reads launch files in YAML."""
from __future__ import annotations

from typing import Any, Set, Tuple

from launch import frontend
from launch.utilities.ros_yaml import load_launch_file

from .entity import Entity


class Parser(frontend.Parser):
    """Reads launch files in YAML."""

    @classmethod
    def load(cls, file: Any) -> Tuple[frontend.Entity, frontend.Parser]:
        """
        Read a file, by path or open.

        :raises yaml.YAMLError: with line and column.
        :raises RuntimeError: for a file with more than one root, or none.
        """
        if not hasattr(file, 'read'):
            with open(file, encoding='utf-8') as opened:
                return cls.load(opened)
        tree = load_launch_file(file)
        if not isinstance(tree, dict) or len(tree) != 1:
            raise RuntimeError('Expected only one root')
        [(type_name, element)] = tree.items()
        return Entity(element, type_name), cls()

    @classmethod
    def get_file_extensions(cls) -> Set[str]:
        return {'launch.yaml', 'launch.yml', 'yaml', 'yml', 'launch'}

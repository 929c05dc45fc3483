# SPDX-License-Identifier: Apache-2.0
"""Reads launch files in XML."""
from __future__ import annotations

from typing import Any, Set, Tuple

from launch import frontend

from .entity import Entity


class Parser(frontend.Parser):
    """Reads launch files in XML."""

    @classmethod
    def load(cls, file: Any) -> Tuple[frontend.Entity, frontend.Parser]:
        """
        Read a file, by path or open.

        :raises xml.etree.ElementTree.ParseError: with line and column.
        """
        import xml.etree.ElementTree as ET
        root = ET.parse(file).getroot()
        assert root is not None
        return Entity(root), cls()

    @classmethod
    def get_file_extensions(cls) -> Set[str]:
        return {'launch.xml', 'xml', 'launch'}

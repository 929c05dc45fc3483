# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 pkg``."""
from __future__ import annotations

import os
from typing import Any

from ament_index_python.packages import get_packages_with_prefixes
from ros2cli.packages import get_executable_paths, get_prefix_path
from ros2cli.verb import VerbExtension


class ListVerb(VerbExtension):
    """Output a list of available packages."""

    def main(self, *, args: Any) -> None:
        print(*sorted(get_packages_with_prefixes()), sep='\n')


class PrefixVerb(VerbExtension):
    """Output the prefix path of a package."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        parser.add_argument('package_name', help='The package name')
        parser.add_argument(
            '--share', action='store_true', help='Show share directory for the package')

    def main(self, *, args: Any) -> str | None:
        prefix = get_prefix_path(args.package_name)
        if prefix is None:
            return 'Package not found'
        print(os.path.join(prefix, 'share', args.package_name) if args.share else prefix)
        return None


class ExecutablesVerb(VerbExtension):
    """Output a list of package specific executables."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        parser.add_argument('package_name', nargs='?', help='The package name')
        parser.add_argument(
            '--full-path', action='store_true', help='Show full path of each executable')

    def main(self, *, args: Any) -> None:
        for name in sorted([args.package_name] if args.package_name else
                           get_packages_with_prefixes()):
            for path in sorted(get_executable_paths(name)):
                print(path if args.full_path else f'{name} {os.path.basename(path)}')

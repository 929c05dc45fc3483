# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 pkg``."""
from __future__ import annotations

import os
from typing import Any, Optional

from ros2cli.api.pkg import (
    get_executable_paths,
    get_package_names,
    get_prefix_path,
    package_name_completer,
    PackageNotFound,
)
from ros2cli.verb import VerbExtension

PACKAGE_NOT_FOUND = 'Package not found'


class ListVerb(VerbExtension):
    """Output a list of available packages."""

    def main(self, *, args: Any) -> None:
        for name in sorted(get_package_names()):
            print(name)


class PrefixVerb(VerbExtension):
    """Output the prefix path of a package."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        argument = parser.add_argument('package_name', help='The package name')
        argument.completer = package_name_completer
        parser.add_argument(
            '--share', action='store_true', help='Show share directory for the package')

    def main(self, *, args: Any) -> Optional[str]:
        prefix = get_prefix_path(args.package_name)
        if prefix is None:
            return PACKAGE_NOT_FOUND
        print(os.path.join(prefix, 'share', args.package_name) if args.share else prefix)
        return None


class ExecutablesVerb(VerbExtension):
    """Output a list of package specific executables."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        argument = parser.add_argument('package_name', nargs='?', help='The package name')
        argument.completer = package_name_completer
        parser.add_argument(
            '--full-path', action='store_true', default=False,
            help='Show full path of each executable')

    def main(self, *, args: Any) -> None:
        names = get_package_names() if args.package_name is None else [args.package_name]
        for name in sorted(names):
            try:
                paths = get_executable_paths(package_name=name)
            except PackageNotFound as exc:
                raise RuntimeError(f"Package '{name}' not found") from exc
            for path in sorted(paths):
                print(path if args.full_path else f'{name} {os.path.basename(path)}')

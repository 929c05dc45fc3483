# SPDX-License-Identifier: Apache-2.0
"""The command ``ros2 launch``."""
from __future__ import annotations

import contextlib
import os
import sys
from typing import Any

from ament_index_python.packages import get_package_share_directory, PackageNotFoundError
from ros2cli.command import CommandExtension
from ros2cli.plugin_system import instantiate_extensions


def _find(package: str, name: str | None) -> str:
    """Return the path of a launch file, anywhere below its package's share directory."""
    if name is None:
        raise RuntimeError(f"there is no launch file '{package}' (a launch file of a package has "
                           'the name of the package before it)')
    try:
        share = get_package_share_directory(package)
    except PackageNotFoundError as exc:
        raise RuntimeError(f"Package '{package}' not found: {exc}") from exc
    paths = [os.path.join(parent, name) for parent, _, names in os.walk(share) if name in names]
    if len(paths) == 1:
        return paths[0]
    where = f"in the share directory of package '{package}'"
    if not paths:
        raise RuntimeError(f"file '{name}' was not found {where} which is at '{share}'")
    listed = ', '.join(f"'{path}'" for path in paths)
    raise RuntimeError(f"file '{name}' was found more than once {where}: [{listed}]")


def _print_arguments(description: Any) -> None:
    print("Arguments (pass arguments as '<name>:=<value>'):")
    arguments = description.get_launch_arguments()
    for argument in arguments:
        mark = '*' if argument._conditionally_included else ''
        print(f"\n    '{argument.name}':{mark}\n        {argument.description}")
        if argument.default_value is not None:
            default = ' + '.join(token.describe() for token in argument.default_value)
            print(f'        (default: {default})')
    if not arguments:
        print('\n  No arguments.')
    elif any(argument._conditionally_included for argument in arguments):
        print('\n* argument(s) which are only used if specific conditions occur')


def _parse(arguments: list[str]) -> dict[str, str]:
    """Return names and values; of a name given twice, the last value."""
    parsed: dict[str, str] = {}
    for argument in arguments:
        name, _, value = argument.partition(':=')
        if not name or not value:
            raise RuntimeError(
                f"malformed launch argument '{argument}', expected format '<name>:=<value>'")
        parsed[name] = value
    return parsed


class LaunchCommand(CommandExtension):
    """Run a launch file."""

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        add = parser.add_argument
        add('-n', '--noninteractive', default=not sys.stdin.isatty(), action='store_true',
            help='Run the launch system non-interactively, with no terminal associated')
        add('-d', '--debug', action='store_true', help='More verbose output')
        group = parser.add_mutually_exclusive_group()
        group.add_argument(
            '-p', '--print', '--print-description', action='store_true',
            help='Print the launch description to the console without launching it.')
        group.add_argument(
            '-s', '--show-args', '--show-arguments', action='store_true',
            help='Show arguments that may be given to the launch file.')
        add('-a', '--show-all-subprocesses-output', action='store_true',
            help="Show all launched subprocesses' output, whatever the launch file says")
        add('--launch-prefix', help='Words to put before all executables')
        add('package_name', help='Name of the ROS package which contains the launch file')
        add('launch_file_name', nargs='?', help='Name of the launch file')
        add('launch_arguments', nargs='*',
            help="Arguments '<name>:=<value>'; for duplicates, last one wins")
        self._options = instantiate_extensions('ros2launch.option').values()
        for option in self._options:
            option.add_arguments(parser, cli_name)

    def main(self, *, parser: Any, args: Any) -> int | str | None:
        words = list(args.launch_arguments)
        if os.path.isfile(args.package_name):
            path = args.package_name
            words[:0] = [args.launch_file_name] if args.launch_file_name else []
        else:
            path = _find(args.package_name, args.launch_file_name)
        if args.show_all_subprocesses_output:
            os.environ['OVERRIDE_LAUNCH_PROCESS_OUTPUT'] = 'both'
        if args.launch_prefix:
            words.append(f'launch-prefix:={args.launch_prefix}')
        import launch
        from launch.actions import IncludeLaunchDescription
        from launch.launch_description_sources import (
            get_launch_description_from_any_launch_file,
            InvalidLaunchFileError,
        )
        if args.print or args.show_args:
            with contextlib.ExitStack() as undo:
                for option in self._options:
                    undo.enter_context(getattr(option, 'reading', contextlib.nullcontext)())
                try:
                    description = get_launch_description_from_any_launch_file(path)
                except InvalidLaunchFileError as exc:
                    raise RuntimeError(str(exc)) from exc
                if args.print:
                    print(launch.LaunchIntrospector().format_launch_description(description))
                else:
                    _print_arguments(description)
                for option in self._options:
                    preview = getattr(option, 'preview', lambda *_: '')
                    print(preview(description, args, _parse(words)), end='')
            return None
        for option in self._options:
            option.prestart(args)
        service = launch.LaunchService(
            argv=words, noninteractive=args.noninteractive, debug=args.debug)
        description = launch.LaunchDescription([
            IncludeLaunchDescription(path, launch_arguments=_parse(words).items())])
        for option in self._options:
            description = option.prelaunch(description, args)[0]
        service.include_launch_description(description)
        status = service.run()
        for option in self._options:
            option.postlaunch(status, args)
        return status

# SPDX-License-Identifier: Apache-2.0
"""The command ``ros2 launch``."""
from __future__ import annotations

import os
import sys
from typing import Any, List, Optional, Union

from ament_index_python.packages import PackageNotFoundError
from ros2cli.api.launch import (
    get_share_file_path_from_package,
    launch_a_launch_file,
    LaunchFileNameCompleter,
    MultipleLaunchFilesError,
    print_a_launch_file,
    print_arguments_of_launch_file,
)
from ros2cli.api.pkg import package_name_completer
from ros2cli.command import CommandExtension, get_command_extensions
from ros2cli.plugin_system import satisfies_version


class OptionExtension:
    """Further options of ``ros2 launch``; entry point group ``ros2launch.option``."""

    NAME: Optional[str] = None
    EXTENSION_POINT_VERSION = '0.1'

    def __init__(self) -> None:
        satisfies_version(self.EXTENSION_POINT_VERSION, '^0.1')

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        """Add arguments to ``ros2 launch``."""

    def prestart(self, args: Any) -> None:
        """Act before anything is launched."""

    def prelaunch(self, launch_description: Any, args: Any) -> Any:
        """Return a tuple of the launch description to be launched."""
        return (launch_description,)

    def postlaunch(self, launch_return_code: int, args: Any) -> None:
        """Act after the launch."""


class LaunchCommand(CommandExtension):
    """Run a launch file."""

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        parser.add_argument(
            '-n', '--noninteractive', default=not sys.stdin.isatty(), action='store_true',
            help='Run the launch system non-interactively, with no terminal associated')
        parser.add_argument(
            '-d', '--debug', default=False, action='store_true',
            help='Put the launch system in debug mode, provides more verbose output.')
        group = parser.add_mutually_exclusive_group()
        group.add_argument(
            '-p', '--print', '--print-description', default=False, action='store_true',
            help='Print the launch description to the console without launching it.')
        group.add_argument(
            '-s', '--show-args', '--show-arguments', default=False, action='store_true',
            help='Show arguments that may be given to the launch file.')
        parser.add_argument(
            '-a', '--show-all-subprocesses-output', default=False, action='store_true',
            help="Show all launched subprocesses' output by overriding their output "
                 'configuration using the OVERRIDE_LAUNCH_PROCESS_OUTPUT envvar.')
        parser.add_argument(
            '--launch-prefix',
            help='Prefix command, which should go before all executables. Command must be '
                 "wrapped in quotes if it contains spaces (e.g. --launch-prefix 'xterm -e gdb "
                 "-ex run --args').")
        parser.add_argument(
            '--launch-prefix-filter',
            help='Regex pattern for filtering which executables the --launch-prefix is applied '
                 'to by matching the executable name.')
        argument = parser.add_argument(
            'package_name', help='Name of the ROS package which contains the launch file')
        argument.completer = package_name_completer
        argument = parser.add_argument(
            'launch_file_name', nargs='?', help='Name of the launch file')
        argument.completer = LaunchFileNameCompleter()
        argument = parser.add_argument(
            'launch_arguments', nargs='*',
            help="Arguments to the launch file; '<name>:=<value>' (for duplicates, last one "
                 'wins)')
        argument.completer = lambda **kwargs: ()
        self._option_extensions = get_command_extensions('ros2launch.option')
        for _, extension in sorted(self._option_extensions.items()):
            extension.add_arguments(parser, cli_name)

    def main(self, *, parser: Any, args: Any) -> Union[int, str, None]:
        arguments: List[str] = list(args.launch_arguments)
        if os.path.isfile(args.package_name):
            path = args.package_name
            if args.launch_file_name is not None:
                arguments.insert(0, args.launch_file_name)
        else:
            try:
                path = get_share_file_path_from_package(
                    package_name=args.package_name, file_name=args.launch_file_name)
            except PackageNotFoundError as exc:
                raise RuntimeError(f"Package '{args.package_name}' not found: {exc}") from exc
            except (FileNotFoundError, MultipleLaunchFilesError) as exc:
                raise RuntimeError(str(exc)) from exc
        if args.launch_prefix is None and args.launch_prefix_filter is not None:
            raise RuntimeError(
                '--launch-prefix must be specified if --launch-prefix-filter is provided')
        if args.show_all_subprocesses_output:
            os.environ['OVERRIDE_LAUNCH_PROCESS_OUTPUT'] = 'both'
        if args.print:
            print_a_launch_file(launch_file_path=path)
            return None
        if args.show_args:
            print_arguments_of_launch_file(launch_file_path=path)
            return None
        return launch_a_launch_file(
            launch_file_path=path, launch_file_arguments=arguments,
            noninteractive=args.noninteractive, args=args, debug=args.debug,
            option_extensions=self._option_extensions)

# SPDX-License-Identifier: Apache-2.0
"""Launch files: found, described, launched."""
from __future__ import annotations

import os
from typing import Any, Dict, Iterable, List, Optional, Tuple

from ament_index_python.packages import get_package_share_directory, PackageNotFoundError


class MultipleLaunchFilesError(Exception):
    """More than one file of a package has the name."""

    def __init__(self, msg: str, paths: List[str]) -> None:
        super().__init__(msg)
        self.paths = paths


def _files(directory: str) -> Iterable[str]:
    for parent, _, names in os.walk(directory):
        for name in names:
            yield os.path.join(parent, name)


def get_share_file_path_from_package(*, package_name: str, file_name: str) -> str:
    """
    Return the path of the file, anywhere below the package's share directory.

    :raises PackageNotFoundError: if there is no such package.
    :raises FileNotFoundError: if there is no such file.
    :raises MultipleLaunchFilesError: if there are several.
    """
    share = get_package_share_directory(package_name)
    paths = [path for path in _files(share) if os.path.basename(path) == file_name]
    if not paths:
        raise FileNotFoundError(
            f"file '{file_name}' was not found in the share directory of package "
            f"'{package_name}' which is at '{share}'")
    if len(paths) > 1:
        listed = ', '.join(f"'{path}'" for path in paths)
        raise MultipleLaunchFilesError(
            f"file '{file_name}' was found more than once in the share directory of package "
            f"'{package_name}': [{listed}]", paths)
    return paths[0]


def is_launch_file(path: str) -> bool:
    """Say whether it is a file whose name ends like a launch file's."""
    from launch.frontend import Parser
    endings = ('launch.py', *Parser.get_file_extensions_from_parsers())
    return path.endswith(endings) and os.path.isfile(path)


def print_a_launch_file(*, launch_file_path: str) -> None:
    """Print what the launch file describes."""
    import launch
    from launch.launch_description_sources import get_launch_description_from_any_launch_file
    description = get_launch_description_from_any_launch_file(launch_file_path)
    print(launch.LaunchIntrospector().format_launch_description(description))


def print_arguments_of_launch_file(*, launch_file_path: str) -> None:
    """Print the arguments that the launch file takes."""
    from launch.launch_description_sources import get_launch_description_from_any_launch_file
    print_arguments_of_launch_description(
        launch_description=get_launch_description_from_any_launch_file(launch_file_path))


def print_arguments_of_launch_description(*, launch_description: Any) -> None:
    """Print the arguments that the launch description takes."""
    print("Arguments (pass arguments as '<name>:=<value>'):")
    arguments = launch_description.get_launch_arguments()
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


def parse_launch_arguments(launch_arguments: List[str]) -> Iterable[Tuple[str, str]]:
    """
    Return names and values; of a name given twice, the last value.

    :raises RuntimeError: for what isn't ``<name>:=<value>``.
    """
    parsed: Dict[str, str] = {}
    for argument in launch_arguments:
        name, separator, value = argument.partition(':=')
        if not name or not separator or not value:
            raise RuntimeError(
                f"malformed launch argument '{argument}', expected format '<name>:=<value>'")
        parsed[name] = value
    return parsed.items()


def launch_a_launch_file(
    *, launch_file_path: str, launch_file_arguments: List[str], noninteractive: bool = False,
    args: Any = None, option_extensions: Optional[Dict[str, Any]] = None, debug: bool = False
) -> int:
    """
    Launch it, until all is done or the user interrupts.

    :param option_extensions: of the entry point group ``ros2launch.option``.
    :return: 0, or 1 after an error.
    """
    import launch
    from launch.actions import IncludeLaunchDescription
    from launch.launch_description_sources import AnyLaunchDescriptionSource
    extensions = [extension for _, extension in sorted((option_extensions or {}).items())]
    for extension in extensions:
        extension.prestart(args)
    for name in ('launch_prefix', 'launch_prefix_filter'):
        value = getattr(args, name, None)
        if value:
            launch_file_arguments.append(f"{name.replace('_', '-')}:={value}")
    service = launch.LaunchService(
        argv=launch_file_arguments, noninteractive=noninteractive, debug=debug)
    description = launch.LaunchDescription([IncludeLaunchDescription(
        AnyLaunchDescriptionSource(launch_file_path),
        launch_arguments=parse_launch_arguments(launch_file_arguments))])
    for extension in extensions:
        description = extension.prelaunch(description, args)[0]
    service.include_launch_description(description)
    status = service.run()
    for extension in extensions:
        extension.postlaunch(status, args)
    return status


class LaunchFileNameCompleter:
    """The names of a package's launch files, for argcomplete."""

    def __init__(self, *, package_name_key: str = 'package_name') -> None:
        self.package_name_key = package_name_key

    def __call__(self, prefix: str, parsed_args: Any, **kwargs: Any) -> List[str]:
        try:
            share = get_package_share_directory(getattr(parsed_args, self.package_name_key))
        except PackageNotFoundError:
            return []
        return [os.path.basename(path) for path in _files(share) if is_launch_file(path)]

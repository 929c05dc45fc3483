# SPDX-License-Identifier: Apache-2.0
"""Commands of ``ros2``, and parsers that load only the one that is called."""
from __future__ import annotations

import argparse
import inspect
import os
from typing import Any, Dict, Iterable, Iterator, List, Optional, Set

from ros2cli.entry_points import get_entry_points, get_first_line_doc
from ros2cli.plugin_system import instantiate_extensions, PLUGIN_SYSTEM_VERSION, satisfies_version


class CommandExtension:
    """
    A command; entry point group ``ros2cli.command``.

    The first line of its docstring is its help. :meth:`main` is required.

    :raises PluginException: if the extension is for another version.
    """

    NAME: Optional[str] = None
    EXTENSION_POINT_VERSION = '0.1'

    def __init__(self) -> None:
        satisfies_version(PLUGIN_SYSTEM_VERSION, '^0.1')

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        """Add the command's arguments."""

    def main(self, *, parser: Any, args: Any) -> Any:
        """Do it; return the exit status, or a text for standard error (exit status 1)."""
        raise NotImplementedError()


def get_command_extensions(
    group_name: str, *, exclude_names: Optional[Iterable[str]] = None
) -> Dict[str, Any]:
    """Return the group's commands or verbs by name."""
    extensions = instantiate_extensions(group_name, exclude_names=exclude_names)
    for name, extension in extensions.items():
        extension.NAME = name
    return extensions


def _describe(extensions: Dict[str, Any], hidden: Optional[Iterable[str]]) -> str:
    names = [name for name in sorted(extensions) if name not in (hidden or ())]
    width = max((len(name) for name in names), default=0)
    return ''.join(
        f'{name.ljust(width)}  {get_first_line_doc(extensions[name])}\n' for name in names)


class _LateText:
    """A text that argparse gets before there is one."""

    def __init__(self) -> None:
        self.value = ''

    def __getattr__(self, name: str) -> Any:
        return getattr(self.value, name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.value)

    def __contains__(self, text: str) -> bool:
        return text in self.value

    def __mod__(self, values: Any) -> str:
        return str(self.value % values)


class SuppressUsageOutput:
    """Keeps parsers, while entered, from printing help and from exiting with success."""

    def __init__(self, parsers: Iterable[Any]) -> None:
        self._parsers: Set[Any] = set(parsers)

    def __enter__(self) -> None:
        def exit_unless_success(
            parser: Any, status: int = 0, message: Optional[str] = None
        ) -> None:
            if status:
                type(parser).exit(parser, status, message)

        for parser in self._parsers:
            parser.print_help = lambda *args: None
            parser.exit = exit_unless_success.__get__(parser)

    def __exit__(self, *args: Any) -> None:
        for parser in self._parsers:
            del parser.print_help, parser.exit


def add_subparsers_on_demand(
    parser: Any, cli_name: str, dest: str, group_name: str,
    hide_extensions: Optional[List[str]] = None, required: bool = True, argv: Any = None
) -> Any:
    """
    Add a parser for each extension, but load only the one that the arguments call.

    :param dest: the attribute of the parsed arguments that is to hold the extension.
    :param hide_extensions: what the help leaves out.
    :param argv: the arguments, by default the process's.
    """
    description = _LateText()
    subparser = parser.add_subparsers(
        title='Commands', description=description,
        metavar=f'Call `{cli_name} <command> -h` for more detailed usage.')
    # With a space no attribute of the namespace can be in the way.
    subparser.dest = ' ' + dest.lstrip('_')
    subparser.required = required
    names = get_entry_points(group_name).keys()
    parsers = {
        name: subparser.add_parser(
            name, formatter_class=argparse.RawDescriptionHelpFormatter)
        for name in sorted(names)}

    root_parser = getattr(parser, '_root_parser', parser)
    completing = os.environ.get('_ARGCOMPLETE') == '1'
    words = argv
    if completing:
        from argcomplete import split_line
        words = split_line(os.environ['COMP_LINE'])[3][1:]
    with SuppressUsageOutput([parser, *parsers.values()]):
        try:
            known, _ = root_parser.parse_known_args(args=words)
            called = getattr(known, subparser.dest)
        except SystemExit:
            if not completing:
                raise
            called = None
    if called is None:
        extensions = get_command_extensions(group_name)
        description.value = _describe(extensions, hide_extensions)
        for name, extension in extensions.items():
            parsers[name].set_defaults(**{dest: extension})
        return subparser

    extensions = get_command_extensions(
        group_name, exclude_names=[name for name in names if name != called])
    if called not in extensions:
        # Why has been logged.
        raise RuntimeError(f"'{cli_name} {called}' can't be loaded")
    extension = extensions[called]
    command_parser = parsers[called]
    command_parser.set_defaults(**{dest: extension})
    command_parser.description = get_first_line_doc(extension)
    if hasattr(extension, 'add_arguments'):
        kwargs = {}
        if 'argv' in inspect.signature(extension.add_arguments).parameters:
            kwargs['argv'] = argv
        command_parser._root_parser = root_parser
        extension.add_arguments(command_parser, f'{cli_name} {called}', **kwargs)
        del command_parser._root_parser
    return subparser

# SPDX-License-Identifier: Apache-2.0
"""Commands of ``ros2``, and parsers that load only the one that is called."""
from __future__ import annotations

import argparse
import contextlib
import inspect
import os
from typing import Any, Iterable, Iterator

from ros2cli.entry_points import get_entry_points, get_first_line_doc
from ros2cli.plugin_system import Extension, instantiate_extensions

#: Commands and verbs of ROS 2 that aren't here, by entry point group.
_LACKING = {
    'ros2cli.command': 'action bag component control daemon doctor extension_points extensions '
                       'interface lifecycle multicast security test trace wtf',
    'ros2param.verb': 'delete describe dump load',
    'ros2pkg.verb': 'create xml',
    'ros2service.verb': 'echo find info type',
    'ros2topic.verb': 'bw delay find type',
}


class CommandExtension(Extension):
    """
    A command; entry point group ``ros2cli.command``.

    The first line of its docstring is its help. :meth:`main` is required.
    """

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        """Add the command's arguments."""

    def main(self, *, parser: Any, args: Any) -> Any:
        """Do it; return the exit status, or a text for standard error (exit status 1)."""
        raise NotImplementedError()


class VerbsCommand(CommandExtension):
    """A command that is nothing but verbs."""

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        self._parser = parser
        add_subparsers_on_demand(
            parser, cli_name, '_verb', f'ros2{self.NAME}.verb', required=False, argv=argv)

    def main(self, *, parser: Any, args: Any) -> Any:
        if not hasattr(args, '_verb'):
            self._parser.print_help()
            return 0
        return args._verb.main(args=args)


class _Lacking:
    """Stands for a command or verb that isn't here."""

    def __init__(self, name: str) -> None:
        self.name = name

    def main(self, **_: Any) -> None:
        from embedded_default.lacking import NotEmbeddedError
        raise NotEmbeddedError(f"'{self.name}'")


@contextlib.contextmanager
def _quiet(parsers: Iterable[Any]) -> Iterator[None]:
    """Keep parsers from printing help and from exiting with success."""
    def exit_unless_success(parser: Any, status: int = 0, message: str | None = None) -> None:
        if status:
            type(parser).exit(parser, status, message)

    for parser in parsers:
        parser.print_help = lambda *args: None
        parser.exit = exit_unless_success.__get__(parser)
    try:
        yield
    finally:
        for parser in parsers:
            del parser.print_help, parser.exit


def _called(root_parser: Any, dest: str, argv: Any) -> Any:
    """Say which of the subparsers the arguments, or the words to be completed, call."""
    if os.environ.get('_ARGCOMPLETE') != '1':
        return getattr(root_parser.parse_known_args(args=argv)[0], dest)
    from argcomplete import split_line  # type: ignore[attr-defined, unused-ignore]
    try:
        words = split_line(os.environ['COMP_LINE'])[3][1:]
        return getattr(root_parser.parse_known_args(args=words)[0], dest)
    except SystemExit:
        return None


def add_subparsers_on_demand(
    parser: Any, cli_name: str, dest: str, group_name: str,
    hide_extensions: list[str] | None = None, required: bool = True, argv: Any = None
) -> Any:
    """
    Add a parser for each extension, but load only the one that the arguments call.

    :param dest: the attribute of the parsed arguments that is to hold the extension.
    :param hide_extensions: what the help leaves out.
    :param argv: the arguments, by default the process's.
    """
    subparser = parser.add_subparsers(
        title='Commands', description='',
        metavar=f'Call `{cli_name} <command> -h` for more detailed usage.')
    # With a space no attribute of the namespace can be in the way.
    subparser.dest = ' ' + dest.lstrip('_')
    subparser.required = required
    names = get_entry_points(group_name).keys()
    lacking = set(_LACKING.get(group_name, '').split()) - names
    parsers = {name: subparser.add_parser(
        name, formatter_class=argparse.RawDescriptionHelpFormatter, add_help=name in names)
        for name in sorted({*names, *lacking})}
    root_parser = getattr(parser, '_root_parser', parser)
    with _quiet([parser, *parsers.values()]):
        called = _called(root_parser, subparser.dest, argv)
    if called in lacking:
        parsers[called].set_defaults(**{dest: _Lacking(f'{cli_name} {called}')})
        parsers[called].add_argument('rest', nargs=argparse.REMAINDER)
        return subparser
    extensions = instantiate_extensions(
        group_name, exclude_names=called and [name for name in names if name != called])
    if called is None:
        shown = [name for name in sorted(extensions) if name not in (hide_extensions or ())]
        width = max(map(len, shown), default=0)
        parser._subparsers.description = ''.join(
            f'{name.ljust(width)}  {get_first_line_doc(extensions[name])}\n' for name in shown)
        return subparser
    if called not in extensions:
        # Why has been logged.
        raise RuntimeError(f"'{cli_name} {called}' can't be loaded")
    extension = extensions[called]
    parsers[called].set_defaults(**{dest: extension})
    parsers[called].description = get_first_line_doc(extension)
    if hasattr(extension, 'add_arguments'):
        kwargs = {}
        if 'argv' in inspect.signature(extension.add_arguments).parameters:
            kwargs['argv'] = argv
        parsers[called]._root_parser = root_parser
        extension.add_arguments(parsers[called], f'{cli_name} {called}', **kwargs)
        del parsers[called]._root_parser
    return subparser

# SPDX-License-Identifier: Apache-2.0
"""The extension point for verbs of ``ros2 fog``, and functions that verbs share."""

from __future__ import annotations

import abc
import argparse
import sys
from typing import Optional, TYPE_CHECKING, Union

from ros2cli.plugin_system import PLUGIN_SYSTEM_VERSION, satisfies_version

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence


class VerbExtension(abc.ABC):
    """
    A verb of ``ros2 fog``.

    ros2cli sets ``NAME`` to the entry point's name. ``main`` returns an exit status. A FogError
    of ``main`` becomes one line on the terminal and the exit status 1.
    """

    NAME: Optional[str] = None
    EXTENSION_POINT_VERSION = '0.1'

    def __init__(self) -> None:
        super().__init__()
        satisfies_version(PLUGIN_SYSTEM_VERSION, '^0.1')

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""

    @abc.abstractmethod
    def main(self, *, args: argparse.Namespace) -> Union[int, str, None]:
        """Run the verb and return its exit status."""


def complete(argument: argparse.Action, names: Callable[[], Iterable[str]]) -> None:
    """Let the shell complete an argument with those of ``names()`` that begin like its text."""
    argument.completer = (  # type: ignore[attr-defined]
        lambda prefix, **_: [name for name in names() if name.startswith(prefix)])


def add_name(parser: argparse.ArgumentParser) -> None:
    """Add the argument ``name``, with completion from the machines that this robot knows."""
    complete(parser.add_argument('name', help="the machine's name"), machine_names)


def machine_names() -> list[str]:
    """Return the names of machines that this robot knows, without asking providers."""
    from fogros2.store import Store
    return [record.name for record in Store().machines()]


def add_region(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """
    Add FogROS2's own ``--region``.

    :param several: it takes several values, which would swallow a machine's name after it.
    """
    more = '' if several else '; may be repeated'
    complete(parser.add_argument(
        '--region', nargs='*' if several else 1, action='extend', type=region, metavar='REGION',
        help=f"regions to ask where a provider has some; 'all' for every one{more}"),
             region_names)


def region(text: str) -> str:
    """
    Check that some provider has a region, and return its name.

    :raises argparse.ArgumentTypeError: no provider has it.
    """
    from fogros2.errors import did_you_mean
    names = region_names()
    if text in ('*', *names) or len(names) == 1:
        return text
    hint = did_you_mean(text, names, 'ros2 fog regions shows those there are')
    raise argparse.ArgumentTypeError(f"no provider has a region '{text}' ({hint})")


def number(text: str) -> float:
    """
    Parse a number of seconds, days or rows: 0 or more.

    :raises argparse.ArgumentTypeError: it is none.
    """
    try:
        if 0 <= float(text) <= 1e9:
            return float(text)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"'{text}' is no number from 0 on")


def parse_late(
    args: argparse.Namespace, words: Sequence[str], verb: str,
    add_options: Callable[[argparse.ArgumentParser], None], *, usage: Optional[str] = None,
) -> list[str]:
    """Parse options among words that argparse has left alone, and return the other words."""
    parser = argparse.ArgumentParser(prog=f'ros2 fog {verb}', usage=usage)
    add_options(parser)
    parser.add_argument('words', nargs='*')
    others: list[str] = parser.parse_intermixed_args(words, args).words
    return others


def add_command(parser: argparse.ArgumentParser, shell: str) -> None:
    """
    Add the argument ``command``; see :func:`command_of`.

    :param shell: what runs without a command.
    """
    parser.add_argument('command', nargs=argparse.REMAINDER,
                        help=f'-- and a command to run instead of {shell}')


def command_of(
    args: argparse.Namespace, verb: str,
    add_options: Callable[[argparse.ArgumentParser], None] = lambda parser: None,
) -> list[str]:
    """Return the command after ``--``; parse the options before it, which argparse took for it."""
    words: list[str] = args.command
    if words and words[0].startswith('-') and words[0] != '--':
        end = words.index('--') if '--' in words else len(words)
        late = argparse.ArgumentParser(
            prog=f'ros2 fog {verb} NAME', usage='%(prog)s [OPTIONS] [-- COMMAND ...]')
        add_options(late)
        late.parse_args(words[:end], args)
        words = words[end:]
    return words[1:] if words[:1] == ['--'] else words


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """Add ``--machine``."""
    argument = parser.add_argument(
        '--machine', action='append', default=[], metavar='NAME=PROVIDER[,KEYWORD=VALUE...]',
        help="Run a cloud machine of the launch elsewhere, such as planner=container, "
             "planner=aws,region=eu-west-1, planner=ssh:user@host, or '*=robot': all of them "
             'on this computer, without the cloud')
    argument.completer = overrides  # type: ignore[attr-defined]


def overrides(prefix: str, **_: object) -> list[str]:
    """
    Return the completions of an argument of ``--machine`` that begins with ``prefix``.

    First come the names of machines that this computer knows, then providers, then the keywords
    of the provider. The completion reads no launch file.
    """
    name, equals, rest = prefix.partition('=')
    if not equals:
        return [f'{one}=' for one in [*machine_names(), '*'] if one.startswith(name)]
    from fogros2.describe import keywords
    before, comma, last = rest.rpartition(',')
    if not comma:
        return [f'{name}={one}' for one in keywords.providers() if one.startswith(last)]
    provider = before.partition(',')[0].partition(':')[0]
    if '=' in last or provider not in keywords.providers():
        return []
    return [f'{name}={before},{one}=' for one in keywords.keywords(
        keywords.machine_class(provider)) if one.startswith(last) and one != 'name']


def region_names() -> list[str]:
    """Return 'all' and the regions of all providers, without any request."""
    from fogros2 import plugin_system
    from fogros2.errors import FogError
    names = ['all']
    for provider in provider_names():
        try:
            names += plugin_system.load('fogros2.provider', provider).region_names()
        except FogError:
            continue  # the verb reports a provider that cannot be loaded
    return names


def provider_names() -> list[str]:
    """Return the names of the providers, without loading them."""
    from fogros2 import plugin_system
    return plugin_system.names('fogros2.provider')


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument('--json', action='store_true', help='print JSON, for programs')


def print_json(**fields: object) -> None:
    """Print what ``--json`` of a verb shows."""
    from ros2fog_cli.api import output
    print(output.as_json(fields), flush=True)


def say(text: str, *, error: bool = False) -> None:
    """
    Print a line; a closed terminal or pipe does not end the verb.

    :param error: print it to standard error.
    """
    from ros2fog_cli.api import progress
    with progress.aside():
        try:
            print(text, file=sys.stderr if error else sys.stdout, flush=True)
        except BrokenPipeError:
            pass


def warn(text: str) -> None:
    """Print a line to standard error."""
    say(text, error=True)


def add_deletion(parser: argparse.ArgumentParser) -> None:
    """Add ``--yes`` and ``--dry-run``."""
    parser.add_argument('--yes', '-y', action='store_true', help="don't ask for confirmation")
    parser.add_argument('--dry-run', action='store_true', help='print what would be done')


def delete_each(
    doomed: Sequence[tuple[str, str, Callable[[], None]]], kind: str, args: argparse.Namespace,
) -> int:
    """
    Delete what the user agrees to; return 1 if something still exists.

    :param doomed: the name of each, more about it, and the function that deletes it.
    :param kind: such as 'volume'.
    :param args: has ``dry_run`` and ``yes``.
    """
    from fogros2.errors import FogError
    from ros2fog_cli.api import progress
    for name, about, _ in doomed:
        say(f"{'would delete' if args.dry_run else 'delete'} {name}: {about}")
    if args.dry_run:
        return 0
    if not args.yes and not agreed(kind, len(doomed)):
        return 1
    failed = 0
    with progress.working('deleting'):
        for name, _, delete in doomed:
            try:
                delete()
                say(f'deleted {name}')
            except FogError as error:
                warn(f'{name}: {error}')
                failed = 1
    return failed


def agreed(kind: str, number: int) -> bool:
    """Ask the user whether to delete ``number`` things; without a terminal, the answer is no."""
    if not sys.stdin.isatty():
        warn('not deleted: there is no terminal to ask at (--yes answers)')
        return False
    return confirmed(f"Delete {f'this {kind}' if number == 1 else f'these {number} {kind}s'}?")


def confirmed(question: str) -> bool:
    """Ask the user a question; without a terminal, the answer is no."""
    if not sys.stdin.isatty():
        return False
    # a program may read what the verb prints
    print(f'{question} [y/N] ', end='', file=sys.stderr, flush=True)
    try:
        return input().strip().lower() in ('y', 'yes')
    except EOFError:  # Ctrl-D
        warn('')
        return False

# SPDX-License-Identifier: Apache-2.0
"""The command ``ros2 node``."""

from typing import Any

from ros2cli.command import add_subparsers_on_demand, CommandExtension


class NodeCommand(CommandExtension):
    """Various node related sub-commands."""

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        self._subparser = parser
        add_subparsers_on_demand(
            parser, cli_name, '_verb', 'ros2node.verb', required=False, argv=argv)

    def main(self, *, parser: Any, args: Any) -> Any:
        if not hasattr(args, '_verb'):
            self._subparser.print_help()
            return 0
        return args._verb.main(args=args)

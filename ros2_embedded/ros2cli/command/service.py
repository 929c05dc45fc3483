# SPDX-License-Identifier: Apache-2.0
"""The command ``ros2 service``."""

from typing import Any

from ros2cli.command import add_subparsers_on_demand, CommandExtension


class ServiceCommand(CommandExtension):
    """Various service related sub-commands."""

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        self._subparser = parser
        parser.add_argument(
            '--include-hidden-services', action='store_true',
            help='Consider hidden services as well')
        add_subparsers_on_demand(
            parser, cli_name, '_verb', 'ros2service.verb', required=False, argv=argv)

    def main(self, *, parser: Any, args: Any) -> Any:
        if not hasattr(args, '_verb'):
            self._subparser.print_help()
            return 0
        return args._verb.main(args=args)

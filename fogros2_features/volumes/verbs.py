# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog volume``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ros2fog_cli.verb import (
    add_deletion,
    add_json,
    add_region,
    delete_each,
    parse_late,
    print_json,
    VerbExtension,
    warn,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fogros2.model import Volume


class VolumeVerb(VerbExtension):
    """List and delete volumes: disks and folders that outlive machines."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        parser.add_argument('action', choices=('list', 'delete'), metavar='list | delete', help=(
            'of all providers that are set up; of Kubernetes the current context, of Google '
            'Cloud the project of your credentials'))
        _add_options(parser)
        parser.add_argument('rest', nargs=argparse.REMAINDER, metavar='...',
                            help='names or ids of volumes to delete; options may be anywhere')

    def main(self, *, args: argparse.Namespace) -> int:
        """List all volumes, or delete those that are named."""
        import functools

        from fogros2.errors import ConfigurationError
        from fogros2_features.volumes import listing
        from fogros2_features.volumes.keepers import volume_keeper
        from ros2fog_cli.api import machines
        names = parse_late(args, args.rest, 'volume', _add_options)
        if (args.action == 'delete') != bool(names):
            takes = 'names or ids of volumes' if args.action == 'delete' else 'no names'
            raise ConfigurationError(f"'ros2 fog volume {args.action}' takes {takes}",
                                     'ros2 fog volume list shows all')
        volumes = listing.survey(warn, regions=args.region, hosts=args.host)
        if args.action == 'delete':
            return delete_each([
                (volume.name, f'{volume.provider} {volume.id}, with its data', functools.partial(
                    volume_keeper(machines.load(volume.provider, args.region)).delete_volume,
                    volume.id))
                for volume in _named(volumes, names)], 'volume', args)
        if args.json:
            print_json(volumes=[listing.to_json(volume) for volume in volumes])
        else:
            _print(volumes)
        return 0


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--host', action='append', default=[],
                        help='SSH host to ask as well; may be repeated')
    add_region(parser)
    add_deletion(parser)
    add_json(parser)


def _print(volumes: Sequence[Volume]) -> None:
    from ros2fog_cli.api import table
    if not volumes:
        print('no volumes')
        return
    print(table.table(
        ('NAME', 'VOLUME', 'PROVIDER', 'PLACE', 'SIZE', 'USED BY', 'COST/MONTH'),
        [(volume.name, volume.id, volume.provider, volume.region or table.NONE,
          table.NONE if volume.size_gb is None else f'{volume.size_gb} GB',
          volume.user or table.NONE, table.cost(volume.cost_per_month, 2)) for volume in volumes],
        width=table.terminal_width(), optional=('PROVIDER', 'PLACE', 'VOLUME')))


def _named(volumes: Sequence[Volume], words: Sequence[str]) -> list[Volume]:
    """
    Return the volumes with these names or ids.

    :raises ConfigurationError: a word fits none, or several.
    """
    from fogros2.errors import ConfigurationError
    chosen = []
    for word in words:
        matches = [volume for volume in volumes if word in (volume.id, volume.name)]
        if not matches:
            raise ConfigurationError(f"there is no volume '{word}'",
                                     'ros2 fog volume list shows those there are')
        if len(matches) > 1:
            raise ConfigurationError(f"there are {len(matches)} volumes '{word}'", 'name one: '
                                     + ', '.join(volume.id for volume in matches))
        chosen += matches
    return chosen


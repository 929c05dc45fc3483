# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog image``."""

from __future__ import annotations

import argparse
import sys
import time

from ros2fog_cli.verb import (
    add_deletion,
    add_json,
    add_region,
    complete,
    delete_each,
    machine_names,
    parse_late,
    print_json,
    VerbExtension,
    warn,
)

_USAGE = """\
ros2 fog image [OPTIONS] NAME [NAME ...]
       ros2 fog image list [OPTIONS]
       ros2 fog image delete [OPTIONS] IMAGE [IMAGE ...]
       ros2 fog image create --registry REGISTRY [OPTIONS]"""


class ImageVerb(VerbExtension):
    """Create images of machines, list and delete images."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        parser.usage = _USAGE
        first = parser.add_argument(
            'first', metavar='list | delete | create | NAME',
            help="'list', 'delete' with ids or names of images, 'create' for pods (see "
                 "'ros2 fog image create -h'), or a machine to make an image of")
        complete(first, lambda: [*machine_names(), 'list', 'delete', 'create'])
        _add_options(parser)
        parser.add_argument('rest', nargs=argparse.REMAINDER, metavar='...',
                            help='more names or ids; options may be anywhere')

    def main(self, *, args: argparse.Namespace) -> int:
        """Run the action that the first argument names."""
        from fogros2.errors import ConfigurationError
        if args.first == 'create':
            return _create(args)
        first, rest = args.first, parse_late(
            args, args.rest, 'image', _add_options, usage=_USAGE)
        if first == 'list':
            if rest:
                raise ConfigurationError("'ros2 fog image list' takes no names",
                                         'it lists all images')
            return _list(args)
        if first == 'delete':
            if not rest:
                raise ConfigurationError("'ros2 fog image delete' takes ids or names of images",
                                         'ros2 fog image list shows them')
            return _delete(args, rest)
        if args.image_name and rest:
            raise ConfigurationError('--image-name is for the image of one machine',
                                     'leave it out, or make one image at a time')
        return max(_make(args, name) for name in [first, *rest])


def _add_options(parser: argparse.ArgumentParser) -> None:
    add_region(parser)
    parser.add_argument('--image-name', metavar='NAME',
                        help="the image's name (default: the machine's, and the time)")
    add_deletion(parser)
    add_json(parser)


def _create(args: argparse.Namespace) -> int:
    parser = argparse.ArgumentParser(
        prog='ros2 fog image create',
        description='Build the image for pods, with all in it that a launch from this terminal '
                    'would install, and push it.')
    parser.add_argument('--registry', required=True,
                        help="registry to push the image to, such as 'registry.example/robots'")
    parser.add_argument('--base', default='', help='base image')
    parser.add_argument('--workspace', help='workspace whose dependencies are installed (default: '
                                            "the sourced one; '' for none)")
    parser.add_argument('--engine', choices=('auto', 'podman', 'docker', 'buildah'),
                        default='auto', help='program that builds it (default: the first found)')
    parser.add_argument('--folder', default='fogros2_image',
                        help='folder for the Containerfile (default: %(default)s)')
    parser.add_argument('--no-push', action='store_true', help='build it, but do not push it')
    parser.add_argument('--dry-run', action='store_true', help='only print the Containerfile')
    words = parser.parse_args(args.rest)
    from pathlib import Path

    from fogros2_features.images import pods
    recipe = pods.recipe(words.registry, base=words.base, folder=words.workspace)
    if words.dry_run or args.dry_run:
        print(recipe.containerfile, end='')
        return 0
    made = pods.build(recipe, Path(words.folder), engine=words.engine,
                           push=not words.no_push, say=warn)
    print(f"{'built' if words.no_push else 'pushed'} {made}")
    registry = made.rpartition(':')[0]
    print(f"launch files take it by container_image='{registry}:{{dependencies}}'")
    return 0


def _list(args: argparse.Namespace) -> int:
    from fogros2_features.images import baking
    from ros2fog_cli.api import table
    listing = baking.survey(warn, regions=args.region)
    if args.json:
        print_json(images=[baking.to_json(image) for image in listing])
    elif not listing:
        print('no images')
    else:
        now = time.time()
        print(table.table(
            ('NAME', 'IMAGE', 'PROVIDER', 'PLACE', 'STATE', 'AGE', 'SIZE', 'DEPENDENCIES'),
            [(image.name, image.id, image.provider, image.region or table.NONE,
              image.state or table.NONE,
              table.duration(None if image.created is None else max(0.0, now - image.created)),
              table.NONE if image.size_gb is None else f'{image.size_gb} GB',
              image.dependencies or table.NONE) for image in listing],
            width=table.terminal_width(),
            optional=('DEPENDENCIES', 'PROVIDER', 'SIZE', 'PLACE', 'AGE')))
    return 0


def _make(args: argparse.Namespace, name: str) -> int:
    from fogros2.errors import FogError
    from fogros2_features.images import baking
    from ros2fog_cli.api import progress, reach
    entry = reach.find(name, warn, regions=args.region)
    print(f"{'would make' if args.dry_run else 'make'} an image of {entry.name}: "
          f"{entry.provider} {entry.machine_id or '-'}, {entry.state}", file=sys.stderr)
    if args.dry_run:
        return 0
    baking.flush(entry, warn)
    image = baking.bake(entry, args.image_name or '')
    if not image.dependencies:
        warn('what is installed on the machine is not known: no launch takes the image by '
             f'itself, but each that names it does ({image.id})')
    try:
        with progress.working('making'):
            baking.wait(image)
    except KeyboardInterrupt:
        warn(f'the image goes on being made: {image.id} (ros2 fog image list shows it)')
        raise
    except FogError as error:
        warn(f'{image.name}: {error}')
        return 1
    if args.json:
        print_json(id=image.id, name=image.name, provider=image.provider,
                   dependencies=image.dependencies)
    else:
        print(f'made {image.name} ({image.id})')
    return 0


def _delete(args: argparse.Namespace, words: list[str]) -> int:
    import functools

    from fogros2_features.images import baking
    return delete_each([
        (image.name, f'{image.provider} {image.id}, {image.state}',
         functools.partial(baking.delete, image))
        for image in baking.named(baking.survey(warn, regions=args.region), words)], 'image', args)

# SPDX-License-Identifier: Apache-2.0
"""Create, await, list and delete images of machines, for all providers that have images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import dataclasses
import time
from typing import Any, Optional

from fogros2.errors import ConfigurationError, FogError, ProviderError
from fogros2.model import Command, MachineState
from fogros2.provider import TAG_DEPENDENCIES
from fogros2.provider.vm.failures import wait_through
from fogros2.provider.vm.images import Image
from fogros2.waiting import TO_DISK
from fogros2_features.images.keepers import image_keeper
from ros2fog_cli.api import machines, reach
from ros2fog_cli.api.machines import Entry, Warn

#: Time-out of an image's creation in seconds; a large disk takes long.
TIMEOUT = 3600.0
#: Longest poll interval in seconds; each poll asks all regions.
LOOK = 10.0
READY, FAILED = 'available', ('failed', 'error', 'invalid')


def flush(entry: Entry, warn: Warn) -> None:
    """Flush a machine's file system buffers, because an image contains only the disk."""
    if entry.machine is None or entry.machine.state is not MachineState.RUNNING:
        return
    try:
        with reach.session(entry) as shell:
            shell.run(Command(('sync',), what='write everything to the disk'), timeout=TO_DISK)
    except FogError as error:
        warn(f"{entry.name}: what isn't on the disk yet may be missing in the image: {error}")


def bake(entry: Entry, name: str = '', now: Optional[float] = None) -> Image:
    """
    Start to create an image of a machine, and return it at once.

    Its ``dependencies`` are '' if launches will not find it automatically.

    :param name: name of the image; '': the machine's name and the time, because names are unique.
    :param now: the time in seconds since the epoch; None: the current time.
    :raises FogError: the machine is neither running nor stopped, or its provider has no images.
    """
    if entry.machine is None or entry.machine.state not in (
            MachineState.RUNNING, MachineState.STOPPED):
        raise ConfigurationError(f"no image can be made of '{entry.name}': it is {entry.state}",
                                 'the machine has to be running or stopped')
    if not name:
        stamp = time.strftime('%Y%m%d-%H%M%S', time.gmtime(now))
        name = f'{entry.name}-image-{stamp}'
    dependencies = entry.machine.tags.get(TAG_DEPENDENCIES, '')
    made = image_keeper(machines.load(entry.provider)).bake(entry.machine.id, name, dependencies)
    return Image(made, name, entry.provider, dependencies=dependencies)


def wait(baking: Image, *, timeout: float = TIMEOUT) -> Image:
    """
    Wait until an image is available, and return it.

    :raises ProviderError: the creation failed, or the image disappeared.
    :raises DeadlineExceeded: the image is not available after ``timeout`` seconds.
    """
    keeper = image_keeper(machines.load(baking.provider))
    seen = False

    def probe() -> Optional[Image]:
        nonlocal seen
        image = next((one for one in keeper.images() if one.id == baking.id), None)
        if image is None:
            if seen:
                raise ProviderError(f"the image '{baking.name}' was deleted while it was made")
            return None  # a new image may be missing from the list at first
        seen = True
        if image.state in FAILED:
            raise ProviderError(f"the image '{baking.name}' ({image.id}) is {image.state}",
                                f'ros2 fog image delete {image.id}, and try again')
        return image if image.state == READY else None

    return wait_through(probe, timeout=timeout, interval=0.5, longest=LOOK,
                        what=f"the image '{baking.name}'",
                        hint='it goes on: ros2 fog image list shows it')


def survey(warn: Warn, *, regions: Optional[Sequence[str]] = None) -> list[Image]:
    """Return the images of all providers; warn about a provider that does not answer."""
    def ask(name: str) -> Iterable[Image]:
        return image_keeper(machines.load(name, regions)).images()

    return sorted(
        machines.gather(warn, regions, ask),
        key=lambda image: (image.name, image.region, image.id))


def named(images: Sequence[Image], words: Sequence[str]) -> list[Image]:
    """
    Return the images whose id or name is one of ``words``.

    :raises ConfigurationError: a word matches no image.
    """
    matches = [image for image in images if image.id in words or image.name in words]
    missing = [word for word in words
               if not any(word in (image.id, image.name) for image in matches)]
    if missing:
        raise ConfigurationError(f"there is no image {', '.join(missing)}",
                                 'ros2 fog image list shows those there are')
    return matches


def delete(image: Image) -> None:
    """
    Delete an image and its disk snapshots, and check that the image is gone.

    :raises FogError: the image still exists.
    """
    keeper = image_keeper(machines.load(image.provider))
    keeper.delete_image(image.id)
    if any(one.id == image.id for one in keeper.images()):
        raise ProviderError(f'the image {image.id} is still there', 'try again')


def to_json(image: Image) -> dict[str, Any]:
    """Return an image as JSON data: times in seconds since the epoch, size in GB."""
    # programs that read this output know the region as 'place'
    return {'place' if field.name == 'region' else field.name: getattr(image, field.name)
            for field in dataclasses.fields(image)}

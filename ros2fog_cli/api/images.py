# SPDX-License-Identifier: Apache-2.0
"""Images of machines: made, waited for, listed, deleted, over all providers that keep some."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
import dataclasses
import time
from typing import Any, Optional

from fogros2 import plugin_system
from fogros2.errors import ConfigurationError, FogError, ProviderError, Unsupported
from fogros2.model import Command, Image, MachineState
from fogros2.provider import TAG_DEPENDENCIES
from fogros2.waiting import wait_until
from ros2fog_cli.api import machines, reach
from ros2fog_cli.api.machines import Entry, Warn

#: Seconds that an image of a large disk may take.
PATIENCE = 3600.0
#: Seconds between two looks, at the most: each asks all regions.
LOOK = 10.0
READY, FAILED = 'available', ('failed', 'error', 'invalid')


@dataclasses.dataclass(frozen=True)
class Baking:
    """An image that is being made; ``dependencies`` '' where no launch will find it by itself."""

    id: str
    name: str
    provider: str
    dependencies: str


def flush(entry: Entry, warn: Warn) -> None:
    """Have a machine write what is in its memory to its disk, as an image is made of the disk."""
    if entry.machine is None or entry.machine.state is not MachineState.RUNNING:
        return
    try:
        with reach.session(entry) as shell:
            shell.run(Command(('sync',), what='write everything to the disk'), timeout=60.0)
    except FogError as error:
        warn(f"{entry.name}: what isn't on the disk yet may be missing in the image: {error}")


def bake(entry: Entry, name: str = '', now: Optional[float] = None) -> Baking:
    """
    Ask for an image of a machine, and return at once.

    :param name: '' for one made of the machine's name and the time: names can't be used twice.
    :raises FogError: the machine doesn't run, or its provider keeps no images.
    """
    if entry.machine is None or entry.machine.state not in (
            MachineState.RUNNING, MachineState.STOPPED):
        raise ConfigurationError(f"no image can be made of '{entry.name}': it is {entry.state}",
                                 'it has to run, or to be stopped')
    if not name:
        stamp = time.strftime('%Y%m%d-%H%M%S', time.gmtime(now))
        name = f'{entry.name}-image-{stamp}'
    dependencies = entry.machine.tags.get(TAG_DEPENDENCIES, '')
    made = machines.load(entry.provider).bake(entry.machine.id, name, dependencies)
    return Baking(made, name, entry.provider, dependencies)


def wait(
    baking: Baking, *, timeout: float = PATIENCE,
    look: Callable[[str, float], None] = lambda state, seconds: None,
) -> Image:
    """
    Wait until an image is ready, and return it.

    :param look: called with its state and the seconds since the beginning.
    :raises ProviderError: it failed, or vanished.
    :raises DeadlineExceeded: after ``timeout`` seconds.
    """
    provider = machines.load(baking.provider)
    begin = time.monotonic()
    seen = False

    def probe() -> Optional[Image]:
        nonlocal seen
        image = next((one for one in provider.images() if one.id == baking.id), None)
        if image is None:
            if seen:
                raise ProviderError(f"the image '{baking.name}' was deleted while it was made")
            return None  # what has just been made isn't listed everywhere yet
        seen = True
        look(image.state, time.monotonic() - begin)
        if image.state in FAILED:
            raise ProviderError(f"the image '{baking.name}' ({image.id}) is {image.state}",
                                f'ros2 fog image delete {image.id}, and try again')
        return image if image.state == READY else None

    return wait_until(probe, timeout=timeout, interval=0.5, longest=LOOK,
                      what=f"the image '{baking.name}'",
                      hint='it goes on: ros2 fog image list shows it')


def survey(warn: Warn, *, regions: Optional[Sequence[str]] = None) -> list[Image]:
    """Return the images of all providers that keep some; one that can't be asked is a warning."""
    names = [name for name in plugin_system.names('fogros2.provider')
             if machines.wanted(name, regions)]

    def ask(name: str) -> list[Image]:
        try:
            return list(machines.load(name, regions).images())
        except Unsupported:
            return []
        except FogError as error:
            warn(f'{name}: {error}')
            return []

    with ThreadPoolExecutor(max(1, len(names)), 'fog-images') as pool:
        found = [image for images in pool.map(ask, names) for image in images]
    return sorted(found, key=lambda image: (image.name, image.place, image.id))


def named(images: Sequence[Image], words: Sequence[str]) -> list[Image]:
    """
    Return the images that have one of ``words`` as their id or name.

    :raises ConfigurationError: one fits none.
    """
    found = [image for image in images if image.id in words or image.name in words]
    missing = [word for word in words
               if not any(word in (image.id, image.name) for image in found)]
    if missing:
        raise ConfigurationError(f"there is no image {', '.join(missing)}",
                                 'ros2 fog image list shows those there are')
    return found


def delete(image: Image) -> None:
    """
    Delete an image with the copies of disks behind it, and look that it is gone.

    :raises FogError: it is still there.
    """
    provider = machines.load(image.provider)
    provider.delete_image(image.id)
    if any(one.id == image.id for one in provider.images()):
        raise ProviderError(f'the image {image.id} is still there', 'try again')


def to_json(image: Image) -> dict[str, Any]:
    """Return an image as JSON: times in seconds since the epoch, size in GB."""
    return {field.name: getattr(image, field.name) for field in dataclasses.fields(image)}

# SPDX-License-Identifier: Apache-2.0
"""Images of machines that a cloud's adapter has made: their ids and tags."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import re
from typing import Optional

from fogros2.errors import MachineNotFound, ProviderError
from fogros2.provider import TAG_DEPENDENCIES
from fogros2.provider.vm.cloud import TAG_BAKED, TAG_DRIVER, TAG_USER


@dataclasses.dataclass(frozen=True)
class Image:
    """
    A disk image made from a machine, for later machines.

    :param id: opaque to the core; contains its location.
    :param dependencies: hash of the installed dependencies; a launch uses an image with its hash.
    """

    id: str
    name: str
    provider: str
    region: str = ''
    created: Optional[float] = None
    size_gb: Optional[int] = None
    state: str = ''
    dependencies: str = ''
    tags: Mapping[str, str] = dataclasses.field(default_factory=dict)


def image_tags(
    name: str, machine: Mapping[str, str], dependencies: str, *, nvidia: bool = False,
) -> dict[str, str]:
    """
    Return the tags of an image of a machine with the tags ``machine``.

    :param nvidia: the machine began with NVIDIA's driver.
    """
    tags = {TAG_BAKED: name, TAG_USER: machine.get(TAG_USER, ''), TAG_DEPENDENCIES: dependencies,
            TAG_DRIVER: 'nvidia' * nvidia}
    return {key: value for key, value in tags.items() if value}


def image_parts(image_id: str, form: str) -> tuple[str, ...]:
    """
    Return the groups of a regular expression in the id of an image.

    :raises MachineNotFound: the id is not an image's.
    """
    parts = re.fullmatch(form, image_id)
    if parts is None:
        raise MachineNotFound(f"'{image_id}' is no image of {form.partition(':')[0]}",
                              'ros2 fog image list')
    return parts.groups()


def check_baked(tags: Mapping[str, str], name: str) -> None:
    """
    Check that an image may be deleted.

    :raises ProviderError: FogROS2 has not made it.
    """
    if TAG_BAKED not in tags:
        raise ProviderError(f'{name} is no image of FogROS2',
                            'ros2 fog image list shows those that are')

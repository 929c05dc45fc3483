# SPDX-License-Identifier: Apache-2.0
"""Providers that keep images of their machines."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol, runtime_checkable

from fogros2.errors import Unsupported
from fogros2.provider import Provider
from fogros2.provider.vm.images import Image
from fogros2.provider.vm.provider import VmProvider


@runtime_checkable
class ImageKeeper(Protocol):
    """
    A keeper of images: a provider may have these methods.

    For clouds of virtual machines, :class:`CloudImages` has them. It passes them on to the cloud's
    adapter: ``bake`` there gets the parts of the id, and ``images`` a region.
    """

    def bake(self, machine_id: Any, name: str, dependencies: str) -> str:
        """
        Start to make an image of a machine, and return its id; ``images`` reports its state.

        :param dependencies: see :class:`~fogros2.provider.vm.images.Image`.
        """

    def images(self) -> Iterable[Image]:
        """Yield the images that were made of machines."""

    def delete_image(self, image_id: str) -> None:
        """Delete an image and its disk snapshots; idempotent."""


class CloudImages:
    """The keeper of the images of a cloud whose adapter is one."""

    def __init__(self, provider: VmProvider, cloud: Any) -> None:
        self._provider = provider
        self._cloud = cloud

    def bake(self, machine_id: str, name: str, dependencies: str) -> str:
        """Make an image of a machine by its id."""
        image_id: str = self._cloud.bake(self._provider.vm_id(machine_id), name, dependencies)
        return image_id

    def images(self) -> Iterable[Image]:
        """Return the images of all regions."""
        cloud: Any = self._provider.until()
        by_region = self._provider.everywhere(cloud, lambda region: list(cloud.images(region)))
        return [image for images in by_region for image in images]

    def delete_image(self, image_id: str) -> None:
        """Delete an image."""
        self._cloud.delete_image(image_id)


def image_keeper(provider: Provider) -> ImageKeeper:
    """
    Return what keeps the images of a provider's machines.

    :raises Unsupported: the provider keeps none.
    """
    if isinstance(provider, VmProvider) and isinstance(provider.cloud, ImageKeeper):
        return CloudImages(provider, provider.cloud)
    if isinstance(provider, ImageKeeper):
        return provider
    raise Unsupported(f"provider '{provider.name}' keeps no images of machines",
                      'AWS, Azure and Google Cloud do; for pods: ros2 fog image create')

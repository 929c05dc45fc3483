# SPDX-License-Identifier: Apache-2.0
"""Providers that keep volumes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol, runtime_checkable

from fogros2.errors import Unsupported
from fogros2.model import Volume
from fogros2.provider import Attached, Provider


@runtime_checkable
class VolumeKeeper(Protocol):
    """
    A keeper of volumes: a provider with the capability ``keeps_volumes`` has these methods.

    For clouds of virtual machines, ``clouds.CloudVolumes`` has them, by the adapter's disks.
    """

    def volumes(self, hosts: Sequence[str] = ()) -> Iterable[Volume]:
        """
        Yield the volumes.

        :param hosts: computers with an SSH server whose volumes are meant, too.
        """

    def attach(self, machine_id: str, name: str, size_gb: int) -> Attached:
        """
        Attach a volume to a running machine; make it if there is none of this name.

        Idempotent. ``create`` has refused a volume that another machine uses.

        :raises NameTaken: another machine has got the volume since, or a kept machine has none.
        """

    def detach(self, machine_id: str, name: str) -> None:
        """Detach a volume that the machine no longer uses; idempotent."""

    def delete_volume(self, volume_id: str) -> None:
        """
        Delete a volume and its data; idempotent.

        :raises NameTaken: a machine uses it.
        """


def volume_keeper(provider: Provider) -> VolumeKeeper:
    """
    Return what keeps the volumes of a provider.

    :raises Unsupported: the provider has none.
    """
    if provider.capabilities.keeps_volumes:
        if isinstance(provider, VolumeKeeper):
            return provider
        # not above: it imports what clouds share
        from fogros2.provider.vm.provider import VmProvider
        from fogros2_features.volumes.clouds import CloudVolumes
        if isinstance(provider, VmProvider):
            return CloudVolumes(provider)
    raise Unsupported(f"provider '{provider.name}' has no volumes",
                      'AWS, Azure, Google Cloud, Kubernetes, containers and SSH hosts do')

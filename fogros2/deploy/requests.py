# SPDX-License-Identifier: Apache-2.0
"""End the machine of a record, also of a creation that got no answer: it may still appear."""

from __future__ import annotations

import contextlib

from fogros2.errors import ProviderError, Unsupported
from fogros2.model import Machine
from fogros2.provider import Provider, TAG_LAUNCH, TAG_NAME
from fogros2.store import Record, Store


def end(provider: Provider, record: Record, age: float = 0.0, *, tidy: bool = True) -> bool:
    """
    Delete the machine of a record; return whether none of its creation can appear any more.

    :param record: without an id, it may have a machine: only a search by tags shows it.
    :param age: seconds since the launch stopped waiting for the answer.
    :param tidy: delete what was created beside the machine; the creation does so itself.
    :raises FogError: the provider does not answer.
    """
    if record.machine_id is not None:
        provider.destroy(record.machine_id)
        return True
    machines: list[Machine] = []
    with contextlib.suppress(Unsupported):
        machines += provider.find(
            {TAG_NAME: record.name, TAG_LAUNCH: record.last or record.launch})
    for machine in machines:
        provider.destroy(machine.id)
    if not record.token:
        return True
    if tidy:
        provider.tidy(dead=[record.token])
    return bool(machines) or not provider.may_create(record.token, age)


def set_aside(store: Store, record: Record) -> ProviderError:
    """Free a machine's name, keep its request for `ros2 fog gc`, and return the warning."""
    store.set_aside(record)
    return late(record)


def late(record: Record) -> ProviderError:
    """Return the error for a machine that may still appear."""
    return ProviderError(
        f"'{record.name}' may still appear: its provider '{record.provider}' has not answered the "
        'request for it', '`ros2 fog gc` deletes it when it has appeared')

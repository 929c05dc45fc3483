# SPDX-License-Identifier: Apache-2.0
"""
Undo what a launch has made, on a machine, at its provider and on the robot.

A machine's record (:class:`~fogros2.store.Record`) lists what the launch has made, each before it
is made; its other fields are the details. So any process can undo it, by the same functions: the
launch itself, and ``ros2 fog delete``, ``ros2 fog gc`` or the next launch for one that died.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
import contextlib
import time
from typing import Optional

from fogros2 import feature, plugin_system
from fogros2.errors import (
    ConnectError,
    DeadlineExceeded,
    FogError,
    ProviderError,
    StoreError,
    Unsupported,
)
from fogros2.model import Command, Machine
from fogros2.provider import Provider, TAG_LAUNCH, TAG_NAME
from fogros2.report import Reporter, StepFailed
from fogros2.store import Made, Record
from fogros2.vpn import STAYS, Vpn

# Remove the agent. A released agent is about to exit; an agent that was never reached still runs.
# Another robot's agent stays: its configuration names its launch.
# $1 folder, $2 launch, $3 our configuration.
_REMOVE = """\
running() { grep -qs serve "/proc/$pid/cmdline"; }
rm -f -- "$3"
if read -r pid 2>/dev/null <"$1/agent.pid" && running; then
    owner=$(sed -n 's/.*"launch": "\\([^"]*\\)".*/\\1/p' "$1/config.json" 2>/dev/null) || :
    case $owner in ''|"$2") ;; *) exit 0 ;; esac
    kill -s TERM "$pid" 2>/dev/null || :
    n=0
    while running && [ $n -lt 100 ]; do sleep 0.1; n=$((n + 1)); done
fi
# another robot may be about to start one
for each in "$1"/start-*.json; do [ ! -e "$each" ] || exit 0; done
rm -rf -- "$1"
# the folder of all agents goes with the last one
rmdir -- "${1%/*}" 2>/dev/null || :
"""


class UndoStack(contextlib.ExitStack):
    """
    Undo steps, of which the last pushed one runs first; one that fails does not stop the others.

    :param machine: name of the machine, '' for the robot.
    :param failures: receives the error of each step that fails; a launch and its machines share
        the list.
    """

    def __init__(self, report: Reporter, machine: str, failures: list[FogError]) -> None:
        super().__init__()
        self._report = report
        self._machine = machine
        self._failures = failures

    def add(self, name: str, undo: Callable[[], object]) -> None:
        """Push an undo step that is named in reports."""
        self.callback(self.run, name, undo)

    def run(self, name: str, undo: Callable[[], object]) -> None:
        """Run an undo step now; if it fails, report and remember the error."""
        begin = time.monotonic()
        try:
            undo()
        except FogError as error:
            self.failed(name, error, time.monotonic() - begin)

    def failed(self, name: str, error: FogError, seconds: float = 0.0) -> None:
        """Report and remember the error of an undo step."""
        self._report(StepFailed(self._machine, name, seconds, str(error)))
        self._failures.append(error)


class Site(abc.ABC):
    """
    A machine of which something is undone.

    :ivar machine: as the provider reported it.
    """

    record: Record
    machine: Machine
    #: Whether the agent has released the machine.
    released = False

    @property
    @abc.abstractmethod
    def provider(self) -> Provider:
        """The machine's provider."""

    @abc.abstractmethod
    def clean_up(self, commands: Iterable[Command]) -> str:
        """Run commands on the machine, each perhaps twice; return the last one's output."""

    @abc.abstractmethod
    def release(self) -> None:
        """Make the agent stop the nodes and release the machine."""


def first_config(record: Record) -> str:
    """Return the path of the configuration with which a launch starts an agent."""
    return f'{record.agent}/start-{record.last}.json'


def vpn_down(record: Record) -> Iterator[Command]:
    """Yield the commands that take a machine's interface down, or leave it to others."""
    assert record.vpn is not None
    vpn: Vpn = plugin_system.load('fogros2.vpn', 'wireguard')()
    return (vpn.leave if record.spec.on_exit == 'keep' else vpn.down)(record.vpn)


def _remove_agent(site: Site, made: Made) -> None:
    record = site.record
    site.clean_up([Command(
        ('sh', '-ec', _REMOVE, 'sh', record.agent, record.last, first_config(record)),
        sudo=True, what='remove the agent')])


def _release(site: Site, made: Made) -> None:
    if not site.released:
        site.release()
        site.released = True


def _take_vpn_down(site: Site, made: Made) -> str:
    try:
        _release(site, made)  # the agent would repair the interface
    finally:
        output = site.clean_up(vpn_down(site.record))
    return output.strip()


def _close_ssh(site: Site, made: Made) -> None:
    site.provider.allow(
        site.machine.id, made.port, site.provider.ssh_networks(site.record.spec))


#: Kinds of what a launch makes; reports name them. The others are names of features.
WATCHDOG, NODES, VPN = 'watchdog', 'nodes', 'VPN'
SSH_PORT, OPEN_PORT = 'firewall', 'open port'
#: Kinds that need the provider alone, and are there while the machine is stopped.
PORTS = (SSH_PORT, OPEN_PORT)
_UNDO: Mapping[str, Callable[[Site, Made], object]] = {
    WATCHDOG: _remove_agent,
    NODES: _release,
    VPN: _take_vpn_down,
    SSH_PORT: _close_ssh,
    OPEN_PORT: lambda site, made: site.provider.open_port(site.machine, made.port, ()),
}


def unmake(site: Site, made: Made) -> bool:
    """
    Undo one thing that a launch has made; return whether others keep it; idempotent.

    :raises FogError: it may still be there.
    """
    if made.kind in _UNDO:
        return _UNDO[made.kind](site, made) == STAYS
    if made.kind not in plugin_system.names(feature.GROUP):
        raise StoreError(f"the record of '{site.record.name}' has '{made.kind}', which this "
                         "version can't undo", 'install the plugin again, or the version that '
                         'made it; `ros2 fog delete --force` forgets it')
    site.clean_up(feature.load(made.kind).clean_up(site.record.last))
    return False


def close_ports(site: Site) -> tuple[Made, ...]:
    """
    Close the ports of a launch that died; return the rest of what it has made.

    The machine's agent undoes the rest by itself, of a kept machine with its next launch.

    :raises FogError: one may still be open; the others are closed.
    """
    unmake_all(site, [made for made in site.record.made if made.kind in PORTS])
    return tuple(made for made in site.record.made if made.kind not in PORTS)


def unmake_all(site: Site, things: Sequence[Made]) -> None:
    """
    Undo several things, the last made first.

    :raises FogError: of the first that failed; the others are undone, if the machine answers.
    """
    failures = []
    for made in reversed(things):
        try:
            unmake(site, made)
        except FogError as error:
            failures.append(error)
            if isinstance(error, (ConnectError, DeadlineExceeded)):
                break  # the others would wait for the same machine
    if failures:
        raise failures[0]


def end_machine(
    provider: Provider, record: Record, age: float = 0.0, *, tidy: bool = True,
    keep: Collection[Optional[str]] = (),
) -> bool:
    """
    Delete the machine of a record; return whether none of its creation can appear any more.

    :param record: without an id, it may have a machine: only a search by tags shows it.
    :param age: seconds since the launch stopped waiting for the answer.
    :param tidy: delete what was created beside the machine; the creation does so itself.
    :param keep: ids of machines of other requests.
    :raises FogError: the provider does not answer.
    """
    if record.machine_id is not None:
        provider.destroy(record.machine_id)
        return True
    machines: list[Machine] = []
    provider.search_for([record.spec])
    with contextlib.suppress(Unsupported):
        machines += (
            machine for machine in provider.find(
                {TAG_NAME: record.name, TAG_LAUNCH: record.last}) if machine.id not in keep)
    for machine in machines:
        provider.destroy(machine.id)
    if not record.token:
        return True
    if tidy:
        provider.tidy(dead=[record.token])
    return bool(machines) or not provider.may_create(record.token, age)


def late(record: Record) -> ProviderError:
    """Return the error for a machine that may still appear."""
    return ProviderError(
        f"'{record.name}' may still appear: its provider '{record.provider}' has not answered the "
        'request for it', '`ros2 fog gc` deletes it when it has appeared')

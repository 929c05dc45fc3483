# SPDX-License-Identifier: Apache-2.0
"""Data that the parts of FogROS2 exchange: frozen dataclasses, with JSON as only behaviour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
from decimal import Decimal
import enum
import json
from typing import Any, Literal, Optional, Union

OnExit = Literal['delete', 'stop', 'keep']
Bootstrap = Literal['auto', 'apt', 'pip', 'none']
#: Prefix length of the largest network of a launch.
NETWORK_PREFIX = 24
RobotNodes = Literal['after_cloud', 'immediately']

#: Maximum lifetime of a machine in seconds, unless its launch file sets another.
DEFAULT_LIFETIME = 8 * 3600.0
#: Default time in seconds without a heartbeat after which the launch counts as gone.
DEFAULT_ROBOT_TIMEOUT = 120.0


class MachineState(str, enum.Enum):
    """The state of a machine, with the same names for all providers."""

    PENDING = 'pending'
    RUNNING = 'running'
    STOPPING = 'stopping'
    STOPPED = 'stopped'
    DELETED = 'deleted'

    def __str__(self) -> str:
        return self.value


@dataclasses.dataclass(frozen=True)
class MachineSpec:
    """
    A machine as a launch file requests it: a description, not a machine.

    :param name: unique on a robot; a DNS label (letters, digits, ``-``, at most 40 characters).
    :param provider: name of an entry point in the group ``fogros2.provider``.
    :param options: the provider's own options; JSON types only.
    :param workspace: absolute path of the colcon workspace to send, or None for none.
    :param underlays: its underlay workspaces, which are sent too, the nearest first.
    :param on_exit: what happens to the machine when the launch ends.
    :param lifetime: seconds after which the machine ends by itself in any case.
    :param robot_timeout: seconds without the launch's heartbeat after which the nodes stop.
    :param environment: variables of every node on the machine.
    :param apt: Debian packages to install; ``pip`` Python packages, in pip's syntax.
    :param features: the values of features' keywords, by feature; JSON types only.
    :param wanted: for a machine of any cloud, the requirements for which the launch has chosen
        ``provider`` and ``options``.
    """

    name: str
    provider: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    workspace: Optional[str] = None
    underlays: tuple[str, ...] = ()
    on_exit: OnExit = 'delete'
    lifetime: float = DEFAULT_LIFETIME
    robot_timeout: float = DEFAULT_ROBOT_TIMEOUT
    bootstrap: Bootstrap = 'auto'
    environment: Mapping[str, str] = dataclasses.field(default_factory=dict)
    apt: tuple[str, ...] = ()
    pip: tuple[str, ...] = ()
    features: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    wanted: Optional[Mapping[str, Any]] = None

    @property
    def workspaces(self) -> tuple[str, ...]:
        """All workspaces to send; the packages of earlier ones win."""
        return (self.workspace, *self.underlays) if self.workspace else ()


@dataclasses.dataclass(frozen=True)
class Endpoint:
    """
    The address and login by which a Shell reaches a machine.

    :param kind: name of an entry point in the group ``fogros2.shell``: ssh, local, ...
    :param host: address or name; for kinds without one, the machine's id.
    :param user: login user; nodes run as this user.
    :param host_key: the host's public key in OpenSSH form (``ssh-ed25519 AAAA...``), pinned
        before the first connection; None to use ``known_hosts``.
    :param key_file: private key for the login; None for the user's own keys and agent.
    :param alias: name in the user's configuration of OpenSSH, whose settings then hold; '' for
        none of them.
    """

    kind: str
    host: str = ''
    port: int = 22
    user: str = ''
    host_key: Optional[str] = None
    key_file: Optional[str] = None
    alias: str = ''


@dataclasses.dataclass(frozen=True)
class Machine:
    """
    A provider's report about an existing machine.

    :param id: opaque to the core; contains its location (region, context, engine).
    :param created: seconds since the epoch, None if the provider does not know.
    :param stopped: when a stopped machine was stopped, in the same form.
    :param endpoint: None until the machine can be reached.
    :param vpn_host: address at which the robot reaches the machine's VPN port (UDP); '' if it
        cannot, so that the machine has to dial the robot.
    :param robot_host: if ``vpn_host`` is '': address at which the machine reaches the robot's
        VPN port (UDP), from an option or from the provider.
    :param vpn_port: UDP port that leads to the machine's VPN port from outside; 0: the same port.
    :param private_network: name of the private network (a cluster, a VPC) to which ``private_ip``
        belongs; two machines of the same private network dial each other there.
    :param private_ip: the machine's private IP in that network, '' for none.
    :param region: region, context and namespace, or engine; for people.
    :param kind: the kind of machine, such as an instance type; for people.
    :param image: the image that it started from, '' if there is none or it is unknown.
    :param key: the provider's name of its login key, '' as for ``image``.
    :param disk_gb: size of its disk in GB, None if unknown.
    :param owned: False for a computer that existed before and outlives the launch.
    :param end_command: command that the agent runs as root to end the machine; empty if the
        machine must not be ended.
    :param cost_per_hour: US dollars, None if unknown.
    :param billed: a stopped machine costs as much as a running one.
    :param note: what the provider chose, and why; shown when the machine comes up.
    """

    id: str
    name: str
    provider: str
    state: MachineState
    created: Optional[float] = None
    endpoint: Optional[Endpoint] = None
    vpn_host: str = ''
    vpn_port: int = 0
    robot_host: str = ''
    private_network: str = ''
    private_ip: str = ''
    region: str = ''
    kind: str = ''
    image: str = ''
    key: str = ''
    disk_gb: Optional[int] = None
    tags: Mapping[str, str] = dataclasses.field(default_factory=dict)
    owned: bool = True
    end_command: tuple[str, ...] = ()
    cost_per_hour: Optional[Decimal] = None
    stopped: Optional[float] = None
    note: str = ''
    billed: bool = False


@dataclasses.dataclass(frozen=True)
class Volume:
    """
    A disk or folder that outlives the machines that use it.

    :param id: opaque to the core; contains its location.
    :param region: region or zone, context and namespace, or engine; for people.
    :param user: the machine that has it attached, '' for none.
    :param gb_month: the usual price in US dollars for a GB and a month, None if unknown.
    """

    id: str
    name: str
    provider: str
    region: str = ''
    size_gb: Optional[int] = None
    user: str = ''
    gb_month: Optional[Decimal] = None

    @property
    def cost_per_month(self) -> Optional[Decimal]:
        """US dollars, None if unknown."""
        if self.gb_month is None or self.size_gb is None:
            return None
        return self.gb_month * self.size_gb


@dataclasses.dataclass(frozen=True)
class CreateRequest:
    """
    The core's request to create a machine, in addition to the spec.

    :param token: a uuid per attempt, stored before the call; a token never creates two machines.
    :param authorized_key: public key (OpenSSH form) that the login user accepts.
    :param tags: tags for every resource that the provider creates.
    :param vpn_port: UDP port to open.
    :param agent_config: the agent's first configuration, for providers that can start it at boot
        (``Capabilities.agent_directory``); the provider adds ``user`` and the ``end_command``.
    :param dependencies: hash of the dependencies that the machine needs, by which the provider
        finds a baked image; '' if unknown.
    :param application: container image of a web application that serves HTTP on port 8080, for
        providers that run one beside the machine (``Capabilities.application_port``); '' for none.
    :param with_volumes: by name, where volumes appear on the machine, and the GB of a new one; for
        providers with the capability ``keeps_volumes``.
    :param common: names of what its programs may exchange with machines of other launches on its
        host, for providers with ``share_folders``.
    """

    token: str
    authorized_key: str
    tags: Mapping[str, str]
    vpn_port: int
    agent_config: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    dependencies: str = ''
    application: str = ''
    with_volumes: Mapping[str, tuple[str, int]] = dataclasses.field(default_factory=dict)
    common: Sequence[str] = ()


@dataclasses.dataclass(frozen=True)
class Command:
    """
    A command line, for the robot or a machine.

    :param argv: the words, without a shell. Must not contain secrets: see ``input``.
    :param sudo: run as root (by ``sudo -n`` unless the user is root).
    :param input: bytes for the standard input, which may contain secrets.
    :param what: short description for progress and errors, such as 'set the VPN up'.
    """

    argv: tuple[str, ...]
    sudo: bool = False
    input: bytes = b''
    environment: Mapping[str, str] = dataclasses.field(default_factory=dict)
    what: str = ''

    @classmethod
    def script(cls, text: str, *, sudo: bool = False, what: str = '') -> Command:
        """Return a command that runs ``text`` in ``sh`` and stops at the first error."""
        return cls(('sh', '-ec', text), sudo=sudo, what=what)


@dataclasses.dataclass(frozen=True)
class Result:
    """The result of a command: exit status, output as text."""

    returncode: int
    stdout: str
    stderr: str


@dataclasses.dataclass(frozen=True)
class SyncReport:
    """The result of a sync: number of files and bytes sent over the network, seconds."""

    files: int
    bytes: int
    seconds: float


@dataclasses.dataclass(frozen=True)
class Peer:
    """
    A host in the VPN of a launch, as another host sees it.

    :param address: the host's address inside the VPN.
    :param endpoint: ``host:port`` at which it can be dialled, None behind NAT.
    """

    name: str
    public_key: str
    address: str
    endpoint: Optional[str] = None


@dataclasses.dataclass(frozen=True)
class VpnInterface:
    """
    The VPN interface of one host in one launch.

    :param name: at most 15 characters, ``fog<id>``.
    :param address: this host's address.
    :param network: the launch's subnet in CIDR form.
    :param port: UDP port on which it listens.
    :param key_file: path of the private key on this host (0600); the key never leaves the host.
    :param firewall: admit only DDS and ping, and forward nothing (on the robot).
    :param host_routes: route only the peers' addresses into the VPN, because a network of the
        host overlaps the launch's subnet.
    :param process: id of a process, or the file with the id. The filter of DDS applies to this
        process and its children; '' for all processes of a machine.
    """

    name: str
    address: str
    network: str
    port: int
    key_file: str
    firewall: bool = False
    host_routes: bool = False
    process: str = ''


@dataclasses.dataclass(frozen=True)
class OtherVpn:
    """
    A VPN of another robot, by which this computer reaches one machine of that robot.

    :param machine: the machine, by its name there; ``interface`` is its end.
    :param own: this computer's end.
    :param heartbeats: UDP port of the machine's address for the heartbeats of this computer.
    """

    machine: Peer
    interface: VpnInterface
    own: VpnInterface
    heartbeats: int


@dataclasses.dataclass(frozen=True)
class DdsInterface:
    """A network interface for DDS, by name or address; a larger ``priority`` is preferred."""

    name: str
    priority: int = 0
    required: bool = True


def host_port(host: str, port: int) -> str:
    """Return ``host:port``, with an IPv6 address in brackets."""
    return f'[{host}]:{port}' if ':' in host else f'{host}:{port}'


#: A piece of text, or {'share': package} or {'prefix': package}, resolved on the machine.
TextPart = Union[str, Mapping[str, str]]
Text = Union[str, tuple[TextPart, ...]]


@dataclasses.dataclass(frozen=True)
class NodeSpec:
    """
    A process for a machine, sent in place of a launch action.

    The robot resolves all strings; what only the machine knows stays a marker.

    :param id: unique in the launch, chosen by the robot; events contain it.
    :param name: launch's name of the process (``talker-1``); prefix of its output.
    :param package: with ``executable`` names a program of the ament index; '' when ``arguments``
        contains the whole command line.
    :param arguments: words after the executable, including ``--ros-args`` and its arguments.
    :param files: contents of files to send; ``{'file': key}`` in a Text stands for the path.
    :param environment: variables in addition to the machine's own.
    :param folders: by variable, such as PATH, folders to put before those of the machine.
    :param passes_signals: SIGINT is for the process alone, and not for its children.
    :param respawn_delay: seconds.
    :param features: the values of features' keywords of nodes, by feature; JSON types only.
    """

    id: str
    name: str
    package: str = ''
    executable: str = ''
    arguments: tuple[Text, ...] = ()
    prefix: tuple[Text, ...] = ()
    files: Mapping[str, Text] = dataclasses.field(default_factory=dict)
    environment: Mapping[str, Text] = dataclasses.field(default_factory=dict)
    folders: Mapping[str, Text] = dataclasses.field(default_factory=dict)
    cwd: Optional[Text] = None
    shell: bool = False
    passes_signals: bool = False
    emulate_tty: bool = False
    respawn: bool = False
    respawn_delay: float = 0.0
    respawn_max_retries: int = -1
    sigterm_timeout: float = 5.0
    sigkill_timeout: float = 5.0
    features: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)


def to_json(data: Any) -> str:
    """Convert a dataclass of this module, or a plain JSON value, to compact JSON."""
    return json.dumps(data, default=_plain, separators=(',', ':'), sort_keys=True)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, Decimal):
        return str(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f'{type(value).__name__} has no JSON form')

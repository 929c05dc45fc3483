# SPDX-License-Identifier: Apache-2.0
"""The data that the parts of FogROS2 exchange: frozen dataclasses, no behaviour beyond JSON."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
from decimal import Decimal
import enum
import json
import threading
from typing import Any, Literal, Optional, Union

OnExit = Literal['delete', 'stop', 'keep']
Bootstrap = Literal['auto', 'apt', 'embedded', 'none']
RobotNodes = Literal['after_cloud', 'immediately']
OnInterrupt = Literal['shutdown', 'robot']

#: Seconds a machine lives at the most unless its launch file says otherwise.
DEFAULT_LIFETIME = 8 * 3600.0
#: Seconds without a heartbeat after which the launch counts as gone.
DEFAULT_ROBOT_TIMEOUT = 120.0


class MachineState(str, enum.Enum):
    """Where a machine is in its life, in one vocabulary for all providers."""

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
    What a launch file asks for: a description, not a machine.

    :param name: unique per robot; a DNS label (letters, digits, ``-``, at most 40 characters).
    :param provider: name of an entry point in the group ``fogros2.provider``.
    :param options: the provider's own settings; JSON types only.
    :param workspace: absolute path of the colcon workspace that travels, or None for none.
    :param underlays: workspaces below it, which travel too, the nearest first.
    :param on_exit: what becomes of the machine when the launch ends.
    :param lifetime: seconds after which the machine ends by itself, whatever happens.
    :param robot_timeout: seconds without the launch's heartbeat after which the nodes stop.
    :param environment: variables set for every node on the machine.
    :param containers: ``docker run`` command lines started before the nodes.
    :param on_interrupt: when the provider takes the machine away while its nodes run: end the
        launch, or run the nodes on the robot.
    :param monitor_allow: networks (CIDR) that reach its bridge to Foxglove besides the robot.
    :param apt: Debian packages that it has to have, ``pip`` Python packages as pip takes them.
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
    containers: tuple[str, ...] = ()
    launch_foxglove: bool = False
    vpn: str = 'wireguard'
    on_interrupt: OnInterrupt = 'shutdown'
    monitor_allow: tuple[str, ...] = ()
    apt: tuple[str, ...] = ()
    pip: tuple[str, ...] = ()

    @property
    def workspaces(self) -> tuple[str, ...]:
        """All workspaces that travel, the one whose packages win first."""
        return (self.workspace, *self.underlays) if self.workspace else ()

    @property
    def monitored(self) -> bool:
        """Whether a bridge to Foxglove starts with the first node, without another action."""
        return self.launch_foxglove or bool(self.monitor_allow)


@dataclasses.dataclass(frozen=True)
class Endpoint:
    """
    How a Shell reaches a machine.

    :param kind: name of an entry point in the group ``fogros2.shell``: ssh, local, ...
    :param host: address or name; for kinds without one, the machine's id.
    :param user: login user; nodes run as this user.
    :param host_key: the host's public key in OpenSSH form (``ssh-ed25519 AAAA...``), pinned
        before the first connection; None leaves the decision to ``known_hosts``.
    :param key_file: private key to log in with; None for the user's own keys and agent.
    """

    kind: str
    host: str = ''
    port: int = 22
    user: str = ''
    host_key: Optional[str] = None
    key_file: Optional[str] = None


@dataclasses.dataclass(frozen=True)
class Machine:
    """
    What a provider knows of a machine that exists.

    :param id: opaque to the core; carries its place (region, context, engine).
    :param created: seconds since the epoch, or None where the provider does not know.
    :param stopped: when it was stopped, likewise, for one that is.
    :param shell: None until the machine can be reached.
    :param vpn_host: address at which the robot reaches the machine's VPN port (UDP); '' where it
        can't, so that the machine has to dial the robot.
    :param robot_host: where ``vpn_host`` is '': the robot's address as this machine can dial it
        (UDP, the robot's VPN port), from an option or from the provider.
    :param vpn_port: UDP port that leads to the machine's VPN port from outside; 0: the same.
    :param inner_network: names the network in which ``inner_host`` means something (a cluster, a
        VPC); two machines of one inner network dial each other there.
    :param inner_host: the machine's address in it, '' without one.
    :param place: region, context and namespace, engine: for people to read.
    :param kind: what it is, such as an instance type: for people to read.
    :param image: the image that it started from, '' where there is none or none is known.
    :param key: the provider's name of its login key, likewise.
    :param disk_gb: size of its disk, None where unknown.
    :param owned: False for a computer that existed before and outlives the launch.
    :param end_command: what the agent runs as root on the machine to end it; empty where it
        must not be ended.
    :param cost_per_hour: US dollars, None where unknown.
    :param note: what the provider chose for it, and why: for people to read when it comes up.
    """

    id: str
    name: str
    provider: str
    state: MachineState
    created: Optional[float] = None
    shell: Optional[Endpoint] = None
    vpn_host: str = ''
    vpn_port: int = 0
    robot_host: str = ''
    inner_network: str = ''
    inner_host: str = ''
    place: str = ''
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


@dataclasses.dataclass(frozen=True)
class Image:
    """
    A disk image made of a machine, from which the next ones start.

    :param id: opaque to the core; carries its place.
    :param dependencies: hash of what is installed in it; a launch takes one that matches its own.
    """

    id: str
    name: str
    provider: str
    place: str = ''
    created: Optional[float] = None
    size_gb: Optional[int] = None
    state: str = ''
    dependencies: str = ''
    tags: Mapping[str, str] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class CreateRequest:
    """
    What the core tells a provider beside the spec.

    :param token: a uuid per attempt, stored before the call; the same token never creates twice.
    :param authorized_key: public key (OpenSSH form) that the login user accepts.
    :param tags: go onto everything that the provider creates.
    :param vpn_port: UDP port to let in.
    :param agent_config: the agent's first configuration, for providers that can start it at boot
        (``agent_directory``); the provider adds ``user`` and the ``end_command`` it tells later.
    :param dependencies: hash of what will have to be installed on it, by which an image that was
        baked before is found; '' where nothing is known of it.
    :param application: container image of a web application that serves HTTP on port 8080, for
        providers that run one beside the machine (``Provider.application_port``); '' for none.
    :param cancel: set when the launch is ending; for a ``create`` that takes long, as for an image
        to be downloaded: what it then raises is Cancelled.
    """

    token: str
    authorized_key: str
    tags: Mapping[str, str]
    vpn_port: int
    agent_config: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    dependencies: str = ''
    application: str = ''
    cancel: Optional[threading.Event] = dataclasses.field(default=None, compare=False)


@dataclasses.dataclass(frozen=True)
class Command:
    """
    A command line, on the robot or on a machine.

    :param argv: the words; no shell reads them. Never holds a secret: see ``input``.
    :param sudo: run as root (``sudo -n`` where the user isn't root).
    :param input: bytes for the standard input; secrets travel here.
    :param what: a few words for progress and errors, such as 'set the VPN up'.
    """

    argv: tuple[str, ...]
    sudo: bool = False
    input: bytes = b''
    environment: Mapping[str, str] = dataclasses.field(default_factory=dict)
    what: str = ''

    @classmethod
    def script(cls, text: str, *, sudo: bool = False, what: str = '') -> Command:
        """Return a command that runs ``text`` in ``sh``, stopping at the first error."""
        return cls(('sh', '-ec', text), sudo=sudo, what=what)


@dataclasses.dataclass(frozen=True)
class Result:
    """What a command left: exit status, its output as text, how long it took (s)."""

    returncode: int
    stdout: str
    stderr: str
    seconds: float = 0.0


@dataclasses.dataclass(frozen=True)
class SyncReport:
    """What a sync did: files and bytes sent over the wire, seconds."""

    files: int
    bytes: int
    seconds: float


@dataclasses.dataclass(frozen=True)
class Peer:
    """
    One host's place in the VPN of a launch, as another host sees it.

    :param address: the host's address inside the VPN.
    :param endpoint: ``host:port`` it can be dialled at, None behind NAT.
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
    :param port: UDP port listened on.
    :param key_file: where this host keeps its private key (0600); never leaves the host.
    :param guarded: let in DDS and ping alone and forward nothing (the robot's side).
    :param host_routes: lead to the peers' addresses alone: the host has a network of its own that
        overlaps the launch's.
    """

    name: str
    address: str
    network: str
    port: int
    key_file: str
    mtu: int = 1420
    guarded: bool = False
    host_routes: bool = False


@dataclasses.dataclass(frozen=True)
class DdsInterface:
    """A network interface for DDS: name or address; larger ``priority`` is preferred."""

    name: str
    priority: int = 0
    required: bool = True
    multicast: bool = False


@dataclasses.dataclass(frozen=True)
class Stream:
    """
    A topic that crosses the VPN encoded.

    :param topic: full topic name that publisher and subscriber use.
    :param transport: name of an entry point in the group ``fogros2.image_transport``.
    :param source: machine name of the publisher's side, None for the robot.
    :param target: machine name of the subscriber's side, None for the robot.
    """

    topic: str
    transport: str
    source: Optional[str] = None
    target: Optional[str] = None
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)


#: A piece of text, or {'share': package} / {'prefix': package}: resolved on the machine.
TextPart = Union[str, Mapping[str, str]]
Text = Union[str, tuple[TextPart, ...]]


@dataclasses.dataclass(frozen=True)
class NodeSpec:
    """
    One process for the machine to run; what travels instead of a launch action.

    Strings are resolved on the robot; what only the machine knows stays a marker.

    :param id: unique in the launch, chosen by the robot; events carry it.
    :param name: what launch calls the process (``talker-1``); prefixes its output.
    :param package: with ``executable`` names a program of the ament index; '' when ``arguments``
        holds the whole command line.
    :param arguments: words after the executable, ``--ros-args`` and what follows included.
    :param files: contents of files that travel; ``{'file': key}`` in a Text names one's path.
    :param environment: variables on top of the machine's own.
    :param respawn_delay: seconds.
    :param image: container image that the process runs in, '' for the machine itself.
    :param image_options: of ``docker run``, for that.
    """

    id: str
    name: str
    package: str = ''
    executable: str = ''
    arguments: tuple[Text, ...] = ()
    prefix: tuple[str, ...] = ()
    files: Mapping[str, Text] = dataclasses.field(default_factory=dict)
    environment: Mapping[str, Text] = dataclasses.field(default_factory=dict)
    cwd: Optional[str] = None
    shell: bool = False
    emulate_tty: bool = False
    respawn: bool = False
    respawn_delay: float = 0.0
    respawn_max_retries: int = -1
    sigterm_timeout: float = 5.0
    sigkill_timeout: float = 5.0
    image: str = ''
    image_options: tuple[str, ...] = ()


def to_json(data: Any) -> str:
    """Return a dataclass of this module (or a plain JSON value) as compact JSON."""
    return json.dumps(data, default=_plain, separators=(',', ':'), sort_keys=True)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, Decimal):
        return str(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f'{type(value).__name__} has no JSON form')

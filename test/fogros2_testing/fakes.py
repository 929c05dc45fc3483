# SPDX-License-Identifier: Apache-2.0
"""Fake a provider, a VPN, a stream, a shell and a machine that is up."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
from decimal import Decimal
from pathlib import Path
import queue
import secrets
import threading
import time
from typing import Any, ClassVar, Optional

from fogros2.errors import (
    Cancelled,
    CommandError,
    ConfigurationError,
    ConnectError,
    FogError,
    MachineNotFound,
    NameTaken,
)
from fogros2.model import (
    Command,
    CreateRequest,
    Endpoint,
    Machine,
    MachineSpec,
    MachineState,
    Peer,
    Result,
    SyncReport,
    VpnInterface,
)
from fogros2.provider import Capabilities, Provider
from fogros2.shell import connect, Shell, Stream
from fogros2.vpn import Vpn

#: Endpoint of every fake machine, in TEST-NET-2, which is never assigned.
FAKE_ENDPOINT = Endpoint('fake', '198.51.100.1', user='fog')


class FakeProvider(Provider):
    """
    A provider whose machines are entries of a dictionary.

    :param polls: number of ``describe`` calls for which a new machine is pending.
    :param endpoint: of every running machine.
    :param failures: by method name, the error that the next call of the method raises.
    :param prices: US dollars per hour by size; 'cheapest' stands for the size with the lowest
        price.

    Attributes for tests: ``allowed``, allowed sources by machine and TCP port; ``address``, the
    robot's address; ``host_keys``, pinned key by machine.
    """

    name: ClassVar[str] = 'fake'
    capabilities: ClassVar[Capabilities] = Capabilities(
        shell_kind='fake', choices=True, stop=True)
    poll_interval: ClassVar[float] = 0.05

    def __init__(
        self, *, polls: int = 0, endpoint: Endpoint = FAKE_ENDPOINT,
        failures: Optional[dict[str, FogError]] = None,
        prices: Optional[Mapping[str, Decimal]] = None,
    ) -> None:
        self.calls: list[str] = []
        self.allowed: dict[tuple[str, int], list[str]] = {}
        self.address = '198.51.100.9/32'
        self.host_keys: dict[str, str] = {}
        self.prices = dict(prices or {})
        self.failures = failures if failures is not None else {}
        self._polls = polls
        self._endpoint = endpoint
        self._lock = threading.Lock()
        #: By id; a class may have them for all of its objects.
        self.machines: dict[str, Machine] = getattr(self, 'machines', {})
        self._tokens: dict[str, str] = {}
        self._waits: dict[str, int] = {}

    @classmethod
    def can(cls, **changes: Any) -> Capabilities:
        """Return the capabilities with changes, for a test that replaces them."""
        return dataclasses.replace(cls.capabilities, **changes)

    def check(self, spec: MachineSpec) -> None:
        """Refuse every option except 'size'."""
        self._called('check')
        for name in spec.options:
            if name != 'size':
                raise ConfigurationError(f"a fake machine has no option '{name}'",
                                         "did you mean 'size'?")

    def resolve(self, spec: MachineSpec) -> MachineSpec:
        """Resolve 'cheapest' to the size with the lowest price."""
        self._called('resolve')
        if spec.options.get('size') != 'cheapest':
            return spec
        size = min(self.prices, key=lambda size: self.prices[size], default='small')
        return dataclasses.replace(spec, options={**spec.options, 'size': size})

    def cost_per_hour(self, spec: MachineSpec) -> Optional[Decimal]:
        """Return the price of the machine's size."""
        return self.prices.get(str(spec.options.get('size')))

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Create a machine."""
        self.check(spec)
        with self._lock:
            self._called('create')
            if request.token in self._tokens:
                return self._tokens[request.token]
            if any(m.name == spec.name for m in self.machines.values()):
                raise NameTaken(f"there is a fake machine '{spec.name}' already")
            machine_id = f'fake-{secrets.token_hex(4)}'
            self.machines[machine_id] = Machine(
                machine_id, spec.name, self.name, MachineState.PENDING, created=time.time(),
                tags=dict(request.tags), end_command=('true',))
            self._tokens[request.token] = machine_id
            self._waits[machine_id] = self._polls
            return machine_id

    def describe(self, machine_id: str) -> Machine:
        """Return a machine; count down a pending one's polls until it runs."""
        with self._lock:
            self._called('describe')
            machine = self._found(machine_id)
            if machine.state is MachineState.PENDING:
                self._waits[machine_id] -= 1
                if self._waits[machine_id] < 0:
                    machine = dataclasses.replace(
                        machine, state=MachineState.RUNNING, endpoint=self._endpoint,
                        vpn_host=self._endpoint.host)
                    self.machines[machine_id] = machine
            key = self.host_keys.get(machine_id)
            if key is not None and machine.endpoint is not None:
                return dataclasses.replace(
                    machine, endpoint=dataclasses.replace(machine.endpoint, host_key=key))
            return machine

    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        """Return the machines that have all of ``tags``."""
        with self._lock:
            self._called('find')
            return [m for m in self.machines.values() if tags.items() <= m.tags.items()]

    def destroy(self, machine_id: str) -> None:
        """Delete a machine."""
        with self._lock:
            self._called('destroy')
            self.machines.pop(machine_id, None)
            self._tokens = {t: i for t, i in self._tokens.items() if i != machine_id}

    def stop(self, machine_id: str) -> None:
        """Stop a machine."""
        with self._lock:
            self._called('stop')
            self.machines[machine_id] = dataclasses.replace(
                self._found(machine_id), state=MachineState.STOPPED, endpoint=None)

    def start(self, machine_id: str) -> None:
        """Start a stopped machine."""
        with self._lock:
            self._called('start')
            self.machines[machine_id] = dataclasses.replace(
                self._found(machine_id), state=MachineState.PENDING)
            self._waits[machine_id] = self._polls

    def robot_address(self) -> str:
        """Return ``address``."""
        if not self.capabilities.firewall:
            return super().robot_address()
        self._called('robot_address')
        return self.address

    def allow(self, machine_id: str, port: int, sources: Sequence[str]) -> None:
        """Record the allowed sources."""
        if not self.capabilities.firewall:
            super().allow(machine_id, port, sources)
        self._called('allow')
        self.allowed[machine_id, port] = list(sources)

    def pin(self, machine_id: str, host_key: str) -> None:
        """Record the host key."""
        if not self.capabilities.one_time_host_key:
            super().pin(machine_id, host_key)
        self._called('pin')
        self.host_keys[machine_id] = host_key

    def _found(self, machine_id: str) -> Machine:
        if machine_id not in self.machines:
            raise MachineNotFound(f"there is no fake machine '{machine_id}'")
        return self.machines[machine_id]

    def _called(self, method: str) -> None:
        self.calls.append(method)
        if method in self.failures:
            raise self.failures.pop(method)


class MemoryProvider(FakeProvider):
    """One for tests of verbs: each verb has its own object, and all have the same machines."""

    name: ClassVar[str] = 'memory'
    capabilities: ClassVar[Capabilities] = Capabilities()
    machines: dict[str, Machine] = {}


class FakeVpn(Vpn):
    """A VPN whose commands do nothing; their arguments are the names of the peers."""

    def __init__(
        self, domain: int = 0, ports: Sequence[tuple[int, int]] = (), asked: Sequence[str] = (),
    ) -> None:
        """Ignore the parameters, which every VPN has."""

    def keys(self, interface: VpnInterface) -> Command:
        """Return a command that prints a public key."""
        return Command(('echo', f'key of {interface.name}'), what='keys')

    def up(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield one command."""
        return self._named('up', peers)

    def peers(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield one command."""
        return self._named('peers', peers)

    def repair(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield one command."""
        return self._named('repair', peers)

    def _named(self, what: str, peers: Sequence[Peer]) -> Iterator[Command]:
        yield Command(('true', *sorted(peer.name for peer in peers)), what=what)

    def health_check(self, interface: VpnInterface) -> Command:
        """Return a command that succeeds."""
        return Command(('true',), what='health check')

    def status(self, interface: VpnInterface) -> Command:
        """Return a command without output."""
        return Command(('true',), what='status')

    def parse_status(self, output: str) -> dict[str, dict[str, float]]:
        """Return nothing."""
        return {}

    def down(self, interface: VpnInterface) -> Iterator[Command]:
        """Yield one command."""
        return self._named('down', ())


class FakeStream:
    """
    The stream of a program that a test plays.

    ``sent`` is the input that the program received; ``say`` prints a line of output.
    """

    def __init__(self, *, echo: bool = False) -> None:
        self.sent = b''
        self._echo = echo
        self._lines: queue.Queue[bytes] = queue.Queue()
        self._closed = threading.Event()

    def say(self, line: bytes) -> None:
        """Let the program print a line (with its newline)."""
        self._lines.put(line)

    def write(self, data: bytes) -> None:
        """Send input to the program."""
        if self._closed.is_set():
            raise ConnectError('the stream is closed')
        self.sent += data
        if self._echo:
            for line in data.splitlines(keepends=True):
                self.say(line)

    def readline(self) -> bytes:
        """Return the next line of output, b'' at the end."""
        line = self._lines.get()
        if not line:
            self._lines.put(b'')  # for the next reader
        return line

    def close(self) -> None:
        """Close the stream."""
        self._closed.set()
        self._lines.put(b'')


Handler = Callable[[Command], Result]


class FakeShell:
    """
    A shell without a machine: it records commands, and keeps files in a dictionary.

    :param handlers: by program name, a function that returns the result of a command. Without
        handlers, ``true`` and ``echo`` work, and other programs are missing.
    :param streams: streams that ``open`` returns, in this order; later ones echo their input.
    """

    name = 'fake'

    def __init__(
        self, *, handlers: Optional[Mapping[str, Handler]] = None,
        streams: Iterable[FakeStream] = (),
    ) -> None:
        self.commands: list[Command] = []
        self.opened: list[Command] = []
        self.files: dict[str, tuple[bytes, int]] = {}
        self.closed = 0
        self._handlers = {
            'true': lambda c: Result(0, '', ''),
            'echo': lambda c: Result(0, f"{' '.join(c.argv[1:])}\n", ''), **(handlers or {})}
        self._streams = list(streams)

    def run(
        self, command: Command, *, timeout: float, check: bool = True,
        cancel: Optional[threading.Event] = None,
        on_output: Optional[Callable[[str], None]] = None,
    ) -> Result:
        """Answer a command by a handler; unknown programs fail as in a real shell."""
        self.commands.append(command)
        if cancel is not None and cancel.is_set():
            raise Cancelled(command.what or command.argv[0])
        handler = self._handlers.get(command.argv[0])
        result = handler(command) if handler is not None else Result(
            127, '', f'{command.argv[0]}: command not found\n')
        if check and result.returncode != 0:
            raise CommandError(command, result, f"'{self.name}'")
        return result

    def put(self, data: bytes, target: str, *, mode: int, timeout: float = 60.0) -> None:
        """Store a file."""
        self.files[target] = (data, mode)

    def sync(
        self, source: Path, target: str, *, excludes: Sequence[str], timeout: float,
        includes: Sequence[str] = (), cancel: Optional[threading.Event] = None,
        on_progress: Optional[Callable[[int, int], None]] = None,
    ) -> SyncReport:
        """Send nothing."""
        return SyncReport(0, 0, 0.0)

    def fetch(
        self, source: str, target: Path, *, known: Optional[Path], limit: int, timeout: float,
        cancel: Optional[threading.Event] = None,
    ) -> None:
        """Fetch nothing."""

    def open(self, command: Command) -> Stream:
        """Return the next stream of ``streams``, or one that echoes."""
        self.opened.append(command)
        return self._streams.pop(0) if self._streams else FakeStream(echo=True)

    def interactive(self, command: Optional[Command] = None) -> int:
        """Do nothing, and return 0."""
        return 0

    def close(self) -> None:
        """Count the calls in ``closed``."""
        self.closed += 1


class FakeRunning:
    """
    A machine that is up, as features see it: this computer, or what a shell reaches.

    :ivar details: what its steps reported.
    :ivar calls: other calls, each with the method's name and its arguments.
    :ivar watches: by name, what is called with the output of a watch.
    """

    directory = '/var/lib/agent'
    interface = VpnInterface('foga', '198.18.7.2', '198.18.7.0/24', 51820, '/key')
    vpn_address = interface.address
    lost = ''
    environment: Mapping[str, str] = {
        'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp', 'ROS_DOMAIN_ID': '7'}
    dds_file = f'{directory}/dds.xml'
    rmw = 'rmw_fastrtps_cpp'

    def __init__(
        self, shell: Any = None, *, spec: Optional[MachineSpec] = None, launch: str = '0a0b0c',
    ) -> None:
        self.launch = launch
        self.provider: Provider = FakeProvider()
        self.spec = spec or MachineSpec('a', 'fake')
        self.machine = Machine('fake-1', self.spec.name, 'fake', MachineState.RUNNING)
        self.shell: Shell = shell or connect(Endpoint('local'), name=self.spec.name)
        self.details: list[str] = []
        self.calls: list[tuple[Any, ...]] = []
        self.watches: dict[str, Callable[[str], None]] = {}

    def run(self, command: Command, *, timeout: float) -> str:
        """Run a command by the shell."""
        return self.shell.run(command, timeout=timeout).stdout

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[list[str]]:
        """Collect the details of all steps."""
        yield self.details

    def warn(self, text: str, remedy: str) -> None:
        """Collect the call."""
        self.calls.append(('warn', text, remedy))

    def note(self, name: str, text: str) -> None:
        """Collect the call."""
        self.calls.append(('note', name, text))

    def makes(self, name: str) -> None:
        """Collect the call."""
        self.calls.append(('makes', name))

    def open_port(self, port: int, sources: Sequence[str]) -> tuple[str, int]:
        """Collect the call; return the same port of a fake machine."""
        self.calls.append(('open_port', port, sources))
        return FAKE_ENDPOINT.host, port

    def watch(
        self, name: str, argv: Sequence[str], interval: float, then: Callable[[str], None],
    ) -> None:
        """Collect the call."""
        self.calls.append(('watch', name, argv, interval))
        self.watches[name] = then

    def give_up(self, reason: str) -> None:
        """Collect the call."""
        self.calls.append(('give_up', reason))

    def lose_after(self, seconds: float) -> None:
        """Collect the call."""
        self.calls.append(('lose_after', seconds))

    def bear_silence(self, seconds: float) -> None:
        """Collect the call."""
        self.calls.append(('bear_silence', seconds))

#!/usr/bin/python3 -IS
# SPDX-License-Identifier: Apache-2.0
"""
Makes, changes and takes away the VPN interfaces of launches, as root, for users who aren't.

    sudo -n /usr/libexec/fogros2/vpn check|keys|up|peers|repair|status|down <request.json
    /usr/libexec/fogros2/vpn tidy

sudo lets the members of a group run this program alone, so it trusts nothing that comes from the
caller: one word of a list, and on the standard input one JSON object of known fields. There is no
path and no free text in it. An interface belongs to the user who made it; one that was not made
here is never touched. The private key is made here and stays here.

What is done is what ``fogros2.vpn.wireguard`` writes down, from a copy beside this file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
import contextlib
import dataclasses
import fcntl
import ipaddress
import json
import os
from pathlib import Path
import re
import resource
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from typing import Any, NoReturn, Optional, Union

sys.dont_write_bytecode = True
# -I leaves out the program's own folder, too; it is root's, as the program is
sys.path.insert(0, str(Path(__file__).resolve().parent))

from fogros2.errors import FogError  # noqa: E402
from fogros2.model import Command, Peer, VpnInterface  # noqa: E402
from fogros2.vpn import addresses  # noqa: E402
from fogros2.vpn.wireguard import WireGuard  # noqa: E402

#: What both sides mean by the words and fields below. Other fields need another number.
PROTOCOL = 5
#: One folder for each interface: its key, and whose it is. Gone at boot, as interfaces are. Not
#: where agents are: a robot may be a machine, too.
RECORDS = Path('/run/fogros2-vpn')
#: Networks that the administrator allows in place of the usual one: CIDR form, one a line.
POOLS = Path('/etc/fogros2/pools')
#: Interfaces that one user may have at a time.
LIMIT = 16
#: Machines that an interface leads to: what a /24 holds beside the robot.
PEERS = 253
#: Computers that nodes ask beside their network.
ASKED = 64
#: Bytes of a request: all peers, with the longest endpoints.
LONGEST = 256 * 1024
#: Seconds that the caller has to say what it wants, and that a script has.
PATIENCE = 5
TIME = 25.0
#: Seconds to wait for another request, whose scripts may take ``TIME``.
QUEUE = 60.0
#: Below are the ports of services of the computer's own, which no user may take or open.
FIRST_PORT = 1024

_NAME = re.compile('fog[0-9a-f]{6}')
_KEY = re.compile('[A-Za-z0-9+/]{42}[AEIMQUYcgkosw048]=')
_PRIVATE = re.compile('[A-Za-z0-9+/]{43}=')
_HOST = re.compile(
    r'[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?|'
    r'\[[0-9a-fA-F:.]{2,45}(%[A-Za-z0-9_.-]{1,15})?\]')


class Refused(Exception):
    """The request is not one of ours, or not this user's to make."""


# -- what a request may say ----------------------------------------------------------------------

def name_of(value: object) -> str:
    """Return the name of an interface."""
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise Refused('an interface is called fog and six hexadecimal digits')
    return value


def number(value: object, first: int, last: int, what: str) -> int:
    """Return a whole number of a range."""
    if type(value) is not int or not first <= value <= last:
        raise Refused(f'{what} is a number from {first} to {last}')
    return value


def network_of(value: object, pools: Iterable[str]) -> str:
    """Return a /24 of one of the pools, in CIDR form."""
    try:
        if not isinstance(value, str):
            raise ValueError
        network = ipaddress.IPv4Network(value)
    except ValueError:
        raise Refused('a network is like 198.18.7.0/24') from None
    if network.prefixlen != addresses.NETWORK_PREFIX:
        raise Refused(f'a network has {addresses.NETWORK_PREFIX} bits')
    if addresses.uses_lan_groups(str(network)):
        raise Refused(f"the multicast groups of {network} would be the LAN's")
    allowed = list(pools)
    if not any(network.subnet_of(ipaddress.IPv4Network(pool)) for pool in allowed):
        raise Refused(f'{network} is not in {", ".join(allowed) or "any pool"}: the administrator '
                      f'may allow others, in {POOLS}')
    return str(network)


def ports_of(value: object) -> tuple[tuple[int, int], ...]:
    """Return ranges of UDP ports, first and last."""
    if not isinstance(value, list) or len(value) > 4:
        raise Refused('ports are a list of up to four pairs')
    found = []
    for pair in value:
        if not isinstance(pair, list) or len(pair) != 2:
            raise Refused('ports are pairs, first and last')
        first = number(pair[0], FIRST_PORT, 65535, 'a port')
        found.append((first, number(pair[1], first, 65535, 'the last port')))
    return tuple(found)


def asked_of(value: object) -> tuple[str, ...]:
    """Return the addresses of computers that nodes may send to, as IPv4 writes them."""
    if not isinstance(value, list) or len(value) > ASKED:
        raise Refused(f'asked is a list of up to {ASKED} addresses')
    for entry in value:
        try:
            if not isinstance(entry, str) or str(ipaddress.IPv4Address(entry)) != entry:
                raise ValueError
        except ValueError:
            raise Refused('asked has addresses like 192.0.2.7') from None
    return tuple(value)


def peers_of(value: object, network: str, own: str) -> list[Peer]:
    """Return the machines that an interface leads to, each at an address of its network."""
    if not isinstance(value, list) or len(value) > PEERS:
        raise Refused(f'peers are a list of up to {PEERS}')
    inside = {str(address) for address in ipaddress.IPv4Network(network).hosts()}
    inside.discard(own)
    found = []
    for entry in value:
        if not isinstance(entry, dict) or set(entry) != {'key', 'address', 'endpoint'}:
            raise Refused('a peer has key, address and endpoint')
        key, address = entry['key'], entry['address']
        if not isinstance(key, str) or not _KEY.fullmatch(key):
            raise Refused("a peer's key is a public key of WireGuard's")
        if not isinstance(address, str) or address not in inside:
            raise Refused(f"a peer's address is one of {network}, and its own")
        inside.remove(address)
        found.append(Peer('machine', key, address, _endpoint(entry['endpoint'])))
    if len({peer.public_key for peer in found}) != len(found):
        raise Refused('two peers have one key')
    return found


def _endpoint(value: object) -> Optional[str]:
    if value is None:
        return None
    host, _, port = value.rpartition(':') if isinstance(value, str) else ('', '', '')
    if not _HOST.fullmatch(host) or not re.fullmatch('[1-9][0-9]{0,4}', port):
        raise Refused('an endpoint is host:port, or null')
    number(int(port), 1, 65535, "an endpoint's port")
    return f'{host}:{port}'


def own_address(value: object, network: str) -> str:
    """Return this computer's address: one of the network."""
    if not isinstance(value, str) or value not in map(str, ipaddress.IPv4Network(network).hosts()):
        raise Refused(f'the address is one of {network}')
    return value


#: Fields of a request, by its verb.
FIELDS = {
    'check': set[str](), 'keys': {'name', 'pid', 'private'},
    'up': {'name', 'network', 'address', 'port', 'ports', 'asked', 'peers'},
    'peers': {'name', 'peers'}, 'repair': {'name', 'peers'}, 'status': {'name'}, 'down': {'name'}}


def parse(verb: str, data: bytes) -> dict[str, Any]:
    """
    Return a request's fields, all of which are there and none beside.

    :raises Refused: that isn't so.
    """
    try:
        request = json.loads(data.decode() or '{}')
    except (ValueError, RecursionError):
        raise Refused('the request is no JSON') from None
    if not isinstance(request, dict) or set(request) != FIELDS[verb]:
        raise Refused(f'the request has not the fields of {verb}: '
                      f'{", ".join(sorted(FIELDS[verb])) or "none"}')
    if 'name' in request:
        name_of(request['name'])
    return request


# -- whose interface it is -----------------------------------------------------------------------

@dataclasses.dataclass(frozen=True)
class Record:
    """
    An interface that was made here.

    :param uid: whose it is.
    :param pid: the launch; it is gone once no process of that id has begun at ``started``. 0 for
        a guest's, which stays until ``down``.
    :param network: '' until it has been brought up; ``address`` is this computer's in it.
    """

    name: str
    uid: int
    pid: int
    started: int
    network: str = ''
    address: str = '127.0.0.1'
    port: int = 0
    ports: tuple[tuple[int, int], ...] = ()
    asked: tuple[str, ...] = ()

    def interface(self) -> VpnInterface:
        """Return what the VPN makes of it."""
        network = self.network or '127.0.0.0/24'
        return VpnInterface(self.name, self.address, network, self.port,
                            str(RECORDS / self.name / 'key'), firewall=True,
                            process=str(self.pid or ''))

    def vpn(self) -> WireGuard:
        """Return what knows the commands."""
        return WireGuard(ports=self.ports, asked=self.asked)

    def alive(self) -> bool:
        """Return whether the launch goes on: another process may have its id by now."""
        with contextlib.suppress(Refused):
            return not self.pid or begun(self.pid, self.uid) == self.started
        return False

    def save(self, folder: Path) -> None:
        """Write it into its folder, whole or not at all."""
        aside = folder / 'record.new'
        aside.write_text(json.dumps(dataclasses.asdict(self)))
        aside.replace(folder / 'record')


def load(folder: Path) -> Record:
    """Return what was written of an interface, by this or another version."""
    written = json.loads((folder / 'record').read_text())
    fields = {field.name: written[field.name] for field in dataclasses.fields(Record)
              if field.name in written}
    fields['ports'] = tuple((first, last) for first, last in fields.get('ports', ()))
    fields['asked'] = tuple(fields.get('asked', ()))
    return Record(**fields)


def records() -> list[Record]:
    """Return all interfaces that were made here."""
    found = []
    for path in sorted(RECORDS.iterdir()):
        if _NAME.fullmatch(path.name):
            with contextlib.suppress(FileNotFoundError):  # one that is being taken away
                found.append(load(path))
    return found


def prepare() -> None:
    """
    Make the folder of the records, root's alone to change.

    Users may look up a name in it (``helped.key_of``), but not open it: who can open a folder can
    lock it.
    """
    with contextlib.suppress(FileExistsError):
        RECORDS.mkdir(mode=0o711)
    status = RECORDS.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != 0 or status.st_mode & 0o022:
        raise Refused(f"{RECORDS} isn't root's alone")
    RECORDS.chmod(0o711)  # whatever the umask


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """
    Hold a folder for oneself.

    :raises FileNotFoundError: it is gone, or went meanwhile.
    :raises Refused: another process has held it for ``QUEUE`` seconds.
    """
    held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    deadline = time.monotonic() + QUEUE
    try:
        while True:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise Refused(f'another process has held {folder} for {QUEUE:g} s') from None
                time.sleep(0.02)
        if not os.path.samestat(os.fstat(held), os.lstat(folder)):
            raise FileNotFoundError(folder)
        yield
    finally:
        os.close(held)


@contextlib.contextmanager
def own(name: str, uid: int) -> Iterator[Record]:
    """Yield a user's own interface, held; root may have anybody's."""
    try:
        with locked(RECORDS / name):
            record = load(RECORDS / name)
            if uid not in (0, record.uid):
                raise Refused(f'{name} belongs to another user')
            yield record
    except FileNotFoundError:
        raise Refused(f'{name} was not made here') from None


def claim(name: str, uid: int, pid: int) -> None:
    """Make a name a user's own, unless it is already."""
    started = begun(pid, uid) if pid else 0
    with locked(RECORDS):
        for record in records():
            if record.name == name:
                if record.uid != uid:
                    raise Refused(f'{name} belongs to another user')
                return
        if Path('/sys/class/net', name).exists():
            raise Refused(f'{name} was not made here')
        if sum(record.uid == uid for record in records()) >= LIMIT:
            raise Refused(f'{LIMIT} interfaces are as many as one user may have')
        aside = Path(tempfile.mkdtemp(prefix='.new-', dir=RECORDS))  # 0700
        try:
            Record(name, uid, pid, started).save(aside)
            aside.rename(RECORDS / name)
        except BaseException:
            shutil.rmtree(aside)
            raise


def begun(pid: int, uid: Optional[int] = None) -> int:
    """
    Return when a process began, in the kernel's ticks since boot.

    :raises Refused: there is none, or it is another user's.
    """
    try:
        # a process may give itself a name of any bytes
        status, stat = (Path('/proc', str(pid), name).read_text(errors='replace')
                        for name in ('status', 'stat'))
        real = re.search(r'^Uid:\s*(\d+)', status, re.MULTILINE)
        if uid is not None and (real is None or int(real[1]) != uid):
            raise Refused('pid is a process of another user')
        return int(stat.rpartition(')')[2].split()[19])
    except OSError:
        raise Refused('pid is no process') from None


def pools() -> list[str]:
    """Return the networks that subnets may be taken from."""
    try:
        status = POOLS.stat()
        lines = POOLS.read_text().split('\n')
    except FileNotFoundError:
        return [addresses.POOL]
    if status.st_uid != 0 or status.st_mode & 0o022:
        raise Refused(f"{POOLS} isn't root's alone")
    found = [line.strip() for line in lines if line.strip() and not line.startswith('#')]
    try:
        return [str(ipaddress.IPv4Network(line)) for line in found]
    except ValueError as error:
        raise Refused(f'{POOLS}: {error}') from None


def taken(but: str) -> list[str]:
    """Return the networks and addresses in use on this computer, but for one interface's."""
    text = ''
    for words in (('addr', 'show'), ('route', 'show', 'table', 'all')):
        said = subprocess.run(('ip', '-json', '-4', *words), check=True, capture_output=True,
                              text=True, env=ENVIRONMENT, stdin=subprocess.DEVNULL).stdout
        text += json.dumps([entry for entry in json.loads(said or '[]')
                            if but not in (entry.get('ifname'), entry.get('dev'))]) + '\n'
    return addresses.parse_used(text)


# -- what is done --------------------------------------------------------------------------------

#: All that scripts see of the caller's environment is nothing.
ENVIRONMENT = {'PATH': '/usr/sbin:/usr/bin:/sbin:/bin', 'LC_ALL': 'C'}


def run(commands: Union[Command, Iterable[Command]]) -> None:
    """Run scripts one after the other; what they print is the caller's to read."""
    for command in [commands] if isinstance(commands, Command) else commands:
        child = subprocess.Popen(command.argv, env=ENVIRONMENT, stdin=subprocess.DEVNULL,
                                 cwd='/', start_new_session=True)
        try:
            status = child.wait(TIME)
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
            raise Refused(f'{command.what} took longer than {TIME:g} s') from None
        if status != 0:
            sys.exit(status if status > 0 else 1)


def check(request: Mapping[str, Any], uid: int) -> None:
    """Say that this user may."""
    print(PROTOCOL)


def keys(request: Mapping[str, Any], uid: int) -> None:
    """Make an interface's name this user's, and its key; print the public half."""
    name = name_of(request['name'])
    private = request['private']
    if not isinstance(private, str) or private and not re.fullmatch(_PRIVATE, private):
        raise Refused("private is a private key of WireGuard's, or ''")
    claim(name, uid, number(request['pid'], 0, 2 ** 22, 'a process id'))
    with own(name, uid) as record:
        if private and not record.network:
            key = RECORDS / name / 'key'
            key.touch(0o600)
            key.write_text(f'{private}\n')
        run(record.vpn().keys(record.interface()))


def up(request: Mapping[str, Any], uid: int) -> None:
    """Bring an interface up, in a network that nobody has."""
    network = network_of(request['network'], pools())
    port = number(request['port'], FIRST_PORT, 65535, 'the port')
    ports, asked = ports_of(request['ports']), asked_of(request['asked'])
    address = own_address(request['address'], network)
    peers = peers_of(request['peers'], network, address)
    with own(request['name'], uid) as before:
        record = dataclasses.replace(
            before, network=network, address=address, port=port, ports=ports, asked=asked)
        if before.network and (before.network, before.address) != (network, address):
            raise Refused(f'{record.name} has another address already')
        with locked(RECORDS):
            others = [other.network for other in records()
                      if other.name != record.name and other.network]
            if found := addresses.overlapping(network, [*others, *taken(record.name)]):
                raise Refused(f'{network} is in use already: {found[0]}')
            _refuse_ended(before)  # it may have ended while this waited
            record.save(RECORDS / record.name)
        run(record.vpn().up(record.interface(), peers))


def _refuse_ended(record: Record) -> None:
    if not record.alive():
        raise Refused(f'the launch of {record.name}, process {record.pid}, has ended')


def _with_peers(
    what: Callable[[Record, list[Peer]], Iterable[Command]],
) -> Callable[[Mapping[str, Any], int], None]:
    def act(request: Mapping[str, Any], uid: int) -> None:
        with own(request['name'], uid) as record:
            _refuse_ended(record)
            if not record.network:
                raise Refused(f'{record.name} has not been brought up')
            run(what(record, peers_of(request['peers'], record.network, record.address)))
    return act


def status(request: Mapping[str, Any], uid: int) -> None:
    """Print an interface's counters."""
    with own(request['name'], uid) as record:
        run(record.vpn().status(record.interface()))


def down(request: Mapping[str, Any], uid: int) -> None:
    """Take an interface away, with all that was made for it; one that is gone is no error."""
    name = name_of(request['name'])
    try:
        with own(name, uid) as record:
            run(record.vpn().down(record.interface()))
            shutil.rmtree(RECORDS / name)
    except Refused:
        # another process may have taken it away while this one waited
        if (RECORDS / name).exists() or Path('/sys/class/net', name).exists():
            raise


def tidy() -> None:
    """Take away the interfaces of launches that are gone, each though another stays."""
    failed = False
    for record in records():
        if not record.alive():
            print(f'{record.name}: its launch, process {record.pid}, is gone', flush=True)
            try:
                down({'name': record.name}, 0)
            except (Refused, SystemExit) as error:
                print(f'{record.name} stays: {error}', file=sys.stderr)
                failed = True
    if failed:
        sys.exit(1)


VERBS: dict[str, Callable[[Mapping[str, Any], int], None]] = {
    'check': check, 'keys': keys, 'up': up, 'status': status, 'down': down,
    'peers': _with_peers(lambda record, peers: record.vpn().peers(record.interface(), peers)),
    'repair': _with_peers(lambda record, peers: record.vpn().repair(record.interface(), peers))}


def settle() -> None:
    """Leave nothing of the caller's in this process that scripts would inherit."""
    os.umask(0o022)
    os.chdir('/')
    for each in (signal.SIGCHLD, signal.SIGPIPE, signal.SIGALRM):
        signal.signal(each, signal.SIG_DFL)
    for each in (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU):
        signal.signal(each, signal.SIG_IGN)  # a stopped request would keep its lock
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    for limit in (resource.RLIMIT_FSIZE, resource.RLIMIT_CPU, resource.RLIMIT_AS):
        try:
            resource.setrlimit(limit, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        except (OSError, ValueError):  # in a container root may not raise them
            _, hard = resource.getrlimit(limit)
            resource.setrlimit(limit, (hard, hard))


def refuse(why: object) -> NoReturn:
    """End with a line for the caller."""
    print(f'fogros2 vpn: {why}', file=sys.stderr)
    sys.exit(2)


def main() -> None:
    """Do what one word asks for."""
    if os.geteuid() != 0:
        refuse('run by sudo, or by root')
    settle()
    try:
        words = sys.argv[1:]
        uid = int(os.environ.get('SUDO_UID', '0'))  # sudo's own word, whatever the caller set
        os.environ.clear()
        if len(words) != 1 or words[0] not in {*VERBS, 'tidy'}:
            raise Refused(f'one of {", ".join(VERBS)}')
        if words == ['tidy']:
            if uid != 0:
                raise Refused("tidy is root's")
            if RECORDS.exists():
                prepare()
                tidy()
            return
        signal.alarm(PATIENCE)
        data = sys.stdin.buffer.read(LONGEST + 1)
        signal.alarm(0)
        if len(data) > LONGEST:
            raise Refused('the request is too long')
        request = parse(words[0], data)
        prepare()
        VERBS[words[0]](request, uid)
    except (Refused, FogError, OSError, ValueError, subprocess.CalledProcessError) as error:
        refuse(error)


if __name__ == '__main__':
    main()

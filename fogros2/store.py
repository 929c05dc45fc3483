# SPDX-License-Identifier: Apache-2.0
"""
Keep local state: one folder per machine and per launch, below the XDG state home.

It is only a cache: the provider's tags show which machines exist. Folders have mode 0700, files
mode 0600; files are replaced atomically.
"""

from __future__ import annotations

import atexit
from collections.abc import Iterator, Mapping
import contextlib
import dataclasses
import fcntl
import functools
import json
import os
from pathlib import Path
import re
import secrets
import shutil
import tempfile
import threading
import time
from typing import Any, Optional, TYPE_CHECKING, TypeVar

from fogros2 import model, process
from fogros2.agent.loop import boot_clock
from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    did_you_mean,
    FogError,
    NameTaken,
    StoreError,
)
from fogros2.model import Command, Endpoint, MachineSpec, OtherVpn, Peer, VpnInterface

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    T = TypeVar('T', bound=DataclassInstance)

#: Name of a file or folder that only one process uses, with that process.
_UNFINISHED = re.compile(r'\..+\.([0-9]+)\.[a-z0-9_]{8}')
#: File in the folder of another robot's VPN, which is like a launch's folder; see ``OtherVpn``.
OTHER_VPN = 'other_vpn.json'
_ELSEWHERE = 'FOGROS2_STATE_HOME names another folder for it'
_NAME = re.compile(r'[a-z0-9]([a-z0-9-]{0,38}[a-z0-9])?')
#: Seconds for the deletion of a folder that Python can't delete.
_DELETION = 600.0


def state_home() -> Path:
    """
    Return FogROS2's state folder; ``FOGROS2_STATE_HOME`` overrides the XDG default.

    :raises StoreError: it belongs to another account.
    """
    own = os.environ.get('FOGROS2_STATE_HOME')
    base = os.environ.get('XDG_STATE_HOME') or os.path.expanduser('~/.local/state')
    return check_owner(Path(own or f'{base}/fogros2'))


def cache_home() -> Path:
    """
    Return FogROS2's cache, below XDG_CACHE_HOME.

    :raises StoreError: it belongs to another account.
    """
    base = os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')
    return check_owner(Path(base) / 'fogros2')


def _config_home() -> Path:
    base = os.environ.get('XDG_CONFIG_HOME') or os.path.expanduser('~/.config')
    return Path(base) / 'fogros2'


def check_owner(path: Path) -> Path:
    """
    Check that a path, if it exists, belongs to root, this account, or its folder's owner.

    In a folder such as /tmp, another account could have made it first.

    :returns: the path.
    :raises StoreError: it belongs to another account.
    """
    try:
        owners = {path.stat().st_uid, path.lstat().st_uid}
        trusted = {0, os.geteuid(), path.parent.stat().st_uid}
    except OSError:
        return path
    if not owners <= trusted:
        raise StoreError(f'{path} belongs to another account',
                         'use a folder in which no other account may write')
    return path


def check_name(name: str) -> str:
    """
    Check that ``name`` is a valid name of a machine; return it.

    :raises ConfigurationError: it is not a DNS label of at most 40 characters.
    """
    if not _NAME.fullmatch(name):
        raise ConfigurationError(
            f'{name!r} is no name for a machine',
            'use 1 to 40 lower-case letters, digits and hyphens, such as slam-1')
    return name


def process_start(pid: int) -> Optional[int]:
    """Return a process's start time in clock ticks since boot, None without such a process."""
    try:
        stat = Path(f'/proc/{pid}/stat').read_text(errors='replace')
    except OSError:
        return None
    # the command's name, in parentheses, may contain spaces and bytes that are no text
    fields = stat.rpartition(')')[2].split()
    return None if fields[0] == 'Z' else int(fields[19])


@functools.lru_cache(maxsize=1)
def boot_id() -> str:
    """Return the id of this computer's current boot, '' if it is unknown."""
    try:
        return Path('/proc/sys/kernel/random/boot_id').read_text().strip()
    except OSError:
        return ''


def process_alive(pid: int, start: int, boot: str = '') -> bool:
    """
    Return whether a recorded process still runs.

    :param start: recorded result of :func:`process_start`; 0 for the first process where this
        user may not see it (hidepid).
    :param boot: recorded result of :func:`boot_id`, because process ids and clock restart at
        each boot; '' if none was recorded.
    """
    return bool(pid) and boot in ('', boot_id()) and (
        process_start(pid) == start or (pid, start) == (1, 0))


def this_process() -> dict[str, Any]:
    """Return the fields of a record by which this process is recognised later."""
    pid = os.getpid()
    return {'pid': pid, 'pid_start': process_start(pid) or 0, 'boot': boot_id()}


def hold(folder: Path) -> int:
    """
    Lock a folder for as long as this process runs; return the file descriptor.

    A container that shares the folder does not see this process, but sees the lock.
    """
    handle = os.open(folder, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    return handle


def held(folder: Path) -> bool:
    """Return whether a process that may be in another container holds a folder."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(handle)
    return False


def launch_process(folder: Path) -> tuple[int, bool]:
    """Return the id of a launch's process, 0 if its folder does not tell, and whether it runs."""
    try:
        data = json.loads((folder / 'process.json').read_text())
        pid = int(data['pid'])
        return pid, held(folder) or process_alive(
            pid, int(data['pid_start']), str(data.get('boot', '')))
    except (OSError, ValueError, KeyError, TypeError):
        return 0, False


@dataclasses.dataclass(frozen=True)
class Made:
    """
    What a launch has made for a machine, and has to undo; see :mod:`fogros2.deploy.undo`.

    :param port: its TCP port, 0 without.
    """

    kind: str
    port: int = 0


@dataclasses.dataclass(frozen=True)
class Record:
    """
    The robot's record of a machine.

    :param machine_id: the provider's id, None until ``create`` has returned.
    :param token: uuid of the creation attempt, stored before it.
    :param created: when the creation was requested, in seconds since the epoch.
    :param armed: when its lifetime last restarted; a launch that reuses the machine restarts it.
    :param launch: id of the launch that uses the machine, '' for none.
    :param last: id of the launch that used it last.
    :param owners: ids of launches, oldest first; the agent knows one of them as its last launch,
        whose end the agent may not know.
    :param robot: see :func:`robot_id`. It differs in a copied state folder.
    :param asked: the provider's options as requested; in ``spec`` all open choices ('cheapest',
        'nearest') are made.
    :param pid: process of that launch; ``pid_start`` (clock ticks) and ``boot`` (id of the boot)
        detect a reused process id.
    :param endpoint: how to reach the machine from outside the VPN.
    :param host_key: the key that the machine generated, '' if the provider's key is used.
    :param vpn_port: UDP port that its firewall admits, 0 if unknown.
    :param vpn: the machine's own VPN interface.
    :param public_key: the machine's VPN public key.
    :param robot_vpn: the robot's VPN interface.
    :param carried: what carries the packets of its VPN in place of UDP, '' for nothing.
    :param agent: the agent's folder on the machine.
    :param notes: what features show of it while its launch runs, by name.
    :param made: what its launch has made and not undone yet, in this order.
    :param damage: why the record cannot be read, '' if it can.
    """

    name: str
    provider: str
    spec: MachineSpec
    token: str = ''
    created: float = 0.0
    armed: float = 0.0
    machine_id: Optional[str] = None
    launch: str = ''
    last: str = ''
    owners: tuple[str, ...] = ()
    robot: str = ''
    pid: int = 0
    pid_start: int = 0
    boot: str = ''
    asked: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    endpoint: Optional[Endpoint] = None
    host_key: str = ''
    vpn_port: int = 0
    vpn: Optional[VpnInterface] = None
    public_key: str = ''
    robot_vpn: Optional[VpnInterface] = None
    carried: str = ''
    agent: str = ''
    agent_program: str = ''
    notes: Mapping[str, str] = dataclasses.field(default_factory=dict)
    made: tuple[Made, ...] = ()
    damage: str = ''

    @property
    def launch_alive(self) -> bool:
        """Whether the launch that uses the machine still runs."""
        return process_alive(self.pid, self.pid_start, self.boot)

    @property
    def earliest(self) -> float:
        """
        The begin of its launch, or of this boot, in seconds since the epoch; 0 if unknown.

        Noted times may be earlier: the system clock was set since.
        """
        if not self.boot or self.boot != boot_id():
            return 0.0
        return time.time() - boot_clock() + self.pid_start / os.sysconf('SC_CLK_TCK')


class Store:
    """
    The state folder, with a folder for each machine and each launch.

    A machine's folder has its record and its keys. The lock on its name is beside the folder.

    :raises StoreError: this user may not read the folder.
    """

    def __init__(self, root: Optional[Path] = None) -> None:
        self.root = root or state_home()
        _check_readable(self.root)

    def launch_folder(self, launch_id: str) -> Path:
        """Return a launch's folder (0700); create it if needed."""
        return make_folder(self.root / 'launches' / launch_id)

    def machine(self, name: str) -> Path:
        """Return the path of a machine's folder, whether or not it exists."""
        return self.root / 'machines' / check_name(name)

    def key_file(self, name: str) -> Path:
        """Return the path of a machine's private login key."""
        return self.machine(name) / 'id_ed25519'

    def exists(self, name: str) -> bool:
        """Return whether a machine has a record."""
        return (self.machine(name) / 'record.json').exists()

    def load(self, name: str) -> Record:
        """
        Read a machine's record.

        :raises StoreError: there is no record, or it is damaged.
        """
        path = self.machine(name) / 'record.json'
        try:
            return record_from_json(json.loads(path.read_text()))
        except (FileNotFoundError, NotADirectoryError):
            names = [path.name for path in (self.root / 'machines').glob('[!.]*')]
            raise StoreError(
                f"this robot has no record of a machine '{name}'", did_you_mean(
                    name, names, 'ros2 fog list shows the machines that exist')) from None
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise StoreError(
                f'{path} is damaged: {error}',
                f'ros2 fog delete {name} finds the machine by its tags, if it has any') from error

    def save(self, record: Record) -> Record:
        """Replace a machine's record on disk, and return it."""
        write_private(
            self.machine(record.name) / 'record.json', model.to_json(record).encode())
        return record

    def delete(self, name: str) -> None:
        """Remove a machine's folder with its content."""
        delete_folder(self.machine(name))

    def _request(self, record: Record) -> Path:
        return self.root / 'requests' / f'{record.name}.{record.last}.json'

    def set_aside(self, record: Record) -> None:
        """Remove a machine's folder, but keep the request for it, which got no answer."""
        write_private(self._request(record), model.to_json(record).encode())
        self.delete(record.name)

    def requests(self) -> list[tuple[Record, float]]:
        """Return the records of requests without an answer, and the seconds since each."""
        requests = []
        for path in sorted((self.root / 'requests').glob('[!.]*.json')):
            try:
                record = record_from_json(json.loads(path.read_text()))
                since = max(path.stat().st_mtime, record.earliest)
                requests.append((record, time.time() - since))
            except (OSError, ValueError, TypeError, KeyError, AttributeError):
                continue  # another program has just removed it, or it is damaged
        return requests

    def answered(self, record: Record) -> None:
        """Forget a request: no machine of it can appear any more."""
        self._request(record).unlink(missing_ok=True)

    @contextlib.contextmanager
    def lock(self, name: str, *, cancel: Optional[threading.Event] = None) -> Iterator[None]:
        """
        Lock a machine's name on this robot while a launch or a verb works on the machine.

        :param cancel: a launch's, which waits for a verb to end, not for another launch.
        :raises NameTaken: another process holds the lock.
        :raises Cancelled: the launch ends.
        :raises StoreError: the folder is not writable.
        """
        # beside the folder: deleting the folder must not release the lock early
        path = self.machine(name).with_name(f'.{name}.lock')
        make_folder(path.parent)
        with contextlib.ExitStack() as undo:
            while True:
                try:
                    handle = undo.enter_context(open(path, 'a+b', buffering=0))
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    handle.truncate(0)
                    with contextlib.suppress(OSError):  # a full disk prevents no deletion
                        handle.write(b'command' if cancel is None else b'launch')
                except BlockingIOError:
                    handle.seek(0)
                    holder = handle.read().decode()
                    handle.close()
                    if cancel is None or holder != 'command':
                        raise NameTaken(
                            f"another {holder or 'launch'} on this robot has the machine '{name}'",
                            'try again when it has ended' if holder == 'command' else
                            'give the machine another name=, or end that launch') from None
                    if cancel.wait(0.2):
                        raise Cancelled(f"waiting for the command that has '{name}'") from None
                    continue
                except OSError as error:
                    raise _not_written(path, error) from error
                # a former holder may have removed the file between open and lock
                with contextlib.suppress(FileNotFoundError):
                    if os.path.samestat(os.fstat(handle.fileno()), path.stat()):
                        break
            undo.callback(path.unlink, missing_ok=True)
            yield

    def machines(self) -> list[Record]:
        """Return all records, sorted by name; a damaged one has ``damage``."""
        records = []
        folder = self.root / 'machines'
        for path in sorted(folder.iterdir()) if folder.is_dir() else []:
            if path.name.startswith('.') or not path.is_dir():
                continue
            try:
                records.append(self.load(path.name))
            except (StoreError, ConfigurationError) as error:
                spec = MachineSpec(path.name, '')
                records.append(Record(path.name, '', spec, damage=str(error)))
        return records

    def other_vpns(self) -> dict[str, Path]:
        """Return the folders of other robots' VPNs that this computer has joined, by machine."""
        return {other.machine.name: path.parent
                for path in sorted((self.root / 'launches').glob(f'*/{OTHER_VPN}'))
                if (other := other_vpn(path.parent)) is not None}

    def sweep(self) -> None:
        """Remove the locks, unfinished files and folders that killed launches left."""
        # no deeper: copies of nodes' folders are there
        for path in [path for pattern in ('.*', '*/.*', '*/*/.*')
                     for path in self.root.glob(pattern)]:
            unfinished = _UNFINISHED.fullmatch(path.name)
            if not unfinished or process_start(int(unfinished[1])) is not None:
                continue
            if not path.is_dir():
                path.unlink(missing_ok=True)
            elif not held(path):
                delete_folder(path)
        for path in (self.root / 'machines').glob('*'):
            with contextlib.suppress(NameTaken, ConfigurationError, OSError):
                if path.name.startswith('.') or not any(path.iterdir()):
                    with self.lock(path.name.removeprefix('.').removesuffix('.lock')):
                        path.rmdir()


def robot_name() -> str:
    """Return this robot's name: host name and user id. Cloned robots have the same name."""
    return f'{os.uname().nodename}-{os.getuid()}'


def robot_id(*, new: bool = True) -> str:
    """
    Return this robot's id in tags: its name, and random digits that belong to this computer.

    The digits are in the file ``robot.json`` of the configuration folder, by the computer's
    machine-id and one MAC address; in WSL 2, by the machine-id. Another computer with the file,
    or a copy of it, adds its own.

    :param new: make digits if there are none; else return the name alone.
    :raises StoreError: the file can't be written.
    """
    folders = (_config_home(), state_home())
    error: Optional[OSError] = None
    for make in (False, True) if new else (False,):
        for folder in folders:
            try:
                digits = _digits(folder, new=make)
            except OSError as problem:
                error = problem
                continue
            if digits:
                return f'{robot_name()}-{digits}'
    if not new:
        return robot_name()
    assert error is not None
    raise _not_written(state_home() / 'robot.json', error) from error


def is_another_robot(noted: str) -> bool:
    """
    Return whether a tag or a record has the id of another robot.

    The host name of this robot may have changed since; the digits stay.
    """
    own = robot_id(new=False)
    digits = own.removeprefix(robot_name())
    return noted not in ('', own) and not (digits and noted.endswith(digits))


def _digits(folder: Path, *, new: bool) -> str:
    """
    Return the random digits of a ``robot.json``, '' without those of this computer.

    :param new: make digits if there are none of this computer.
    """
    if new:
        _make_folders(folder)
    machine = Path('/etc/machine-id')
    machine_id = machine.read_text().strip() if machine.exists() else ''
    # WSL 2 gives its only network card another address at each start
    addresses = [] if 'microsoft' in os.uname().release else mac_addresses()
    with open(folder / 'robot.json', 'a+' if new else 'r',
              opener=lambda path, flags: os.open(path, flags, 0o600)) as file:
        fcntl.flock(file, fcntl.LOCK_EX if new else fcntl.LOCK_SH)
        file.seek(0)
        try:
            known: dict[str, str] = dict(json.load(file))
            if 'digits' in known:  # an older version's, of one computer
                known.setdefault(f"{known['machine_id']} {known['mac']}", known['digits'])
        except (ValueError, TypeError, LookupError):
            known = {}
        computers = [f'{machine_id} {address}' for address in addresses or ['']]
        for computer in computers:
            if known.get(computer):
                return known[computer]
        if not new:
            return ''
        known[computers[0]] = secrets.token_hex(4)
        file.truncate(0)
        json.dump(known, file)
        return known[computers[0]]


def mac_addresses(folder: Path = Path('/sys/class/net')) -> list[str]:
    """Return this computer's MAC addresses, hardware's first, bridges and their ports last."""
    candidates = []
    for path in folder.iterdir() if folder.is_dir() else []:
        with contextlib.suppress(OSError):
            address = (path / 'address').read_text().strip()
            # 0: the address is the device's own, not a random one
            own = (path / 'addr_assign_type').read_text().strip() == '0'
            if len(address) == 17 and address.strip('0:'):
                # a container engine makes bridges, and takes them away
                passing = (path / 'bridge').exists() or (path / 'brport').exists()
                candidates.append(
                    (not (path / 'device').exists(), passing, not own, path.name, address))
    return [address for *_, address in sorted(candidates)]


def write_private(path: Path, data: bytes) -> None:
    """
    Write a file (0600) atomically, in a folder (0700) that is created if needed.

    :raises StoreError: the disk is full, or the folder is not writable.
    """
    make_folder(path.parent)
    try:
        handle, aside = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.{os.getpid()}.')
        try:
            with os.fdopen(handle, 'wb') as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(aside, path)
        except BaseException:
            os.unlink(aside)
            raise
    except OSError as error:
        raise _not_written(path, error) from error


def delete_folder(path: Path) -> None:
    """
    Delete a folder with its content, also with folders inside that nobody may write, or very deep.

    Nodes may have made such folders, of which a copy is here.
    """
    with contextlib.suppress(RecursionError):  # before Python 3.12.4
        shutil.rmtree(path, ignore_errors=True)
    if path.is_dir():
        for words in (('find', str(path), '-type', 'd', '!', '-perm', '-700',
                       '-exec', 'chmod', 'u+rwx', '{}', ';'),
                      ('rm', '-rf', '--', str(path))):
            with contextlib.suppress(FogError):  # it takes too long
                process.run(Command(words), timeout=_DELETION, check=False, kept=1e4)


def entries(folder: Path, *, without: str = '') -> Iterator[os.DirEntry[str]]:
    """
    Yield the content of a folder and of all folders below, at any depth; follow no link.

    :param without: name of folders that are left out.
    """
    folders = [str(folder)]
    while folders:
        # deleted meanwhile
        with contextlib.suppress(OSError), os.scandir(folders.pop()) as found:
            for entry in found:
                if entry.is_dir(follow_symlinks=False):
                    if entry.name == without:
                        continue
                    folders.append(entry.path)
                yield entry


def process_folder() -> Path:
    """
    Return a new folder (0700) that is removed when this process ends.

    :raises StoreError: the disk is full, or the state folder is not writable.
    """
    home = make_folder(state_home())
    try:
        folder = tempfile.mkdtemp(dir=home, prefix=f'.process.{os.getpid()}.')
        hold(Path(folder))
    except OSError as error:
        raise _not_written(home, error) from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _check_readable(root: Path) -> None:
    """
    Check that this user may read a state folder, such as one that a launch as root has made.

    :raises StoreError: this user may not.
    """
    for folder in (*reversed(root.parents), root,
                   *(root / name for name in ('machines', 'launches', 'requests'))):
        inside = root in (folder, *folder.parents)
        if os.path.isdir(folder) and not os.access(
                folder, os.X_OK | (os.R_OK if inside else 0), effective_ids=True):
            raise StoreError(
                f"{folder} can't be read by this user",
                f'sudo chown -R {os.geteuid()} {root if inside else folder}'
                if inside or folder.is_relative_to(os.path.expanduser('~/.local'))
                else _ELSEWHERE)


def make_folder(path: Path) -> Path:
    """
    Create a folder (0700) and the folders above it, if needed; return it.

    :raises StoreError: the disk is full, or the folder above is not writable.
    """
    try:
        _make_folders(path)
    except OSError as error:
        raise _not_written(path, error) from error
    return path


def _make_folders(path: Path) -> None:
    # parents=True would create the parent folders with the default mode
    for folder in reversed([path, *path.parents]):
        if not folder.exists():
            folder.mkdir(mode=0o700, exist_ok=True)
            if os.geteuid() == 0 and any(folder in home.parents for home in (
                    state_home(), cache_home(), _config_home())):
                # such as ~/.local of a user who runs a launch by sudo
                owner = folder.parent.stat()
                os.chown(folder, owner.st_uid, owner.st_gid, follow_symlinks=False)


def _not_written(path: Path, error: OSError) -> StoreError:
    return StoreError(f"{path} can't be written: {error.strerror}",
                      _ELSEWHERE)


def other_vpn(folder: Path) -> Optional[OtherVpn]:
    """Return the VPN of another robot that a folder belongs to, None if it belongs to none."""
    with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
        data = json.loads((folder / OTHER_VPN).read_text())
        return OtherVpn(
            _known(Peer, data['machine']), _known(VpnInterface, data['interface']),
            _known(VpnInterface, data['own']), data['heartbeats'])
    return None


def record_from_json(data: Mapping[str, Any]) -> Record:
    """Read a Record that ``model.to_json`` wrote."""
    values, spec = dict(data), dict(data['spec'])
    for key in ('underlays', 'apt', 'pip'):
        spec[key] = tuple(spec.get(key, ()))
    values['spec'] = _known(MachineSpec, spec)
    for key, kind in (('endpoint', Endpoint), ('vpn', VpnInterface), ('robot_vpn', VpnInterface)):
        if values.get(key) is not None:
            values[key] = _known(kind, values[key])
    values['made'] = tuple(_known(Made, each) for each in values.get('made', ()))
    values['owners'] = tuple(values.get('owners', ()))
    values['asked'] = values.get('asked') or {}
    return _known(Record, values)


def _known(kind: type[T], data: Mapping[str, Any]) -> T:
    """Make a dataclass of JSON values; ignore unknown keys of later versions."""
    names = {field.name for field in dataclasses.fields(kind)}
    return kind(**{key: value for key, value in data.items() if key in names})

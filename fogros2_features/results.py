# SPDX-License-Identifier: Apache-2.0
"""Bring folders of a machine to the robot before the launch gives the machine up."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import contextlib
import dataclasses
import itertools
import os
from pathlib import Path
import re
import shutil
import time
from typing import Optional, TYPE_CHECKING

from fogros2 import untrusted
from fogros2.describe.values import check_folder
from fogros2.errors import (
    ConfigurationError,
    ConnectError,
    DeadlineExceeded,
    FogError,
    ShellError,
)
from fogros2.feature import Feature, RunningMachine
from fogros2.model import Command, MachineSpec, NodeSpec
from fogros2.ros_names import check_name
from fogros2.shell.command_line import remote_path
from fogros2.shell.sync import size_on_disk, Stall
from fogros2.store import check_owner, robot_id

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

#: Where folders come to, and how many bytes they may have together, by default.
TARGET, LIMIT = '~/fogros2', 10e9
#: Seconds in which no byte comes, and the number of attempts in which none comes, until a copy
#: fails. rsync reads what came before, so 10 GB on a slow disk need minutes.
TIMEOUT, ATTEMPTS = 900.0, 3
#: Bytes per second that a machine has to send, so that it can't hold the launch's end for good.
SLOWEST = 10e3
#: Bytes that a folder may take on the disk beyond its limit: each small file has a block.
SLACK = 100e6
#: Bytes, or half of what is free, that no copy takes from the robot's disk.
SPARE = 1e9
#: Name of the folder in which recordings are, there and here.
RECORDED = 'recordings'
_UNITS = {'': 1.0, 'k': 1e3, 'M': 1e6, 'G': 1e9, 'T': 1e12}
# Print the bytes in the folder {0}, or in the one that it links to; nothing without the folder.
# Hard links count each, because each becomes a file here.
_SIZE = '[ ! -d {0} ] || du -sbl -- {0}/. | cut -f 1'


def recordings_of(machine: str) -> str:
    """Return where a machine keeps recordings until they come home; robots may share a host."""
    return f"~/fogros2-{machine}-{robot_id().rpartition('-')[2]}"


@dataclasses.dataclass(frozen=True)
class Wanted:
    """
    What to bring home.

    :param folders: on the machine, as ``check_folder`` returns them.
    :param target: folder on the robot; each launch makes one there.
    :param limit: bytes of all folders together.
    :param topics: to record.
    """

    folders: tuple[str, ...]
    target: Path
    limit: float
    topics: tuple[str, ...] = ()


class Results(Feature):
    """``fetch=['~/bags']``, ``record=['/tf']``: what comes home at the end."""

    @staticmethod
    def options(
        fetch: Optional[Sequence[SomeSubstitutionsType]] = None,
        fetch_to: Optional[SomeSubstitutionsType] = None,
        fetch_limit: Optional[SomeSubstitutionsType] = None,
        record: Optional[Sequence[SomeSubstitutionsType]] = None,
    ) -> Wanted:
        """
        Return what to bring home.

        :param fetch: folders of the machine.
        :param fetch_to: folder on the robot.
        :param fetch_limit: how much they may have together, such as '2GB'.
        :param record: topics that the machine records in an MCAP file.
        """
        folders = tuple(dict.fromkeys(
            check_folder('fetch', str(folder)) for folder in fetch or ()))
        target = Path(os.path.expanduser(str(fetch_to or TARGET)))
        if not target.is_absolute():
            raise ConfigurationError(f"fetch_to='{fetch_to}' is no absolute path",
                                     "such as '~/fogros2'")
        return Wanted(
            folders, target, LIMIT if fetch_limit is None else _bytes(str(fetch_limit)),
            tuple(dict.fromkeys(check_name(str(topic)) for topic in record or ())))

    def check(self, spec: MachineSpec, own: Wanted) -> None:
        """Check that this user may write to the folder on the robot."""
        if not (own.folders or own.topics):
            return
        # not by Path: another account's folder may be closed to this one
        parent = next(path for path in (own.target, *own.target.parents) if os.path.exists(path))
        check_owner(own.target)
        if not (os.path.isdir(parent) and os.access(parent, os.W_OK | os.X_OK)):
            raise ConfigurationError(f"fetch_to='{own.target}' can't be written",
                                     'name a folder of this user')

    def beside(self, spec: MachineSpec, own: Wanted) -> Sequence[NodeSpec]:
        """Return the program that records, with the names that streams give to topics there."""
        folder = f'{recordings_of(spec.name)}/{RECORDED}'
        return [NodeSpec(
            id=f'record-{spec.name}', name='record', package='fogros2', executable='record',
            arguments=(folder, *own.topics, '--ros-args'))] if own.topics else []

    @contextlib.contextmanager
    def machine(self, running: RunningMachine, own: Wanted) -> Iterator[None]:
        """Bring the folders home when the machine's nodes have ended."""
        yield
        recordings = recordings_of(running.spec.name)
        if own.topics:
            own = dataclasses.replace(own, folders=(*own.folders, f'{recordings}/{RECORDED}'))
        if own.folders and not running.lost:
            with running.step('results') as detail:
                detail.append(_bring(running, own))
                if own.topics:  # a machine that stays records anew
                    running.run(Command.script(f'rm -rf -- {remote_path(recordings)}',
                                               what=f'remove {recordings}'), timeout=60.0)


def _bring(running: RunningMachine, own: Wanted) -> str:
    """
    Copy the folders; return what was done.

    :raises FogError: together they are too large, or one can't be copied; the others are.
    """
    sizes = {folder: size for folder in own.folders
             if (size := _size(running, folder)) is not None}
    missing = [folder for folder in own.folders if folder not in sizes]
    total = sum(sizes.values())
    if total > own.limit:
        raise ShellError(
            f"{', '.join(sizes)} of '{running.spec.name}' have {total / 1e9:.3g} GB, more than "
            f'fetch_limit={own.limit / 1e9:.3g} GB: they did not come home',
            'raise fetch_limit=, or write less')
    home = own.target / f'{running.spec.name}-{time.strftime("%Y%m%d-%H%M%S")}'
    done, failures, large = list[str](), list[FogError](), list[str]()
    if sizes:
        _make(check_owner(own.target))
        home = _make(home, number=1)
        done.append(f'{total / 1e6:.3g} MB to {home}')
    # the small ones first, which may fit where a large one does not
    for folder, target in sorted(_targets(home, sizes).items(), key=lambda one: sizes[one[0]]):
        free = shutil.disk_usage(home).free
        if sizes[folder] > max(free - SPARE, free / 2):
            large.append(folder)
            continue
        try:
            # a folder may grow meanwhile, and many small files take more than their sizes
            _copy(running, folder, target, size=sizes[folder],
                  limit=int(max(2 * sizes[folder], own.limit) + SLACK))
        except FogError as error:
            failures.append(error)
            if isinstance(error, ConnectError):
                break  # the others would wait for the same machine
    if large:
        failures.append(ShellError(
            f"{', '.join(large)} of '{running.spec.name}' did not come home: "
            f'{sum(map(sizes.__getitem__, large)) / 1e9:.3g} GB are too much for the disk of '
            f'{own.target}, which has {free / 1e9:.3g} GB free',
            'free some space, or name a folder of a larger disk in fetch_to='))
    if failures:
        raise failures[0]
    if missing:
        done.append(f"no {', '.join(missing)} there")
    return ', '.join(done)


def _make(folder: Path, *, number: int = 0) -> Path:
    """Make a folder; with ``number`` a new one, as another robot may have made its name."""
    path = folder.with_name(f'{folder.name}-{number}') if number > 1 else folder
    try:
        # a new one is nobody else's
        path.mkdir(parents=True, exist_ok=not number)
    except OSError as error:
        if number and isinstance(error, FileExistsError):
            return _make(folder, number=number + 1)
        raise ShellError(f"{path} can't be written: {error.strerror}",
                         'fetch_to= names another folder') from error
    return path


def _copy(running: RunningMachine, folder: str, target: Path, *, size: int, limit: int) -> None:
    _make(target)
    arrived, failures, late = 0, 0, Stall(None, TIMEOUT + size / SLOWEST)
    while True:
        try:
            running.shell.fetch(
                folder, target, known=None, limit=limit, timeout=TIMEOUT, cancel=late)
            return
        except (ConnectError, DeadlineExceeded):
            late.is_set()  # raises an error when the time is over
            # a machine may take back what it has sent
            before, arrived = arrived, max(arrived, size_on_disk(target))
            failures = 1 if arrived > before else failures + 1
            if failures == ATTEMPTS:
                raise  # what has arrived stays


def _targets(home: Path, folders: Iterable[str]) -> dict[str, Path]:
    """Return where each folder comes to: by its last name, with a number if that is taken."""
    targets: dict[str, Path] = {}
    for folder in folders:
        name = folder.rpartition('/')[2]
        numbered = (home / (f'{name}-{number}' if number > 1 else name)
                    for number in itertools.count(1))
        targets[folder] = next(path for path in numbered if path not in targets.values())
    return targets


def _size(running: RunningMachine, folder: str) -> Optional[int]:
    """Return a folder's bytes, None without the folder."""
    text = running.run(
        Command.script(_SIZE.format(remote_path(folder)), what=f'look at {folder}'),
        timeout=600.0).strip()
    try:
        return untrusted.number(text) if text else None
    except untrusted.InvalidMessage as error:
        raise ShellError(f'the size of {folder} is not known: {error}',
                         'the machine may be hijacked: delete it') from error


def _bytes(text: str) -> float:
    match = re.fullmatch(r'(\d+(?:\.\d+)?) ?([kMGT]?)B?', text)
    if match is None or not float(match[1]):
        raise ConfigurationError(f'fetch_limit={text!r} is no number of bytes', "such as '2GB'")
    return float(match[1]) * _UNITS[match[2]]

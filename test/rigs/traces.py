# SPDX-License-Identifier: Apache-2.0
"""
What launches leave on this computer, told from what others do on it at the same time.

A trace is taken for this run's if it carries the id of a launch, or the folder of a machine, that
a state folder of this run has known while a test ran, or if it is among the run's own files or
comes from a process of its own. So another run of tests, or the user's own robot, disturbs nobody.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import contextlib
import dataclasses
import itertools
import json
import os
from pathlib import Path
import re
import threading
from typing import Any

from fogros2.errors import DeadlineExceeded, MachineNotFound
from fogros2.model import Command
from fogros2.process import run, which
from fogros2.provider.container.machine import directory
from fogros2.waiting import wait_until

#: Variable by which a process is known to come from a run of tests; its value is the run's own.
RUN = 'FOGROS2_TEST_RUN'

#: Seconds between two looks at state folders, which know a launch for longer than that; and how
#: many of these looks there are for each one for folders.
NOTE, FOLDERS = 0.2, 5

#: 'fogt' begins the names of tests of single parts, which tidy up by themselves.
_SINGLE = 'fogt'
_INTERFACE = re.compile(r'\bfog([0-9a-f]{6})(?:m\d+)?\b')
#: Root folders of containers, by their ids.
_roots: dict[str, str] = {}
_ROOT = re.compile(r'/fogros2/([A-Za-z0-9_-]+)')
_FILTER = re.compile(r'\bfogros2-([A-Za-z0-9_-]+)')


@dataclasses.dataclass(frozen=True)
class Trace:
    """
    Something that a launch may leave behind.

    :param what: a line for people.
    :param marks: ids of launches and folders of machines that it carries.
    :param ours: whether it is this run's, whatever it carries.
    """

    what: str
    marks: frozenset[str] = frozenset()
    ours: bool = False


class Traces:
    """
    A look at this computer, by one run of tests.

    :param state: the state folder of the launches that are looked for.
    :param files: folder below which the run keeps all its files.
    :param run: what its processes have in the variable ``RUN``.
    """

    def __init__(self, state: Path, files: Path, run: str) -> None:
        self._files = files
        self._run = run
        self._state = state
        self._folders = {state}
        #: How often each process was looked at; reading the variables of all takes long.
        self._looks = Counter[str]()
        #: The marks of this run's launches and machines.
        self.marks: set[str] = set()
        self._before = {trace.what for trace in self._look()}

    def note(self) -> None:
        """Remember the marks of the launches and machines that there are now."""
        for folder in self._folders:
            self.marks |= _known(folder)

    def find_folders(self) -> None:
        """Look for more state folders, which new processes of this run have."""
        for process in _processes():
            self._looks[process.name] += 1
            if self._looks[process.name] > 2:  # once it may be about to run its program
                continue
            variables = _variables(process)
            if variables.get(RUN) == self._run and 'FOGROS2_STATE_HOME' in variables:
                self._folders.add(Path(variables['FOGROS2_STATE_HOME']))

    def left(self) -> set[str]:
        """Return what wasn't there when this was made, and is this run's."""
        self.note()
        return {trace.what for trace in self._look()
                if trace.what not in self._before and (trace.ours or trace.marks & self.marks)
                and not self._used_by_others(trace.what)}

    def _look(self) -> set[Trace]:
        return look(self._state, self._files, self._run)

    def _used_by_others(self, what: str) -> bool:
        """Return whether a file is named by processes of which none is this run's."""
        kind, _, path = what.partition(' ')
        users = [process for process in _processes()
                 if any(path in word for word in _words(process))] if kind == 'file' else []
        return bool(users) and not any(_of_run(user, self._run) for user in users)


@contextlib.contextmanager
def nothing_left(traces: Traces, *, timeout: float) -> Iterator[None]:
    """
    Look, after the block, whether all is gone that it made.

    :param timeout: seconds that what is ending by itself may take.
    :raises AssertionError: something is there still.
    """
    done = threading.Event()

    def note() -> None:
        for number in itertools.count():
            if number % FOLDERS == 0:
                traces.find_folders()
            traces.note()
            if done.wait(NOTE):
                return

    noting = threading.Thread(target=note, name='fog-note', daemon=True)
    noting.start()
    try:
        yield
    finally:
        done.set()
        noting.join()
    left: set[str] = set()

    def gone() -> bool:
        left.clear()
        left.update(traces.left())
        return not left

    try:
        wait_until(gone, timeout=timeout, what='everything to be gone')
    except DeadlineExceeded:
        raise AssertionError(f'left behind: {sorted(left)}') from None


def look(state: Path, files: Path, run: str) -> set[Trace]:
    """Return everything on this computer now that a launch may leave behind; see ``Traces``."""
    found = {_named('interface', name) for name in os.listdir('/sys/class/net')
             if name.startswith('fog') and not name.startswith(_SINGLE)}
    found |= {_named('control group', name) for _, names, _ in os.walk('/sys/fs/cgroup')
              for name in names if name.startswith('fog') and not name.startswith(_SINGLE)}
    containers = _containers()
    found |= {container.trace for container in containers.values() if container.of_a_launch}
    found |= set(_programs(containers, files, run))
    for words, kind in (
        (('nft', 'list', 'tables'), 'nftables'),
        (('ip', 'route', 'show', 'table', 'all'), 'route'),
    ):
        found |= {_named(kind, line) for line in _output(*words)
                  if 'fog' in line and _SINGLE not in line}
    for line in Path('/proc/mounts').read_text().splitlines():
        target = line.split()[1]
        if 'fogros2' in target:
            found.add(Trace(f'mount {target}', frozenset(_ROOT.findall(target))))
    for folder in ('run', 'tmp', 'var/tmp'):
        found |= {Trace(f'file {path}', ours=True)
                  for path in Path('/', folder).glob('fogros2*')}
    found |= {Trace(f'state {Path(folder, name).relative_to(state)}', ours=True)
              for folder, _, names in os.walk(state) for name in names}
    return found


def _named(kind: str, line: str) -> Trace:
    return Trace(f'{kind} {line}', frozenset(_INTERFACE.findall(line) + _FILTER.findall(line)))


@dataclasses.dataclass(frozen=True)
class _Container:
    """A container, of a launch if it has the label that every launch gives its machines."""

    identity: str
    name: str
    launch: str
    token: str

    @property
    def of_a_launch(self) -> bool:
        return bool(self.launch) and _SINGLE not in self.name

    @property
    def trace(self) -> Trace:
        return Trace(
            f'container {self.name}', frozenset({self.launch, _folder(self.token)} - {''}))

    def is_among(self, files: Path) -> bool:
        """Return whether it is a computer among a test's own files, such as an SSH machine."""
        if _SINGLE not in self.name:
            return False
        # each question to the engine takes a tenth of a second, and the answer doesn't change
        if not _roots.get(self.identity):
            _roots[self.identity] = ''.join(_output(
                'podman', 'inspect', '--format', '{{.Rootfs}}', self.identity)).strip()
        root = _roots[self.identity]
        return bool(root) and Path(root).is_relative_to(files)


def _containers() -> dict[str, _Container]:
    """Return containers by id."""
    columns = ['{{.ID}}', '{{.Names}}', '{{index .Labels "fogros2-launch"}}',
               '{{index .Labels "fogros2-token"}}']
    found = {}
    for line in _output('podman', 'ps', '-a', '--no-trunc', '--format', '\t'.join(columns)):
        identity, *about = line.split('\t')
        if len(about) == 3 and 'fog' in about[0]:
            found[identity] = _Container(identity, *about)
    return found


def _programs(containers: dict[str, _Container], files: Path, run: str) -> Iterator[Trace]:
    """Yield agents and VPN programs, in containers too."""
    for process in _processes():
        words = _words(process)
        if os.path.basename(words[0] if words else '') == 'wireguard-go':
            if not any(word.startswith(_SINGLE) for word in words):
                yield Trace(f'process {process.name} wireguard-go',
                            frozenset(_INTERFACE.findall(' '.join(words))))
        elif any(word.endswith('agent.py') for word in words[:3]):
            marks = set(_agent_marks(process, words))
            container = containers.get(_container_of(process))
            if container is not None:
                marks |= container.trace.marks
            yield Trace(f'process {process.name} {" ".join(words[:4])}', frozenset(marks),
                        _of_run(process, run) or any(
                            Path(word).is_relative_to(files) for word in words)
                        or container is not None and container.is_among(files))


def _container_of(process: Path) -> str:
    """Return the id of the container that a process is in, '' for none."""
    try:
        found = re.search('[0-9a-f]{64}', (process / 'cgroup').read_text())
    except OSError:
        return ''
    return found[0] if found else ''


def _agent_marks(process: Path, words: list[str]) -> Iterator[str]:
    """Yield the launches that an agent's configurations name, read in its own file system."""
    options = dict(zip(words, words[1:]))
    program = next(word for word in words if word.endswith('agent.py'))
    first = _read_json(process, options.get('--config', ''))
    # the folder in which the agent keeps what it was told later: that of its program too, where
    # the first configuration is gone by now
    folders = {options.get('--directory'), first.get('directory'), os.path.dirname(program)}
    for config in (first, *(_read_json(process, f'{folder}/config.json')
                            for folder in folders if folder)):
        if config.get('launch'):
            yield str(config['launch'])


def _read_json(process: Path, path: str) -> dict[str, Any]:
    if path.startswith('~/'):
        path = f'{_variables(process).get("HOME", "")}{path[1:]}'
    if not path.startswith('/'):
        return {}
    try:
        value = json.loads(_read(f'{process}/root{path}'))
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


def _read(path: str) -> str:
    if os.geteuid() == 0:  # a program for each agent of this computer takes long
        return Path(path).read_text()
    return run(Command(('cat', path), sudo=True), timeout=60.0, check=False).stdout


def _known(folder: Path) -> set[str]:
    """Return the marks that a state folder knows; of one that changes meanwhile, some."""
    marks = {path.name for path in _listed(folder / 'launches')}
    for path in _listed(folder / 'machines'):
        try:
            told = json.loads((path / 'record.json').read_text())
        except (OSError, ValueError):
            continue
        marks |= {told[key] for key in ('launch', 'last') if told.get(key)}
        marks |= {_folder(told.get('token', ''))} - {''}
    return marks


def _folder(token: str) -> str:
    """Return the name of the folder of the container machine with a token, '' for no token."""
    try:
        return directory(token).name
    except MachineNotFound:
        return ''


def _listed(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:
        return []


def _of_run(process: Path, run: str) -> bool:
    return _variables(process).get(RUN) == run


def _processes() -> Iterator[Path]:
    return Path('/proc').glob('[0-9]*')


def _words(process: Path) -> list[str]:
    try:
        return (process / 'cmdline').read_bytes().decode(errors='replace').split('\0')[:-1]
    except OSError:
        return []


def _variables(process: Path) -> dict[str, str]:
    """Return the variables that a process was started with; none where they aren't ours to see."""
    try:
        text = (process / 'environ').read_bytes().decode(errors='replace')
    except OSError:
        return {}
    return dict(item.split('=', 1) for item in text.split('\0') if '=' in item)


def _output(*words: str) -> list[str]:
    if which(words[0]) is None:
        return []
    return run(Command(words, sudo=True), timeout=30.0, check=False).stdout.splitlines()

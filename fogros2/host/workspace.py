# SPDX-License-Identifier: Apache-2.0
"""
Send colcon workspaces to a machine, and build them there if necessary.

``inspect`` reads a workspace, ``plan`` decides, and ``transfer`` carries the plan out. A machine
like the robot gets the install space. Another machine gets the sources, and builds them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
import functools
import os
from pathlib import Path
import re
import shlex
import sys
import threading
import time
from typing import Optional
import xml.etree.ElementTree as ElementTree

from fogros2 import process
from fogros2.errors import WorkspaceError
from fogros2.host.inspection import DISTRO, HostFacts
from fogros2.model import Command
from fogros2.plugin_system import own_packages
from fogros2.report import size
from fogros2.shell import retried, Shell
from fogros2.waiting import Timeouts

#: rsync patterns of files that no machine needs, anywhere in a workspace.
EXCLUDES = ('.git', '.hg', '.svn', '__pycache__', '*.pyc', '.venv', '.cache', '.mypy_cache',
            '.pytest_cache', '.ruff_cache', '.vscode', '.idea')
#: Seconds for which machines share what was read of a workspace.
SHARED = 20.0
#: Folders that colcon creates in a workspace.
BUILT = ('build', 'install', 'log')
#: Architecture in the form of ``uname -m``, by ``e_machine`` in the header of an ELF file.
_ELF_MACHINES = {3: 'i686', 40: 'armv7l', 62: 'x86_64', 183: 'aarch64', 243: 'riscv64'}
_LIBRARY = re.compile(r'\.so(\.[0-9.]+)?$')
_SKIPPED = {'.git', '.hg', '.svn', '__pycache__', '.venv', 'node_modules'}
#: Variables of conditions in manifests (REP 149), besides those of the robot's environment.
_ROS = {'ROS_VERSION': '2', 'ROS_DISTRO': DISTRO, 'ROS_PYTHON_VERSION': '3'}
_RUN = ('depend', 'exec_depend', 'run_depend')
#: What rosdep installs.
_ALL = (*_RUN, 'build_depend', 'build_export_depend', 'buildtool_depend',
        'buildtool_export_depend', 'test_depend')

# Delete packages of an earlier build that the workspace does not have any more: local_setup.sh
# sources each package in the install space. $below is the folder of the sources.
_CLEAN = """\
if [ -d install ] &&
    names=$(colcon --log-base /dev/null list --names-only --base-paths "$below"); then
    for prefix in install/*; do
        name=${prefix##*/}
        [ ! -e "$prefix/share/colcon-core/packages/$name" ] ||
            printf '%s\\n' "$names" | grep -qxFe "$name" || rm -rf "$prefix" "build/$name"
    done
fi
"""

# Make a folder for an account, in which that account may enter: $1 is its path, $2 user:group.
_AS_ROOT = """\
[ ! -e "$1" ] || { echo "$1 belongs to $(stat -c %U "$1"): use another login user, or a" \
    "workspace at another path" >&2; exit 1; }
umask 022
mkdir -p "$1"
chown -h "$2" "$1"
"""
# Refuse a path at which another account may put folders of its own: $1. The user's own group, as
# Ubuntu makes it, has no other member.
_OF_OTHERS = """\
refuse() {
    echo "$path $1: use another login user, or a workspace at another path" >&2
    exit 1
}
user=$(id -un 2>/dev/null) group=0
case $(getent group "$(id -g)") in
    "$user":*: | "$user":*:"$user") group=$(id -g) ;;
esac
real=$(readlink -m "$1" || echo /)
for path in "$1" "$real"; do
    while :; do
        for owner in $(stat -c %u "$path" 2>/dev/null; stat -Lc %u "$path" 2>/dev/null); do
            [ "$owner" = 0 ] || [ "$owner" = "$(id -u)" ] || refuse 'belongs to another account'
        done
        [ -z "$(find -L "$path" -maxdepth 0 ! -perm -1000 '(' -perm -0002 -o -perm -0020 \
            ! -gid 0 ! -gid "$group" ')' 2>/dev/null)" ] || refuse 'is open to other accounts'
        [ "$path" != / ] || break
        path=$(dirname "$path")
    done
done
"""


@dataclasses.dataclass(frozen=True)
class Workspace:
    """
    A colcon workspace on the robot.

    :param installed: prefix of each package in the install space.
    :param sources: folder of each package below ``src`` (or the workspace's folder).
    :param links: files and folders of the workspace, outside the install space, that the install
        space refers to by links or by the paths that ``--symlink-install`` writes.
    :param outside: the same outside the workspace: they cannot be sent.
    :param linked: folders with packages outside the workspace that links below ``src`` lead to, if
        the install space refers to them.
    :param linked_sources: all such folders.
    :param compiled: architectures (in the form of ``uname -m``) of the shared libraries and
        compiled programs in the install space, each with one file; empty if all is Python.
    :param python: version in the paths of the install space (``python3.12``), '' for none.
    """

    root: Path
    installed: Mapping[str, Path]
    sources: Mapping[str, Path]
    links: tuple[Path, ...] = ()
    outside: tuple[Path, ...] = ()
    linked: tuple[Path, ...] = ()
    linked_sources: tuple[Path, ...] = ()
    compiled: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    python: str = ''

    @property
    def packages(self) -> Mapping[str, Path]:
        """All packages: the prefix of each, or else the source folder."""
        return {**self.sources, **self.installed}

    @property
    def python_only(self) -> bool:
        """Whether the workspace has no compiled files, as far as can be seen."""
        if self.installed:
            return not self.compiled
        return all(_build_type(path) == 'ament_python' for path in self.sources.values())


_inspecting = threading.Lock()
#: The time until which a workspace is shared, and the workspace, by its root.
_inspected: dict[Path, tuple[float, Workspace]] = {}


@dataclasses.dataclass(frozen=True)
class WorkspacePlan:
    """
    How a workspace gets to a machine.

    :param source: folder on the robot; ``target`` is the same path on the machine.
    :param includes: rsync patterns with precedence over ``excludes``.
    :param linked: folders outside the workspace that are sent too, to the same paths.
    :param commands: commands that build it there after the sync; none if it is sent built.
    :param setup: script to source on the machine, after ROS's script.
    :param reason: why it is built there, '' if it is sent built.
    """

    source: Path
    target: str
    includes: tuple[str, ...]
    excludes: tuple[str, ...]
    linked: tuple[Path, ...]
    commands: tuple[Command, ...]
    setup: str
    reason: str = ''


def inspected(path: str | os.PathLike[str]) -> Workspace:
    """
    Return what ``inspect`` returned in the last ``SHARED`` seconds, or call it.

    All machines of a launch are checked, and then prepared, at about the same time.

    :raises WorkspaceError: see ``inspect``.
    """
    root = _absolute(path)
    with _inspecting:
        until, workspace = _inspected.get(root, (0.0, None))
        if workspace is None or time.monotonic() > until:
            workspace = inspect(root)
            _inspected[root] = time.monotonic() + SHARED, workspace
        return workspace


def inspect(path: str | os.PathLike[str]) -> Workspace:
    """
    Read a workspace; 10,000 files take about a tenth of a second.

    :raises WorkspaceError: there is no such folder, it contains no ROS package, or a file in it
        cannot be read.
    """
    try:
        return _inspect(_absolute(path))
    except OSError as error:
        raise WorkspaceError(f"{error.filename} can't be read: {error.strerror}",
                             'give this user the right to read it') from error


def _inspect(root: Path) -> Workspace:
    if not root.is_dir():
        raise WorkspaceError(f'{root} is no folder', 'ros_workspace= names a colcon workspace')
    install = root / 'install'
    installed = dict(_installed(install))
    sources = dict(_sources(_source_folder(root)))
    if not installed and not sources:
        hint = 'it needs install/ (from colcon build) or src/ with packages'
        if (root.parent / 'install').is_dir():
            hint = f'did you mean {root.parent}?'
        raise WorkspaceError(f'{root} is no colcon workspace: no ROS package in it', hint)
    way_out = _ways_out(root)
    ways = {way_out(folder) for folder in sources.values()}
    linked = tuple(sorted({Path(os.path.realpath(way)) for way in ways if way is not None}))
    return _inspect_installed(
        Workspace(root, installed, sources, linked_sources=linked), way_out)


def _absolute(path: str | os.PathLike[str]) -> Path:
    return Path(os.path.abspath(os.path.expanduser(path)))


def _source_folder(root: Path) -> Path:
    return root / 'src' if (root / 'src').is_dir() else root


def prefixes(path: Optional[str]) -> list[str]:
    """Return the ament prefixes of a workspace's install space; none for no workspace."""
    if path is None:
        return []
    return list(dict.fromkeys(
        str(prefix) for _, prefix in _installed(_absolute(path) / 'install')))


def sourced(path: Optional[str], environment: Mapping[str, str]) -> Mapping[str, str]:
    """
    Return an environment with a workspace sourced in addition.

    :raises CommandError: the workspace's setup script fails.
    """
    entries = set(environment.get('AMENT_PREFIX_PATH', '').split(os.pathsep))
    missing = [prefix for prefix in prefixes(path) if prefix not in entries]
    script = _absolute(path or '') / 'install' / 'local_setup.sh'
    if not missing or not script.is_file():
        return environment
    command = Command.script(
        f'. {shlex.quote(str(script))} >&2\nexec env -0', what=f'source {script}')
    lines = process.run(
        dataclasses.replace(command, environment=environment), timeout=30.0).stdout.split('\0')
    return dict(line.split('=', 1) for line in lines if '=' in line)


def dependencies(*paths: str | os.PathLike[str]) -> list[str]:
    """
    Return the rosdep keys of the workspaces' dependencies outside themselves, sorted.

    What FogROS2's own packages need is sent with them (``modules``).

    :raises WorkspaceError: a manifest cannot be read.
    """
    manifests: dict[str, Path] = {}
    for path in paths:
        root = _absolute(path)
        for name, folder in _sources(_source_folder(root)):
            manifests.setdefault(name, folder / 'package.xml')
        for name, prefix in _installed(root / 'install'):
            manifests.setdefault(name, prefix / 'share' / name / 'package.xml')
    needed: set[str] = set()
    for name, manifest in manifests.items():
        if name not in own_packages() and manifest.is_file():
            needed |= {*_field_texts(manifest, *_ALL)}
    return sorted(needed - {''} - set(manifests))


def run_dependencies(manifest: Path) -> set[str]:
    """
    Return a package's run-time dependencies (``depend``, ``exec_depend``) for ROS 2 Jazzy.

    :raises WorkspaceError: the manifest cannot be read.
    """
    return {*_field_texts(manifest, *_RUN)} if manifest.is_file() else set()


def plan(
    workspace: Workspace, machine: HostFacts, robot: HostFacts, *, ros_setup: Sequence[str],
    can_build: bool, name: str,
) -> WorkspacePlan:
    """
    Decide whether a machine gets the install space, or the sources to build.

    :param ros_setup: scripts to source on the machine before ROS programs run.
    :param can_build: whether the machine will have colcon and rosdep.
    :param name: the machine's name, for messages.
    :raises WorkspaceError: it must be built there, and cannot be.
    """
    root = workspace.root
    # setup.sh also sources the robot's underlays, which may have other paths on the machine.
    setup = f'{root}/install/local_setup.sh'
    reason = _why_build(workspace, machine, robot)
    if not reason:
        if workspace.outside:
            raise WorkspaceError(
                f'{root}/install has a link to {workspace.outside[0]}, which is not sent',
                'build without --symlink-install, or move that file into the workspace')
        includes = tuple(_include(workspace.links, root))
        return WorkspacePlan(
            root, str(root), includes,
            (*EXCLUDES, '/log', *(f'/{top}/***' for top in ('build', 'src'))), workspace.linked,
            (), setup)
    if not workspace.sources:
        raise no_sources(workspace, name, reason)
    if not can_build:
        raise WorkspaceError(
            f"{root} would have to be built on machine '{name}' ({reason}), which has no colcon",
            'choose a machine with the processor, system and ROS 2 that it was built for, or one '
            'with colcon and rosdep' if workspace.installed else 'run colcon build here first')
    return WorkspacePlan(
        root, str(root), (), (*EXCLUDES, *(f'/{top}' for top in BUILT)), workspace.linked_sources,
        (_build(workspace, ros_setup),), setup, reason)


def moved(
    ways: Sequence[WorkspacePlan], environment: Mapping[str, str], folder: str, name: str,
) -> tuple[tuple[WorkspacePlan, ...], dict[str, str]]:
    """
    Return plans and variables with the workspaces below a folder of the machine.

    An install space without links can be moved: programs find it by the variables.

    :raises WorkspaceError: a workspace has links, or must be built on the machine.
    """
    roots = [way.target for way in ways]
    for way in ways:
        if way.commands or way.includes or way.linked:
            why = way.reason or 'its install space was built with --symlink-install'
            raise WorkspaceError(f"{way.source} can't go to machine '{name}' as it is: {why}",
                                 'there it has to be complete: colcon build, without links')

    def there(entry: str) -> str:
        return f'{folder}{entry}' if any(
            entry == root or entry.startswith(f'{root}/') for root in roots) else entry

    return tuple(dataclasses.replace(way, target=there(way.target)) for way in ways), {
        key: os.pathsep.join(map(there, value.split(os.pathsep)))
        for key, value in environment.items()}


def no_sources(workspace: Workspace, name: str, reason: str) -> WorkspaceError:
    """Return the error for an install space that does not run on a machine, without sources."""
    return WorkspaceError(
        f"{workspace.root} can't go to machine '{name}' as it is ({reason}), and has no src/ to "
        'build', 'keep the sources in the workspace, or use a machine like this one')


def transfer(
    shell: Shell, ways: Sequence[WorkspacePlan], *, timeouts: Timeouts, owned: bool = True,
    cancel: Optional[threading.Event] = None,
    on_progress: Optional[Callable[[int, int], None]] = None,
    before_build: Callable[[], object] = lambda: None,
) -> str:
    """
    Send workspaces to the same paths on a machine, and build them if necessary.

    :param ways: the workspaces, in the order in which they are sourced.
    :param owned: see ``make_folder``.
    :param on_progress: callback with the bytes sent and the total bytes.
    :param before_build: returns when the tools for the build are installed.
    :returns: what was done, in a few words.
    """
    linked = dict.fromkeys(folder for way in ways for folder in way.linked)
    for target in sorted((*(way.target for way in ways), *map(str, linked))):
        shell.run(make_folder(target, owned=owned), timeout=timeouts.command, cancel=cancel)
    sync = functools.partial(
        shell.sync, timeout=timeouts.sync, cancel=cancel, on_progress=on_progress)
    reports = [retried(functools.partial(
        sync, way.source, way.target, includes=way.includes, excludes=way.excludes))
        for way in ways]
    reports += [retried(functools.partial(sync, folder, str(folder), excludes=EXCLUDES))
                for folder in linked]
    if any(way.commands for way in ways):
        before_build()
    for command in [command for way in ways for command in way.commands]:
        shell.run(command, timeout=timeouts.build, cancel=cancel)
    sent = (f'{sum(report.files for report in reports)} files, '
            f'{size(sum(report.bytes for report in reports))}')
    return ', '.join([sent, *(
        f'built there: {way.reason}' for way in ways if way.commands)])


def make_folder(target: str, *, owned: bool) -> Command:
    """
    Return the command that makes a folder, as root where the login user may not.

    :param owned: whether the launch owns the machine; else it may have accounts of others.
    """
    path = shlex.quote(target)
    script = (f'[ -w {path} ] || mkdir -p {path} 2>/dev/null || '
              f'sudo -n sh -ec {shlex.quote(_AS_ROOT)} sh {path} "$(id -u):$(id -g)"')
    if not owned:  # again at the end: in a folder such as /tmp, another account may be faster
        check = f'sh -c {shlex.quote(_OF_OTHERS)} sh {path}'
        script = f'{check} || exit\n{script} || exit\n{check}'
    return Command.script(script, what='make a folder for the workspace')


def _why_build(workspace: Workspace, machine: HostFacts, robot: HostFacts) -> str:
    """Return why the install space cannot be used on a machine, '' if it can."""
    if not workspace.installed:
        return 'it is not built'
    if workspace.compiled:
        reason = why_not_on(workspace, machine.architecture)
        if reason:
            return reason
        if (machine.system, machine.release) != (robot.system, robot.release):
            return (f'built on {robot.system} {robot.release}, there it is '
                    f'{machine.system} {machine.release}')
        if (DISTRO in machine.ros) != (DISTRO in robot.ros):
            return f'compiled against ROS 2 {DISTRO}, which only one of the two has'
    here = {f'python{p.version[0]}.{p.version[1]}' for p in machine.pythons}
    if workspace.python and workspace.python not in here:
        return f'built for {workspace.python}, which is not there'
    return ''


def why_not_on(workspace: Workspace, architecture: str) -> str:
    """Return why the install space does not run on an architecture, '' if it does."""
    return next((f'{path.relative_to(workspace.root)} is built for {built}, there it is '
                 f'{architecture}' for built, path in workspace.compiled.items()
                 if built != architecture), '')


def _build(workspace: Workspace, ros_setup: Sequence[str]) -> Command:
    """Return the command of colcon, for the login user on the machine."""
    root = shlex.quote(str(workspace.root))
    below = 'src' if (workspace.root / 'src').is_dir() else '.'
    source = ''.join(f'. {shlex.quote(script)}\n' for script in ros_setup)
    return Command.script(
        # the user's own defaults on that computer may put the packages elsewhere
        f'{source}export COLCON_DEFAULTS_FILE=/dev/null\ncd {root}\nbelow={below}\n{_CLEAN}'
        # each compiler needs gigabytes of memory
        f'colcon build --base-paths {below} --parallel-workers "$(nproc)" '
        '--event-handlers console_cohesion+ --cmake-args -DCMAKE_BUILD_TYPE=Release\n',
        what='build the workspace')


def _installed(install: Path) -> Iterator[tuple[str, Path]]:
    """Yield the packages of an isolated or merged install space, from the ament index."""
    if not install.is_dir():
        return
    for prefix in (install, *sorted(p for p in install.iterdir() if p.is_dir())):
        index = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
        if index.is_dir():
            for marker in sorted(index.iterdir()):
                yield marker.name, prefix


def _sources(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield source packages like colcon: none below another package or a COLCON_IGNORE."""
    try:
        names = set(os.listdir(folder))
    except OSError:
        return
    if {'COLCON_IGNORE', 'AMENT_IGNORE', 'CATKIN_IGNORE'} & names:
        return
    if 'package.xml' in names:
        name = (_parsed(folder / 'package.xml').findtext('name') or '').strip()
        if name:
            yield name, folder
        return
    for entry in sorted(names - _SKIPPED - set(BUILT)):
        path = folder / entry
        if path.is_dir() and not entry.startswith('.'):
            yield from _sources(path)


def _parsed(manifest: Path) -> ElementTree.Element:
    try:
        return ElementTree.parse(manifest).getroot()
    except (ElementTree.ParseError, OSError) as error:
        raise WorkspaceError(f'{manifest} is no package manifest: {error}',
                             'correct it, or put a COLCON_IGNORE beside it') from error


def _field_texts(manifest: Path, *tags: str) -> Iterator[str]:
    """Yield the texts of a manifest's elements with these tags whose condition is true."""
    for element in _parsed(manifest).iter():
        if element.tag in tags and _is_true(element.get('condition'), manifest):
            yield (element.text or '').strip()


def _is_true(condition: Optional[str], manifest: Path) -> bool:
    if condition is None:
        return True
    from catkin_pkg.condition import evaluate_condition  # slow, and few manifests need it
    try:
        return bool(evaluate_condition(condition, {**os.environ, **_ROS}))
    except ValueError as error:
        raise WorkspaceError(f'{manifest}: {error}', 'such as condition="$ROS_VERSION == 2"'
                             ) from error


def _build_type(folder: Path) -> str:
    return next(_field_texts(folder / 'package.xml', 'build_type'), '')


def _inspect_installed(
    workspace: Workspace, way_out: Callable[[Path], Optional[Path]],
) -> Workspace:
    """Return a workspace with what a walk through its install space and its links finds."""
    root, install = workspace.root, workspace.root / 'install'
    links: set[Path] = set()
    outside: set[Path] = set()
    linked: set[Path] = set()
    seen: set[Path] = set()
    compiled: dict[str, Path] = {}
    python = ''
    todo = [install]
    while todo:
        folder = todo.pop()
        reached: list[Path] = []
        for entry in _files(folder):
            if entry.is_symlink():
                with contextlib.suppress(FileNotFoundError):  # deleted meanwhile
                    reached.append(_target(entry.path))
            elif entry.name.endswith(('.egg-link', '.pth')) and entry.is_file():
                with contextlib.suppress(FileNotFoundError):
                    reached.extend(written_paths(Path(entry.path)))
            elif '/lib/' in entry.path or '/bin/' in entry.path or _LIBRARY.search(entry.name):
                _note_compiled(entry.path, compiled)
            if not python and '/site-packages/' in entry.path:
                python = entry.path.split('/site-packages/')[0].rpartition('/')[2]
        for path in reached:
            if path in seen or path.is_relative_to(install):
                continue
            seen.add(path)
            way = way_out(path) if path.is_relative_to(root) else path
            if way is None:
                links.add(path)
                todo.append(path)
                _note_compiled(str(path), compiled)
                continue
            real = Path(os.path.realpath(way))
            folders = [each for each in workspace.linked_sources if real.is_relative_to(each)]
            if folders:
                linked.update(folders)
                links.update([way] if way.is_relative_to(root) else [])
                todo.append(path)
                _note_compiled(str(path), compiled)
            elif not real.is_relative_to('/opt/ros') and not real.is_relative_to('/usr'):
                # The machine has ROS and the system too.
                outside.add(real)
    return dataclasses.replace(
        workspace, links=tuple(sorted(links)), outside=tuple(sorted(outside)),
        linked=tuple(sorted(linked)), compiled=compiled, python=python)


def _ways_out(root: Path) -> Callable[[Path], Optional[Path]]:
    """Return a function of a path in a workspace: the first link of it that leads out, or None."""
    top = os.path.realpath(root)

    @functools.cache
    def leads_out(path: Path) -> bool:
        return path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(top)

    def way_out(path: Path) -> Optional[Path]:
        way = root
        for part in path.relative_to(root).parts:
            way /= part
            if leads_out(way):
                return way
        return None

    return way_out


def _files(folder: Path) -> Iterator[os.DirEntry[str]]:
    """Yield all files and links below a folder; none if the folder does not exist."""
    try:
        entries = list(os.scandir(folder))
    except (NotADirectoryError, FileNotFoundError):
        return
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            if entry.name not in _SKIPPED:
                yield from _files(Path(entry.path))
        else:
            yield entry


def _target(link: str) -> Path:
    """Return the target of a link, which may be a link too."""
    return Path(os.path.normpath(os.path.join(os.path.dirname(link), os.readlink(link))))


def written_paths(file: Path) -> Iterator[Path]:
    """Yield the folders in a file that a development install writes instead of a link."""
    for line in file.read_text(errors='replace').splitlines():
        if line.startswith('/') and os.path.isdir(line):
            yield Path(os.path.normpath(line))


def _note_compiled(path: str, compiled: dict[str, Path]) -> None:
    """Add the architecture of a file if it is a compiled program or shared library."""
    if path.endswith(('.py', '.sh', '.txt', '.xml', '.yaml', '.pyc')) or not os.path.isfile(path):
        return
    header = b''
    with contextlib.suppress(FileNotFoundError), open(path, 'rb') as file:
        header = file.read(20)
    if header[:4] == b'\x7fELF':
        number = int.from_bytes(header[18:20], 'little')
        compiled.setdefault(_ELF_MACHINES.get(number, f'processor {number}'), Path(path))


def _include(paths: Sequence[Path], root: Path) -> Iterator[str]:
    """Yield rsync patterns that include paths, with their parents first."""
    seen: set[Path] = set()
    for path in paths:
        relative = path.relative_to(root)
        for parent in reversed(relative.parents[:-1]):
            if parent not in seen:
                seen.add(parent)
                yield _pattern(parent, '/')
        if path.is_dir() and not path.is_symlink():
            yield _pattern(relative, '/')
            yield _pattern(relative, '/***')
        else:
            yield _pattern(relative)


def _pattern(relative: Path, suffix: str = '') -> str:
    """Return an rsync pattern in which the characters of a path stand for themselves."""
    name = str(relative)
    if re.search(r'[*?[]', name + suffix):
        # in a pattern without wildcards, a backslash needs none
        name = re.sub(r'[\\*?[]', r'\\\g<0>', name)
    return f'/{name}{suffix}'


def find_workspaces(environment: Mapping[str, str]) -> list[str]:
    """
    Return the sourced workspaces, the last one first.

    An install space is a folder with colcon's marker beside a ``src`` folder. An installed
    distribution has no ``src``. ROS 2 that was built from source is not a workspace of the user.
    """
    roots: dict[str, None] = {}
    for variable in ('COLCON_PREFIX_PATH', 'AMENT_PREFIX_PATH'):
        for entry in environment.get(variable, '').split(os.pathsep):
            # An isolated install space has a prefix for each package.
            for folder in (Path(entry), Path(entry).parent) if entry else ():
                marked = (folder / '.colcon_install_layout').is_file()
                if marked and (folder.parent / 'src').is_dir() and not _is_ros(folder):
                    roots[str(folder.parent)] = None
    return list(roots)


def underlays(workspace: Optional[str], chain: Sequence[str]) -> tuple[str, ...]:
    """
    Return the underlays of a workspace that is sent.

    :param chain: all sourced workspaces; those before the workspace are its overlays.
    """
    if workspace is None:
        return ()
    return tuple(chain[chain.index(workspace) + 1:] if workspace in chain else chain)


def left_behind(environment: Mapping[str, str], travelling: Sequence[str]) -> list[str]:
    """Explain for each sourced prefix of the user that is not sent why it stays here."""
    reasons: dict[str, str] = {}
    chain = find_workspaces(environment)
    for entry in environment.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        above = next((root for root in chain if Path(entry).is_relative_to(root)), None)
        if above in travelling or not entry:
            continue
        if above is not None:
            reasons[above] = 'it is above the workspace that the launch names'
        elif not any(_is_ros(Path(top)) for top in (entry, os.path.dirname(entry))) \
                and not entry.startswith(('/opt/ros/', '/usr')) and entry != sys.prefix:
            reasons[entry] = 'it is no workspace with src and install'
    return [f'{path} stays here: {why}' for path, why in reasons.items()]


def _is_ros(install: Path) -> bool:
    """Return whether a merged or isolated install space is a ROS distribution."""
    name = 'ros_environment'
    return any((prefix / 'share' / name).is_dir() for prefix in (install, install / name))

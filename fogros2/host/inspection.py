# SPDX-License-Identifier: Apache-2.0
"""Inspect a computer in one round trip: a script that prints facts, a dataclass for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
import ipaddress
from typing import Optional

from fogros2.model import Command
from fogros2.untrusted import matched, number, PATH

DISTRO = 'jazzy'
MIN_PYTHON = (3, 10)

_PROBE = r"""
PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
ID=unknown VERSION_ID=
[ ! -r /etc/os-release ] || . /etc/os-release
echo "os $ID $VERSION_ID"
echo "arch $(uname -m)"
echo "user $(id -un)"
echo "home $HOME"
echo "libc $(getconf GNU_LIBC_VERSION 2>/dev/null || echo other 0)"
# in a pod the shell runs as root what asks for it, without sudo
if [ "$(id -u)" = 0 ] || [ -n "$FOGROS2_ROOT" ] || sudo -n true 2>/dev/null; then echo root; fi
seen=
for x in /usr/bin/python3 "$(command -v python3)" /usr/bin/python3.1[0-9] \
        /usr/local/bin/python3.1[0-9]; do
    [ -x "$x" ] || continue
    r=$(readlink -f "$x")
    case " $seen " in *" $r "*) continue ;; esac
    seen="$seen $r"
    # importlib.util would take half as long again as all of this
    "$x" -ISc 'import sys
from importlib.machinery import PathFinder as f
print("python", *sys.version_info[:2], int(f.find_spec("venv") is not None), sys.executable)'
done
for p in rsync ip wg wireguard-go nft apt-get colcon rosdep sudo; do
    command -v $p >/dev/null && echo "program $p"
done
for d in /opt/ros/* "$@"; do
    [ -r "$d/setup.sh" ] || continue
    case $d in
        /opt/ros/*) n=${d##*/} ;;
        # ROS 2 built from sources may be in any folder
        *) n=$(sed -n 's/^export ROS_DISTRO=//p' \
            "$d"/share/ros_environment/environment/*ros_distro.sh 2>/dev/null) ;;
    esac
    [ -n "$n" ] || continue
    echo "ros $n $d"
    for r in "$d"/share/ament_index/resource_index/rmw_typesupport/*; do
        [ ! -e "$r" ] || echo "rmw $n ${r##*/}"
    done
done
[ ! -d /sys/module/wireguard ] && ! modprobe -nq wireguard 2>/dev/null || echo kernel-wireguard
df -Pk "$HOME" 2>/dev/null | while read -r _ _ _ free _; do echo "disk $free"; done | tail -n 1
ip -4 route show 2>/dev/null | while read -r to _; do echo "route $to"; done
if read -r b 2>/dev/null </proc/sys/kernel/random/boot_id && n=$(readlink /proc/self/ns/net); then
    echo "network $b $n"
fi
for k in "$HOME"/.local/share/fogros2/*/complete; do
    [ ! -e "$k" ] || { k=${k%/complete}; echo "installed ${k##*/}"; }
done
for e in "$@"; do
    [ -d "$e" ] || continue
    if [ -e "$e/pyvenv.cfg" ]; then
        # only a development install has it elsewhere; each start of Python is what takes long here
        for w in "$e"/lib/python3*/site-packages/fogros2; do
            if [ -d "$w" ]; then
                "$e/bin/python" -ISc '' 2>/dev/null || continue 2
            else
                w=$("$e/bin/python" -c 'import importlib.util as u
s = u.find_spec("fogros2")
print(*s.submodule_search_locations if s else ())' 2>/dev/null) || continue 2
            fi
            [ -z "$w" ] || [ ! -r "$w/__init__.py" ] || echo fogros2
        done
    else
        for w in "$e"/lib/python3*/site-packages/fogros2/__init__.py; do
            [ ! -r "$w" ] || echo fogros2
        done
    fi
    s=$(cat "$e"/lib/python3*/site-packages/*2[-_]*.dist-info/RECORD "$e"/share/*/package.xml \
        2>/dev/null | cksum)
    echo "environment ${s% *}-${s#* } $e"
done
exit 0
"""


@dataclasses.dataclass(frozen=True)
class Python:
    """
    An interpreter on a machine.

    :param venv: whether it can create virtual environments (without pip).
    """

    path: str
    version: tuple[int, int]
    venv: bool


@dataclasses.dataclass(frozen=True)
class HostFacts:
    """
    Facts about a computer, collected in one round trip.

    :param system: ``ID`` of os-release (ubuntu, debian, ...); ``release`` is its ``VERSION_ID``.
    :param architecture: output of ``uname -m``.
    :param libc: such as ``glibc 2.36``.
    :param root: whether commands can run as root: as login user, or by sudo without a password.
    :param ros: prefixes of ROS 2 by distribution; ``rmw`` has the middlewares of each.
    :param free_bytes: free space on the home folder's disk, None if unknown.
    :param routes: IPv4 networks with a route, in CIDR form or as addresses.
    :param network: identifies the network of its processes, '' if unknown: the boot id of the
        kernel and the network namespace.
    :param installed: folders that earlier launches have installed completely.
    :param environments: by requested prefix that exists and works, a signature of its packages.
    :param fogros2: whether one of them has this package.
    """

    system: str = 'unknown'
    release: str = ''
    architecture: str = ''
    user: str = 'root'
    home: str = '/root'
    libc: str = ''
    root: bool = False
    pythons: tuple[Python, ...] = ()
    programs: frozenset[str] = frozenset()
    ros: Mapping[str, str] = dataclasses.field(default_factory=dict)
    rmw: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    kernel_wireguard: bool = False
    free_bytes: Optional[int] = None
    routes: tuple[str, ...] = ()
    network: str = ''
    installed: frozenset[str] = frozenset()
    environments: Mapping[str, str] = dataclasses.field(default_factory=dict)
    fogros2: bool = False

    @property
    def python(self) -> Optional[Python]:
        """The interpreter for the agent: the first one that is new enough."""
        return next((p for p in self.pythons if p.version >= MIN_PYTHON), None)

    def has_rmw(self, name: str) -> bool:
        """Return whether ROS 2 itself is installed, with that middleware."""
        return name in self.rmw.get(DISTRO, ())

    @property
    def name(self) -> str:
        """The system's name for messages."""
        return f'{self.system} {self.release} {self.architecture}'


def probe(environments: Sequence[str] = ()) -> Command:
    """
    Return the command that inspects a computer, for :func:`parse_facts`.

    :param environments: prefixes to look for: virtual environments, ROS 2, overlays.
    """
    return Command(('sh', '-c', _PROBE, 'probe', *environments), what='look at the machine')


def parse_facts(output: str) -> HostFacts:
    """
    Parse the output of :func:`probe`; ignore other lines in it.

    :raises InvalidMessage: a value is not a number, or the home is no path.
    """
    values: dict[str, list[str]] = {}
    for line in output.splitlines():
        key, _, value = line.partition(' ')
        values.setdefault(key, []).append(value)

    def one(key: str, default: str = '') -> str:
        return values.get(key, [default])[-1]

    def split(key: str, number: int) -> list[list[str]]:
        words = [value.split(' ', number - 1) for value in values.get(key, ())]
        return [each for each in words if len(each) == number]

    pythons = {path: Python(path, (number(major), number(minor)), venv == '1')
               for major, minor, venv, path in split('python', 4)}
    rmw: dict[str, tuple[str, ...]] = {}
    for distro, name in split('rmw', 2):
        rmw[distro] = (*rmw.get(distro, ()), name)
    system, release = (one('os', 'unknown').split() + [''])[:2]
    disk = one('disk')
    return HostFacts(
        system=system, release=release, architecture=one('arch'), user=one('user', 'root'),
        home=matched(PATH, one('home', '/root')), libc=one('libc'), root='root' in values,
        pythons=tuple(pythons.values()),
        programs=frozenset(values.get('program', ())), ros=dict(split('ros', 2)), rmw=rmw,
        kernel_wireguard='kernel-wireguard' in values,
        free_bytes=number(disk) * 1024 if disk.isdecimal() else None,
        routes=tuple(filter(_is_network, values.get('route', ()))),
        network=one('network'), installed=frozenset(values.get('installed', ())),
        environments={path: signature for signature, path in split('environment', 2)},
        fogros2='fogros2' in values)


def _is_network(text: str) -> bool:
    """Return whether a route leads to a network; others begin with a word such as default."""
    try:
        return bool(ipaddress.IPv4Interface(text))
    except ValueError:
        return False

# SPDX-License-Identifier: Apache-2.0
"""
Install what nodes need besides ROS 2: packages in launch files, and rosdep keys.

The keys are the packages of the launch's nodes, and what the sent packages declare
(``exec_depend``). pip's packages go into a separate folder, which Python searches last, so that
they replace no packages of the system, of ROS 2 or of this project (PEP 668). pip chooses versions
that fit the packages that the machine has.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import hashlib
import json
from pathlib import Path
import re
import shlex

from fogros2 import plan
from fogros2.errors import ConfigurationError
from fogros2.host import locked, modules
from fogros2.host.inspection import DISTRO, HostFacts
from fogros2.host.workspace import run_dependencies, Workspace
from fogros2.model import Command, MachineSpec
from fogros2.plugin_system import OWN_PACKAGES

#: Distributions that only this project's own wheels may install, and their modules.
OURS = tuple(locked.name_of(name) for name in (*OWN_PACKAGES, 'ros2_embedded'))
#: Name of a Debian package, with an optional architecture and version.
_APT = re.compile(r'[a-z0-9][a-z0-9+.-]+(:[a-z0-9-]+)?(=[A-Za-z0-9.+:~-]+)?')
#: A requirement begins with a name (PEP 508): neither an option nor a URL.
_PIP = re.compile(r'([A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9])?)\s*($|[\[@<>=!~;(,])')

_MISSING = """\
for name; do
    state=$(dpkg-query -W -f '${db:Status-Status} ${Version}' "${name%%=*}" 2>/dev/null) || state=
    case $name in
        *=*) [ "$state" = "installed ${name#*=}" ] || echo "$name" ;;
        *) [ "${state%% *}" = installed ] || echo "$name" ;;
    esac
done
"""
#: Prints the keys that are neither an installed ROS package nor an installed Debian package.
_UNKNOWN = r"""
left=()
for key; do
    IFS=:
    for prefix in $AMENT_PREFIX_PATH; do
        [ ! -e "$prefix/share/ament_index/resource_index/packages/$key" ] || continue 2
    done
    left+=("$key")
done
[ ${#left[@]} != 0 ] || exit 0
# one call for all: each takes a hundredth of a second
there=" $(dpkg-query -W -f '${Package}=${db:Status-Status} ' "${left[@]}" 2>/dev/null) "
for key in "${left[@]}"; do
    [[ $there = *" $key=installed "* ]] || echo "$key"
done
"""
#: Exit status if rosdep is not installed.
NO_ROSDEP = 4
#: rosdep downloads its lists once; it exits with 1 if a key has no rule.
_RESOLVE = f"""\
command -v rosdep >/dev/null || exit {NO_ROSDEP}
""" + """\
if [ ! -e "${ROS_HOME:-$HOME/.ros}/rosdep/sources.cache/index" ]; then
    [ -n "$ROSDEP_SOURCE_PATH" ] || [ -e /etc/ros/rosdep/sources.list.d/20-default.list ] \\
        || sudo -n "$(command -v rosdep)" init >&2 || exit 3
    rosdep update --rosdistro "$distro" >&2 || exit 3
fi
rosdep resolve --rosdistro "$distro" "$@" || [ $? = 1 ]
"""
#: Python runs this module at its start; it runs the system's module of the same name afterwards.
_LAST_IN_PATH = """\
import importlib.util, os, site, sys
from importlib.machinery import PathFinder
_here = os.path.dirname(os.path.abspath(__file__))
if sys.base_prefix == '/usr' != sys.prefix:
    # virtual environments of the system's Python get the packages of apt
    sys.path.append('/usr/lib/python3/dist-packages')
site.addsitedir(os.path.join(os.path.dirname(_here), 'site'))
_next = PathFinder.find_spec('sitecustomize', [p for p in sys.path if os.path.abspath(p) != _here])
if _next is not None:
    _next.loader.exec_module(importlib.util.module_from_spec(_next))
"""


#: Prints the versions of the packages that nodes find, as a constraints file of pip.
_CONSTRAINTS = """\
import re
from importlib import metadata
versions = {}
for one in metadata.distributions():
    # Debian appends '+', which no index has
    version = str(one.metadata['Version']).partition('+')[0]
    if one.metadata['Name'] and re.fullmatch('[0-9][0-9A-Za-z.]*', version):
        versions.setdefault(re.sub('[-_.]+', '-', one.metadata['Name']).lower(), version)
for item in sorted(versions.items()):
    print('=='.join(item))
"""
#: Runs pip, at first without sources: if nothing fits, it would build one version after another.
_RUN_PIP = """\
"$@" --only-binary :all: >pip.log 2>&1 || {
    # the versions that conflict are in the output that --quiet hides
    ! grep -E '\\(constraint\\)|^ERROR: Cannot' pip.log >&2 || exit 1
    "$@" --prefer-binary >pip.log
}
"""
#: Imports what requirements have installed: one module of each at least.
_IMPORT = """\
import importlib, os, re, sys
from importlib import metadata
# ONNX Runtime would tell Microsoft that it was imported
os.environ.setdefault('ORT_DISABLE_TELEMETRY', '1')
status = 0
for requirement in sys.argv[1:]:
    try:
        files = metadata.distribution(re.match('[A-Za-z0-9._-]+', requirement)[0]).files or ()
    except metadata.PackageNotFoundError:
        continue
    paths = [file.parts[:-1] if file.name == '__init__.py' else (file.name.partition('.')[0], )
             for file in files if file.name == '__init__.py'
             or file.suffix in ('.py', '.so') and len(file.parts) == 1]
    paths = [path for path in paths
             if path and path[0] not in ('..', 'test', 'tests', 'docs', 'examples')]
    # parts of a namespace, such as ruamel.yaml, have no module of one name
    least = min(map(len, paths), default=0)
    reasons = []
    for module in sorted({'.'.join(path) for path in paths if len(path) == least}):
        try:
            importlib.import_module(module)
            break
        except BaseException as error:
            reasons.append(f"'{module}' of {requirement} can't be imported there: "
                           f'{type(error).__name__}: {error}')
    else:
        if reasons:
            print(reasons[-1], file=sys.stderr)
            status = 1
sys.exit(status)
"""
#: Exits with 0 if pip can be used by one of the ways of ``modules.PIP``.
_ABLE = """\
python3 -m pip --version || ls "$VIRTUAL_ENV"/../wheels/pip-*.whl ||
    python3 -c 'import ensurepip, venv'
"""


def check_apt(name: str) -> str:
    """
    Check and return the name of a Debian package.

    :raises ConfigurationError: the name is invalid.
    """
    if not _APT.fullmatch(name):
        raise ConfigurationError(f'apt: {name!r} is no name of a Debian package',
                                 "such as 'libzbar0', one text for each package")
    return name


def check_pip(requirement: str) -> str:
    """
    Check and return a requirement for pip.

    :raises ConfigurationError: it names no package, or a package of this project.
    """
    match = _PIP.match(requirement)
    if match is None:
        raise ConfigurationError(f'pip: {requirement!r} names no Python package',
                                 "such as 'pyzbar>=0.1.9' or 'pyzbar @ https://...'")
    if locked.name_of(match[1]) in OURS:
        raise ConfigurationError(f"pip: '{match[1]}' is part of FogROS2, which brings it itself",
                                 'leave it out')
    return requirement


def keys(workspaces: Iterable[Workspace], packages: Iterable[str]) -> tuple[str, ...]:
    """
    Return the rosdep keys of what a machine needs besides the workspaces, sorted.

    What FogROS2's own packages need is sent with them (``modules``).

    :param packages: packages of the launch's nodes.
    """
    own: set[str] = set()
    names = set(packages)
    for workspace in workspaces:
        own |= set(workspace.packages)
        for name, prefix in workspace.installed.items():
            if name not in OWN_PACKAGES:
                names |= run_dependencies(prefix / 'share' / name / 'package.xml')
    return tuple(sorted(names - own - {''}))


def outside(names: Iterable[str], prefixes: Iterable[str]) -> tuple[str, ...]:
    """Return the keys without the ROS packages below some prefixes of this computer."""
    folders = [Path(prefix, 'share/ament_index/resource_index/packages') for prefix in prefixes]
    return tuple(name for name in names
                 if not any((folder / name).exists() for folder in folders))


def unknown(
    names: Sequence[str], environment: Mapping[str, str], setup: Sequence[str],
) -> Command:
    """Return the command that prints the keys whose packages a machine may lack."""
    return modules.among_nodes(
        environment, setup, f'set -- {shlex.join(names)}\n{_UNKNOWN}', 'look for dependencies')


def resolve(
    names: Sequence[str], environment: Mapping[str, str], setup: Sequence[str],
) -> Command:
    """Return the command that resolves rosdep keys, for ``resolved``."""
    return modules.among_nodes(
        environment, setup, f'distro={DISTRO}\nset -- {shlex.join(names)}\n{_RESOLVE}',
        'resolve rosdep keys')


def resolved(output: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    r"""
    Return the Debian packages and the pip packages in the output of ``resolve``.

    >>> resolved('#ROSDEP[a]\n#apt\nliba libb\n#ROSDEP[c]\n#pip\nc')
    (('liba', 'libb'), ('c',))
    """
    packages: dict[str, list[str]] = {'apt': [], 'pip': []}
    installer = ''
    for line in output.splitlines():
        if line.startswith('#'):
            installer = line[1:].strip()
        elif installer in packages:
            packages[installer] += line.split()
    return tuple(dict.fromkeys(packages['apt'])), tuple(dict.fromkeys(packages['pip']))


def missing(names: Iterable[str]) -> Command:
    """Return the command that prints the Debian packages that a machine lacks, each once."""
    return Command(('sh', '-c', _MISSING, 'sh', *dict.fromkeys(names)),
                   what='look for apt packages')


def pip_folder(spec: MachineSpec, facts: HostFacts, names: Sequence[str] = ()) -> str:
    """
    Return the path of a machine's folder with the packages of pip, below the user's home.

    It is equal for equal requirements, so that they are installed once.

    :param names: rosdep keys, some of which may need pip.
    """
    need = json.dumps([sorted(spec.pip), sorted(names), sorted(spec.apt),
                       *(python.version for python in facts.pythons)])
    digits = hashlib.sha256(need.encode()).hexdigest()[:16]
    return f'{facts.home}/.local/share/fogros2/pip-{digits}'


def with_pip_folder(folder: str, environment: Mapping[str, str]) -> dict[str, str]:
    """Return variables with which Python finds the packages of a folder after all others."""
    before = environment.get('PYTHONPATH')
    return {**environment, 'PYTHONPATH': f'{before}:{folder}/last' if before else f'{folder}/last'}


def able(environment: Mapping[str, str], setup: Sequence[str]) -> Command:
    """Return the command that fails if a machine has neither pip nor what installs it."""
    return modules.among_nodes(environment, setup, _ABLE, 'look for pip')


def fill(
    folder: str, requirements: Sequence[str], environment: Mapping[str, str],
    variables: Mapping[str, str], setup: Sequence[str], *, complete: bool = True,
) -> Command:
    """
    Return the command that installs packages into a folder by one call of pip.

    :param environment: variables of nodes there; ``variables`` has those of the launch file.
    :param complete: whether a later launch has nothing to add.
    """
    names = ' '.join(name.replace('-', '_') for name in OURS)
    script = modules.PIP.format(folder=shlex.quote(folder)) if requirements else (
        f'set -e\nmkdir -p {shlex.quote(folder)}\ncd {shlex.quote(folder)}\n')
    script += f'mkdir -p last\nprintf %s {shlex.quote(_LAST_IN_PATH)} >last/sitecustomize.py\n'
    if requirements:
        script += (f'python3 -c {shlex.quote(_CONSTRAINTS)} >constraints.txt\n'
                   f'set -- "$@" --verbose --constraint constraints.txt {shlex.join(requirements)}'
                   f'\n{_RUN_PIP}')
    script += (
        'rm -rf pip pip.log\n'
        f'for name in {names}; do [ ! -e "site/$name" ] || {{\n'
        "    echo \"one of the packages brings '$name', which is part of FogROS2\" >&2\n"
        '    rm -rf site; exit 1; }\n'
        'done\n'
        f'python3 -c {shlex.join([_IMPORT, *requirements])} || {{ rm -rf site; exit 1; }}\n'
        f"{': >complete' if complete else ':'}\n")
    return modules.among_nodes(
        plan.extended(environment, variables), setup, script, 'install Python packages')

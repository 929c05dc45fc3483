# SPDX-License-Identifier: Apache-2.0
"""
Install Debian and Python packages on machines: what apt, rosdep and pip do there is here.

``install`` takes what nodes need besides ROS 2, and returns what it did. ``apt_install`` and
``pinned_install`` are the commands for packages that are known, ``image_script`` is for images.

Unless they are pinned, packages of pip go into a folder that Python searches last, so that they
replace no packages of the system, of ROS 2 or of this project (PEP 668). pip chooses versions that
fit the packages that the machine has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
import hashlib
import json
import os
import re
import shlex

from fogros2.errors import CommandError, PrerequisiteError
from fogros2.host import locked
from fogros2.host.dependencies import OURS
from fogros2.host.inspection import DISTRO, HostFacts
from fogros2.model import Bootstrap, Command, Result

#: Script that installs the Debian packages in some words for sh.
APT = """\
export DEBIAN_FRONTEND=noninteractive
attempts=0
until
    # a machine that has just booted runs apt by itself: wait for its locks
    tries=0
    until output=$(LC_ALL=C apt-get -q update 2>&1); do
        case $output in *'Could not get lock'*) ;; *) tries=300 ;; esac
        [ $((tries += 1)) -lt 300 ] || break
        sleep 1
    done
    # the installation shows whether a source is missed
    printf '%s\\n' "$output" >&2
    # repair an installation that was killed; apt waits for one that still runs. dpkg itself asks
    # about configuration files that the administrator has changed: they stay
    dpkg --force-confdef --force-confold --configure -a </dev/null || :
    apt-get -qy -o DPkg::Lock::Timeout=300 -o Dpkg::Options::=--force-confdef \\
        -o Dpkg::Options::=--force-confold install --no-install-recommends {packages}
do
    # 'update' exits with 0 without a network, which may need some seconds after the boot
    why=$(printf '%s\\n' "$output" | grep -E \\
        'Failed to fetch|Temporary failure|Could not (resolve|connect)' | tail -n 1)
    if [ -z "$why" ] || [ $((attempts += 1)) = 5 ]; then
        printf '%s\\n' "$why" >&2
        exit 100
    fi
    sleep 5
done
"""
#: Prints the installed packages of ROS 2, without those that are held.
_INSTALLED = ("dpkg-query -W -f '${db:Status-Want} ${db:Status-Status} ${Package}\\n' "
              f"'ros-{DISTRO}-*' 2>/dev/null | sed -n 's/^install installed //p'")
#: Prints the packages of ROS 2 that have an upgrade.
_UPGRADABLE = f"""\
LC_ALL=C apt-get -s --with-new-pkgs upgrade | sed -n 's/^Inst \\(ros-{DISTRO}-[^ ]*\\).*/\\1/p'
"""
#: Prints the Debian packages that are not installed.
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
#: Exits with 0 if pip can be used by one of the ways of ``_PIP``.
_ABLE = """\
python3 -m pip --version || ls "$VIRTUAL_ENV"/../wheels/pip-*.whl ||
    python3 -c 'import ensurepip, venv'
"""
#: Enters a folder while no other launch installs; exits with 0 if another one has completed it.
#: The user's pip.conf may ask for ``--user`` or a virtual environment, and pip refuses them here.
ENTER = """\
set -e
export PIP_USER=0 PIP_REQUIRE_VIRTUALENV=0
mkdir -p {folder}
before=$(umask)
umask 077  # another account that may read the file could lock it
exec 9>>{folder}/../.lock
umask "$before"
flock 9
mkdir -p {folder}
cd {folder}
[ ! -e complete ] || exit 0
"""
#: Removes old packages, and sets ``"$@"`` to the command of pip for the nodes' Python.
_PIP = ENTER + """\
rm -rf site
if python3 -m pip --version >/dev/null 2>&1; then
    set -- python3 -m pip
elif wheel=$(ls "$VIRTUAL_ENV"/../wheels/pip-*.whl 2>/dev/null); then
    # the sent wheel: Debian's venv has no pip
    set -- python3 "$wheel/pip"
else
    python3 -m venv --clear pip
    set -- pip/bin/python -m pip
fi
set -- "$@" install --quiet --no-compile --disable-pip-version-check --target site
"""
#: Debian packages of the shared libraries that the wheels of OpenCV and PyAV need.
_LIBRARIES = {'libGL.so.1': 'libgl1', 'libglib-2.0.so.0': 'libglib2.0-0',
              'libgthread-2.0.so.0': 'libglib2.0-0', 'libxcb.so.1': 'libxcb1'}


@dataclasses.dataclass(frozen=True)
class Needs:
    """
    What nodes need on a machine besides ROS 2.

    :param apt: Debian packages, ``pip`` requirements of pip; without them, nothing starts.
    :param keys: rosdep keys, which the nodes may not need.
    :param environment: variables of the nodes; ``setup`` has scripts to source.
    :param facts: facts of the machine, ``machine`` its name.
    :param able: whether Debian packages can be installed there.
    :param owned: whether the machine is the launch's own: others' packages are not upgraded.
    """

    machine: str
    facts: HostFacts
    able: bool
    apt: tuple[str, ...] = ()
    pip: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()
    environment: Mapping[str, str] = dataclasses.field(default_factory=dict)
    setup: tuple[str, ...] = ()
    owned: bool = True

    @property
    def folder(self) -> str:
        """
        The machine's folder with the packages of pip, below the user's home.

        It is equal for equal needs, so that they are installed once.
        """
        need = json.dumps([sorted(self.pip), sorted(self.keys), sorted(self.apt),
                           *(python.version for python in self.facts.pythons)])
        digits = hashlib.sha256(need.encode()).hexdigest()[:16]
        return f'{self.facts.home}/.local/share/fogros2/pip-{digits}'

    def with_folder(self, environment: Mapping[str, str]) -> dict[str, str]:
        """Return variables with which Python finds the packages of pip, after all others."""
        before = environment.get('PYTHONPATH')
        last = f'{self.folder}/last'
        return {**environment, 'PYTHONPATH': f'{before}:{last}' if before else last}

    def within(self, script: str, what: str) -> Command:
        """Return a command that runs a script in the nodes' environment."""
        return among_nodes(self.with_folder(self.environment), self.setup, script, what)


def install(
    needs: Needs, run: Callable[..., Result], warn: Callable[[str, str], object], *,
    always: bool = False,
) -> list[str]:
    """
    Install what nodes need, unless the machine has it; return what was done in a few words.

    If a key cannot be resolved, or its package cannot be installed, the result names it.

    :param run: function that runs a command on the machine.
    :param warn: takes a warning and its remedy where rosdep cannot be asked; the next launch asks
        again.
    :param always: make the folder of pip even if nothing was lacking, so that the next launch does
        not look again.
    :raises PrerequisiteError: what ``apt`` or ``pip`` names cannot be installed.
    """
    if os.path.basename(needs.folder) in needs.facts.installed:
        return []
    apt, pip, notes, complete = needs.apt, needs.pip, list[str](), True
    named = {name.partition('=')[0] for name in apt}
    keys = [key for key in needs.keys if key not in named]
    rest = run(unknown(needs, keys)).stdout.split() if keys else []
    if rest:
        reply = run(resolve(needs, rest), check=False)
        if reply.returncode == NO_ROSDEP and needs.able:
            rosdep = 'python3-rosdep2' if needs.facts.system == 'debian' else 'python3-rosdep'
            run(apt_install([rosdep]), check=False)
            reply = run(resolve(needs, rest), check=False)
        if reply.returncode == 0:
            more_apt, more_pip = resolved(reply.stdout)
            apt, pip = (*apt, *more_apt), (*pip, *more_pip)
            rest = re.findall(r"no rosdep rule for '([^']+)'", reply.stderr)
        elif needs.able:
            complete = False
            why = ' / '.join(reply.stderr.strip().splitlines()[-3:]) or 'it is not installed'
            warn(f"machine '{needs.machine}' may lack {', '.join(rest)}, as rosdep gave no "
                 f'answer: {why}',
                 "apt=['...'] or pip=['...'] of the machine installs what it lacks")
        if rest and complete:
            notes.append(f"the machine may lack {', '.join(rest)}")
    if pip and run(find_pip(needs), check=False).returncode != 0:
        if not needs.able:
            raise PrerequisiteError(
                f"machine '{needs.machine}' has no pip, which installs {', '.join(pip)}",
                'on the machine: apt-get install python3-venv')
        apt = (*apt, 'python3-venv')
    if apt:
        lacking = run(missing(apt)).stdout.split()
        asked_for = [name for name in lacking if name in needs.apt]
        if asked_for and not needs.able:
            raise lacks(needs.machine, asked_for)
        if lacking and not needs.able:
            notes.append(f"the machine lacks {', '.join(lacking)}")
        elif lacking:
            with _remedy('apt= of the machine and package.xml of the workspace name packages'):
                pinned = [name for name in apt if '=' in name]
                run(apt_install(lacking, pinned=pinned, upgrade=needs.owned))
            if not needs.owned and any(map(_of_ros, lacking)):
                check_upgrades(needs.machine, run, warn)
            notes.append(f"installed {', '.join(lacking)}")
    if not (apt or pip or always):
        return notes
    with _remedy('pip= of the machine and package.xml of the workspace name packages; the '
                 'versions that the machine has stay'):
        run(fill(needs, pip, complete=complete))
    if pip:
        notes.append(f"installed {', '.join(pip)} by pip")
    return notes


@contextlib.contextmanager
def _remedy(hint: str) -> Iterator[None]:
    """Give a command that fails in this block a remedy."""
    try:
        yield
    except CommandError as error:
        raise CommandError(
            error.command, error.result, error.where,
            error.hint or library_hint(str(error)) or hint) from error


def unknown(needs: Needs, keys: Sequence[str]) -> Command:
    """Return the command that prints the keys whose packages a machine may lack."""
    return needs.within(f'set -- {shlex.join(keys)}\n{_UNKNOWN}', 'look for dependencies')


def resolve(needs: Needs, keys: Sequence[str]) -> Command:
    """Return the command that resolves rosdep keys, for ``resolved``."""
    return needs.within(
        f'distro={DISTRO}\nset -- {shlex.join(keys)}\n{_RESOLVE}', 'resolve rosdep keys')


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


def find_pip(needs: Needs) -> Command:
    """Return the command that fails if a machine has neither pip nor what installs it."""
    return needs.within(_ABLE, 'look for pip')


def fill(needs: Needs, requirements: Sequence[str], *, complete: bool = True) -> Command:
    """
    Return the command that installs packages into the machine's folder by one call of pip.

    :param complete: whether a later launch has nothing to add.
    """
    names = ' '.join(name.replace('-', '_') for name in OURS)
    folder = shlex.quote(needs.folder)
    script = (_PIP if requirements else ENTER).format(folder=folder)
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
    return needs.within(script, 'install Python packages')


def pinned_install(
    lines: Sequence[str], folder: str, environment: Mapping[str, str], setup: Sequence[str],
) -> Command:
    """
    Return the command that installs distributions, pinned with hashes, into ``folder``/site.

    :param lines: of a requirements file, see ``locked``.
    """
    folder = shlex.quote(folder)
    return among_nodes(environment, setup, _PIP.format(folder=folder) + (
        f"printf '%s\\n' {shlex.join(lines)} >requirements.txt\n"
        f'"$@" {shlex.join(locked.OPTIONS)} --requirement requirements.txt || {{\n'
        f'    rm -rf {folder}; exit 1; }}\n'
        'rm -rf pip\n: >complete\n'),
        'install Python modules')


def able(mode: Bootstrap, facts: HostFacts) -> bool:
    """Return whether Debian packages can be installed on a machine."""
    return mode != 'none' and facts.root and 'apt-get' in facts.programs


def lacks(machine: str, packages: Sequence[str]) -> PrerequisiteError:
    """Return the error for a machine where Debian packages cannot be installed."""
    return PrerequisiteError(f"machine '{machine}' lacks {', '.join(packages)}",
                             f"on the machine: apt-get install {' '.join(packages)}")


def check_upgrades(
    machine: str, run: Callable[..., Result], warn: Callable[[str, str], object],
) -> None:
    """Warn of packages of ROS 2 that are older than those that were just installed."""
    older = run(Command(('sh', '-c', _UPGRADABLE), what='look for upgrades'), check=False)
    if names := older.stdout.split():
        warn(f"machine '{machine}' has older packages of ROS 2 beside the new ones, such as "
             f'{names[0]}: nodes may end with an undefined symbol',
             'on the machine: sudo apt-get --with-new-pkgs upgrade')


def apt_install(
    packages: Sequence[str], what: str = '', *, pinned: Sequence[str] = (), upgrade: bool = True,
) -> Command:
    """
    Return the command that installs Debian packages.

    :param what: by default the packages' names.
    :param pinned: packages with a version that stays.
    :param upgrade: with a package of ROS 2, upgrade those that are there.
    """
    return Command.script(
        APT.format(packages=_words(packages, pinned, upgrade=upgrade)), sudo=True,
        what=what or f"install {', '.join(packages)}")


def _of_ros(package: str) -> bool:
    return package.startswith(f'ros-{DISTRO}-')


def _words(packages: Sequence[str], pinned: Sequence[str] = (), *, upgrade: bool = True) -> str:
    """
    Return the packages to install, as words for sh.

    Each release of ROS 2's packages is built together, and they name no versions of each other:
    new ones fail with 'undefined symbol' beside old ones.
    """
    words = shlex.join(packages)
    if not (upgrade and any(map(_of_ros, packages))):
        return words
    named = [name.partition('=')[0] for name in (*packages, *pinned) if '=' in name]
    without = ''.join(f' | grep -vxF {shlex.quote(name)}' for name in dict.fromkeys(named))
    return f'{words} $({_INSTALLED}{without})'


def image_script(packages: Sequence[str], keys: Sequence[str]) -> str:
    """
    Return the script for ``sh -e``, as root in an image, that installs packages and rosdep keys.

    What a key needs of pip, a launch installs in the folder for that.
    """
    script = APT.format(packages=_words(packages))
    if keys:
        script += (f'distro={DISTRO}\nset -- {shlex.join(keys)}\nresolved=$(\n{_RESOLVE})\n'
                   "set -- $(echo \"$resolved\" | awk '/^#/ { apt = $1 == \"#apt\"; next } apt')\n"
                   + APT.format(packages='"$@"'))
    return script


def library_hint(text: str) -> str:
    """Return the remedy for a shared library that an import lacks, '' if it lacks none."""
    library = re.search(r'(\S+\.so[.\d]*): cannot open shared object file', text)
    if library is None:
        return ''
    package = _LIBRARIES.get(library[1])
    return f"give the machine apt=['{package}']" if package else (
        f'give the machine apt= with the package that has it: apt-file search {library[1]}')


def among_nodes(
    environment: Mapping[str, str], setup: Sequence[str], script: str, what: str,
) -> Command:
    """Return a command that runs a script in the nodes' environment."""
    # Variables of a launch file may be secrets, and every user can read command lines.
    lines = [f'export {name}={shlex.quote(value)}' for name, value in environment.items()]
    # A workspace may not be there yet.
    lines += [f'[ ! -f {shlex.quote(path)} ] || . {shlex.quote(path)}' for path in setup]
    # bash reads the whole group before it starts a program, which could read the rest.
    text = '\n'.join(['{', *lines, script, '} </dev/null', ''])
    return Command(('bash', '-s'), input=text.encode(), what=what)

# SPDX-License-Identifier: Apache-2.0
"""
Step 9: containers that run on a machine beside its nodes.

Pure: what ``docker run`` lines mean, and the commands by which podman or docker on the machine
runs them. Each container is started before the nodes; a process of the agent follows it, so that
it is seen in ``ros2 fog status``, what it says in ``ros2 fog logs``, and it ends with the nodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
import posixpath
import re
import shlex
from typing import Any, Union

from fogros2.errors import ConfigurationError
from fogros2.model import Command, NodeSpec

#: Label of a launch's containers, with its id.
LABEL = 'fogros2-launch'
#: Options of ``docker run`` that take no value.
_FLAGS = {
    'detach', 'disable-content-trust', 'help', 'init', 'interactive', 'no-healthcheck',
    'no-hosts', 'oom-kill-disable', 'privileged', 'publish-all', 'quiet', 'read-only', 'replace',
    'rm', 'sig-proxy', 'tty',
}
_SHORT_FLAGS = 'diPqt'
#: What the way containers are run here decides.
_OURS = {'-d', '--detach', '-i', '--interactive', '-t', '--tty', '--rm'}
_ENGINES = ('podman', 'docker')

# Finds the engine; as root, as the login user may not be in docker's group.
_ENGINE = """\
engine=; for each in podman docker; do
    ! command -v $each >/dev/null || { engine=$each; break; }
done
as_root=; [ "$(id -u)" = 0 ] || as_root='sudo -n'
"""
_RUN = _ENGINE + """\
name=$1 gpus=$2 image=$3; shift 3
$as_root $engine image inspect "$image" >/dev/null 2>&1 ||
    $as_root $engine pull -q "$image" >/dev/null
$as_root $engine rm -f "$name" >/dev/null 2>&1 || :
if [ -n "$gpus" ]; then
    if [ $engine = docker ]; then set -- --gpus "$gpus" "$@"
    else set -- --device "nvidia.com/gpu=$gpus" "$@"; fi
fi
$as_root $engine run -d --name "$name" "$@" >/dev/null
"""
# Passes its signal on as the engine's own stop, and the exit status of the container back.
_FOLLOW = _ENGINE + """\
trap '$as_root $engine stop -t 5 "$1" >/dev/null 2>&1' INT TERM
$as_root $engine logs -f "$1" & logs=$!
$as_root $engine wait "$1" >/dev/null & waiting=$!
wait $waiting || wait $waiting
wait $logs
status=$($as_root $engine inspect -f '{{.State.ExitCode}}' "$1")
$as_root $engine rm -f "$1" >/dev/null 2>&1
exit "$status"
"""
_REMOVE = _ENGINE + """\
[ -n "$engine" ] || exit 0
ids=$($as_root $engine ps -aq --filter "label=$1=$2")
[ -z "$ids" ] || $as_root $engine rm -f $ids >/dev/null
"""


@dataclasses.dataclass(frozen=True)
class Container:
    """
    A container, as ``docker run`` has it.

    :param options: words before the image, without those that are ours to say.
    :param gpus: 'all' or a number, '' for none.
    :param name: as the launch file has it, '' for none.
    """

    image: str
    options: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    gpus: str = ''
    name: str = ''


def described(
    image: str, *, command: Union[str, Sequence[str]] = (), ports: Sequence[str] = (),
    environment: Mapping[str, Any] = {}, volumes: Sequence[str] = (), gpus: Any = '',
    restart: str = '', name: str = '',
) -> str:
    """
    Return a ``docker run`` line for a container that is described in parts.

    :param ports: such as '8080:80'; ``volumes`` such as '/data:/data:ro', paths of the machine.
    :param restart: such as 'always', in the engine's words.
    """
    words = ['docker', 'run']
    words += [word for port in ports for word in ('-p', str(port))]
    words += [word for key, value in environment.items() for word in ('-e', f'{key}={value}')]
    words += [word for volume in volumes for word in ('-v', str(volume))]
    for option, value in (('--gpus', gpus), ('--restart', restart), ('--name', name)):
        words += [option, str(value)] if value else []
    rest = shlex.split(command) if isinstance(command, str) else command
    return shlex.join([*words, image, *rest])


def parse(line: str) -> Container:
    """
    Return what a ``docker run`` line says.

    ``sudo`` before it and what detaches it are taken off: both are ours to say.

    :raises ConfigurationError: it isn't one, or has no image.
    """
    def wrong(why: str) -> ConfigurationError:
        return ConfigurationError(
            f"add_docker_container: '{line}' {why}",
            "write 'docker run [options] image [command]', or give image= and the rest by name")

    try:
        words = shlex.split(line)
    except ValueError as error:
        raise wrong(f'is no command line: {error}') from error
    while words and (words[0] == 'sudo' or words[0] == '-n'):
        words.pop(0)
    if not words or posixpath.basename(words.pop(0)) not in _ENGINES:
        raise wrong('is no line of docker or podman')
    if words[:1] == ['container']:
        words.pop(0)
    if words[:1] != ['run']:
        raise wrong('runs nothing')
    options: list[str] = []
    found = {'--gpus': '', '--name': ''}
    at = 1
    while at < len(words) and words[at].startswith('-') and words[at] != '-':
        word = words[at]
        at += 1
        if word == '--':
            break
        name, equals, value = word.partition('=')
        if not word.startswith('--'):
            if set(word[1:]) <= set(_SHORT_FLAGS):
                options += ['-P'] if 'P' in word else []
                continue
            name, equals, value = word[:2], word[2:], word[2:].lstrip('=')
        if name in _OURS:
            continue
        if name.startswith('--') and name[2:] in _FLAGS:
            options.append(word)
            continue
        if not equals:
            if at >= len(words):
                raise wrong(f'has nothing after {word}')
            value = words[at]
            at += 1
        if name in found:
            found[name] = value
        else:
            options += [name, value]
    if at >= len(words):
        raise wrong('names no image')
    return Container(words[at], tuple(options), tuple(words[at + 1:]), found['--gpus'],
                     found['--name'])


def called(container: Container, number: int, launch: str) -> str:
    """Return how the engine calls a container; each launch's differ, on one computer too."""
    what = container.name or posixpath.basename(container.image).partition('@')[0]
    return f'fogros2-{launch}-{number}-' + re.sub(r'[^A-Za-z0-9_.-]', '-', what)[:40]


def find() -> Command:
    """Return what prints the machine's engine, nothing where it has none."""
    return Command.script(_ENGINE + 'echo $engine', what='look for podman or docker')


def install() -> Command:
    """Return what installs an engine."""
    return Command.script(
        'export DEBIAN_FRONTEND=noninteractive\napt-get update -q\n'
        'apt-get install -q -y --no-install-recommends podman', sudo=True, what='install podman')


def run(container: Container, number: int, launch: str) -> Command:
    """Return what starts a container, its image downloaded first if it isn't there."""
    name = called(container, number, launch)
    return Command(
        ('sh', '-ec', _RUN, 'sh', name, container.gpus, container.image,
         '--label', f'{LABEL}={launch}', *container.options, container.image,
         *container.command), what=f"start the container '{container.image}'")


def follow(container: Container, number: int, launch: str) -> NodeSpec:
    """Return the process that stands for a container that runs."""
    name = called(container, number, launch)
    return NodeSpec(
        id=f'container-{name}', name=name.split('-', 3)[3],
        arguments=('sh', '-c', _FOLLOW, 'sh', name), sigterm_timeout=15.0)


def remove(launch: str) -> Command:
    """Return what removes all containers of a launch."""
    return Command(('sh', '-ec', _REMOVE, 'sh', LABEL, launch), what='remove its containers')

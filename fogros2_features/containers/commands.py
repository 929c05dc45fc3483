# SPDX-License-Identifier: Apache-2.0
"""
Containers beside a machine's nodes, and nodes in container images; pure.

This module parses ``docker run`` lines, and returns the commands for podman or docker on the
machine. A launch starts the containers before the nodes. A process of the agent follows each
container: ``ros2 fog status`` shows it, ``ros2 fog logs`` shows its output, and it ends with the
nodes. A node in an image is also a process of the agent, which runs the container. Both take part
in the launch's DDS: see ``dds_options`` and ``dds_variables``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import itertools
import posixpath
import re
import shlex
from typing import Any, Union

from fogros2 import dds
from fogros2.errors import ConfigurationError, DdsError, did_you_mean
from fogros2.host.installer import APT
from fogros2.model import Command, NodeSpec, Text
from fogros2_features.containers import docker_lines, scripts

#: The feature's name.
NAME = 'containers'
#: Program in the agent's folder that follows a container; its arguments are the end of the
#: container's name, and the restart policy.
FOLLOWER = 'follow-container'
#: Label of containers with the launch's id.
LABEL = 'fogros2-launch'
#: Options that our own commands set.
_OURS = {'-d', '--detach', '-i', '--interactive', '-t', '--tty', '--rm'}
_ENGINES = ('podman', 'docker')
_SUDO_FLAGS = {'-E', '-H', '-n', '-S', '--non-interactive', '--preserve-env'}
_ASSIGNMENT = re.compile(r'[A-Za-z_]\w*=')
#: Names of the scripts that are sent with a process.
_OUTER, _INNER = 'container', 'in-container'
_VARIABLE = re.compile('[A-Za-z_][A-Za-z0-9_]*')
#: An image's name may have a registry, a tag, a digest; podman's a transport, such as dir:/path.
_IMAGE = re.compile('[A-Za-z0-9][A-Za-z0-9._:/@+-]*')
#: Variables that decide which nodes hear each other. Each container on the machine's network gets
#: the values of the machine's nodes.
_DDS_VARIABLES = sorted([
    *dds.VARIABLES, 'RMW_FASTRTPS_USE_QOS_FROM_XML', 'ROS_DOMAIN_ID',
    'ZENOH_ROUTER_CHECK_ATTEMPTS'])
#: Variables of the machine's nodes that only nodes in images get.
_NODE_VARIABLES = (
    'LANG', 'RCUTILS_COLORIZED_OUTPUT', 'RCUTILS_CONSOLE_OUTPUT_FORMAT',
    'RCUTILS_LOGGING_BUFFERED_STREAM', 'RCUTILS_LOGGING_USE_STDOUT',
)
#: Options that give a container a separate network, whatever their value.
_OWN_NETWORK = {'--ip', '--ip6', '--link', '--mac-address', '--network-alias', '--pod',
                '--publish', '--publish-all', '-P', '-p'}
#: Path from which launch files of the original FogROS2 mount Cyclone DDS's configuration.
FOGROS2_FILE = '/home/ubuntu/cyclonedds.xml'
_MOUNTS = ('-v', '--volume', '--mount')
_FOGROS2_SOURCE = re.compile(rf'(^|\b(?:source|src)=){FOGROS2_FILE}(?=[:,]|$)')
#: Prints the machine's engine, or nothing if none works.
FIND = Command.script(scripts.FIND, what='look for podman or docker')


@dataclasses.dataclass(frozen=True)
class Container:
    """
    The container of a ``docker run`` line.

    :param options: options before the image, without those that our own commands set; in them and
        in the command, an expansion stands between two ``docker_lines.MARK``.
    :param gpus: 'all' or a number, '' for none.
    :param name: name in the launch file, '' for none.
    :param restart: restart policy such as 'always', '' for none.
    """

    image: str
    options: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    gpus: str = ''
    name: str = ''
    restart: str = ''


def described(
    image: str, *, command: Union[str, Sequence[str]] = (), ports: Sequence[str] = (),
    environment: Mapping[str, Any] = {}, volumes: Sequence[str] = (), gpus: Any = '',
    restart: str = '', name: str = '',
) -> str:
    """
    Return the ``docker run`` line of a container.

    :param ports: such as '8080:80'; ``volumes`` such as '/data:/data:ro', paths of the machine.
    :param restart: restart policy of the engine, such as 'always'.
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
    Parse a ``docker run`` line.

    The result has neither ``sudo`` nor ``--detach``, which our own commands set. Expansions in it
    are those of :func:`docker_lines.words`.

    :raises ConfigurationError: it is no such line, has no image, or is more than one command.
    """
    def wrong(why: str, hint: str = '') -> ConfigurationError:
        return ConfigurationError(f"add_docker_container: '{line.strip()}' {why}", hint or (
            "write 'docker run [options] image [command]', or give image= and the rest by name"))

    try:
        words = docker_lines.words(line)
    except ValueError as error:
        raise wrong(str(error), "quote it, or give the container the command sh -c '...'"
                    ) from error
    if words[:1] == ['sudo']:
        words = [*itertools.dropwhile(_SUDO_FLAGS.__contains__, words[1:])]
        if words and words[0].startswith('-'):
            raise wrong(f'has {words[0]} of sudo', 'leave it out: the engine runs as root')
    if words and _ASSIGNMENT.match(words[0]):
        raise wrong(f'sets {words[0]} for the engine',
                    'leave it out, or give it to the container: docker run -e ...')
    if not words or posixpath.basename(words.pop(0)) not in _ENGINES:
        raise wrong('is no line of docker or podman')
    if words and words[0].startswith('-'):
        raise wrong(f"has {words[0]} in front of 'run'",
                    "leave it out: the machine's own engine runs the container")
    if words[:1] == ['container']:
        words.pop(0)
    if words[:1] != ['run']:
        raise wrong('runs nothing')
    options: list[str] = []
    settings = {'--gpus': '', '--name': '', '--restart': ''}
    at = 1
    while at < len(words) and words[at].startswith('-') and words[at] != '-':
        word = words[at]
        at += 1
        if word == '--':
            break
        name, equals, value = word.partition('=')
        if not word.startswith('--'):
            rest = word[1:].lstrip(docker_lines.SHORT_FLAGS)
            options += ['-P'] if 'P' in word[:len(word) - len(rest)] else []
            if rest[:1] in ('', '='):  # such as -it=true
                continue
            word = f'-{rest}'
            name, equals, value = word[:2], word[2:], word[2:].lstrip('=')
        if name in _OURS:
            continue
        if name[2:] in docker_lines.FLAGS:
            options.append(word)
            continue
        if name[2:] not in docker_lines.VALUES and name[1:] not in {*docker_lines.SHORT_VALUES}:
            raise wrong(f'has {name}, which is no option of docker run', did_you_mean(
                name, [f'--{each}' for each in docker_lines.FLAGS | docker_lines.VALUES],
                'correct it'))
        if not equals:
            if at >= len(words):
                raise wrong(f'has nothing after {word}')
            value = words[at]
            at += 1
        if name in settings:
            settings[name] = value
        else:
            options += [name, value]
    if at >= len(words):
        raise wrong('names no image')
    for text in (words[at], *settings.values()):
        if docker_lines.MARK in text:
            raise wrong(f"has {text.replace(docker_lines.MARK, '')} as image, name, gpus or "
                        'restart', 'write it out: the launch has to know it')
    if not _IMAGE.fullmatch(words[at]):
        raise wrong(f"has '{words[at]}' where the image has to be")
    return Container(words[at], tuple(options), tuple(words[at + 1:]), settings['--gpus'],
                     settings['--name'], settings['--restart'])


def on_machine_network(container: Container) -> bool:
    """Return whether a container has the machine's network, which is the default."""
    networks = [value for name, value in _pairs(container) if name in ('--network', '--net')]
    if networks:
        return networks == ['host']
    return not _OWN_NETWORK & {word.partition('=')[0] for word in container.options}


def sets(container: Container, variable: str) -> bool:
    """Return whether an option of a container sets a variable; files are not read."""
    return any(name in ('-e', '--env') and value.partition('=')[0] == variable
               for name, value in _pairs(container))


def check(container: Container, rmw: str) -> None:
    """
    Check that a container does not need Cyclone DDS's configuration with another middleware.

    :param rmw: the launch's middleware.
    :raises DdsError: the container mounts ``FOGROS2_FILE``.
    """
    if rmw != 'rmw_cyclonedds_cpp' and any(
            name in _MOUNTS and _FOGROS2_SOURCE.search(value)
            for name, value in _pairs(container)):
        raise DdsError(
            f"the container '{container.image}' mounts {FOGROS2_FILE} for rmw_cyclonedds_cpp, and"
            f" the launch's nodes have {rmw}: they would not hear each other",
            'set RMW_IMPLEMENTATION=rmw_cyclonedds_cpp, or leave the mount out')


def _pairs(container: Container) -> Iterable[tuple[str, str]]:
    return zip(container.options, container.options[1:])


def dds_options(
    container: Container, configuration: str, variables: str = '',
) -> tuple[str, ...]:
    """
    Return a container's options, after options that connect its nodes to the machine's nodes.

    The launch file's options come last and win: for the engine, ``-e`` overrides all files of
    variables, and a later file an earlier one. The container shares the machine's memory,
    which nodes with a configuration of their own may use. A mount of ``FOGROS2_FILE`` becomes a
    mount of the launch's configuration. A container with a separate network does not get the
    machine's DDS.

    :param configuration: path of the middleware's configuration on the machine.
    :param variables: path of a file there with ``dds_variables``, '' for none.
    """
    own = list(container.options)
    for at, (name, value) in enumerate(_pairs(container), 1):
        if name in _MOUNTS:
            own[at] = _FOGROS2_SOURCE.sub(rf'\g<1>{configuration}', value)
    if not on_machine_network(container):
        return tuple(own)
    words = ['--env-file', variables] if variables else []
    names = {word.partition('=')[0] for word in own}
    if not names & {'--network', '--net'}:
        words += ['--network', 'host']
    if not names & {'--ipc', '--shm-size'}:
        words += ['--ipc', 'host']
    return (*words, '-v', f'{configuration}:{configuration}:ro', *own)


def dds_variables(environment: Mapping[str, str]) -> str:
    """
    Return the content of the file with the variables of a container beside the nodes.

    Variables that the machine's nodes do not have replace those of the image, too.

    :param environment: environment of the machine's nodes. The file's format has no values of
        several lines.
    """
    values = {name: environment.get(name, '') for name in _DDS_VARIABLES}
    values['ROS_DOMAIN_ID'] = values['ROS_DOMAIN_ID'] or '0'
    return ''.join(f'{name}={value}\n' for name, value in values.items() if '\n' not in value)


def called(container: Container, number: int, launch: str) -> str:
    """Return the engine's name of a container, which is unique among launches."""
    return f'fogros2-{launch}-{_called(container, number)}'


def _called(container: Container, number: int) -> str:
    what = container.name or posixpath.basename(container.image).partition('@')[0]
    return f'{number}-' + re.sub(r'[^A-Za-z0-9_.-]', '-', what)[:40]


def image_of(node: NodeSpec) -> Mapping[str, Any]:
    """Return a node's keywords ``image`` and ``image_options``, those that it has."""
    return node.features.get(NAME, {})


def node_container(image: str, options: Sequence[str]) -> Container:
    """
    Return the container of a node.

    :param options: options of ``docker run``, such as '--gpus=all'.
    :raises ConfigurationError: they are no such options.
    """
    wrong = ConfigurationError(
        f"image_options={list(options)} are not only options of 'docker run'",
        "such as ['--gpus=all', '-v', '/data:/data:ro']")
    try:
        container = parse(shlex.join(['docker', 'run', *options, image]))
    except ConfigurationError as error:
        raise wrong from error
    if container.image != image or container.command:
        raise wrong
    return container


def qualified(image: str) -> str:
    """Return an image's full name: docker completes short names, podman does not."""
    first, slash, _ = image.partition('/')
    if ':/' in image or slash and ('.' in first or ':' in first or first == 'localhost'):
        return image
    return f'docker.io/{image}' if slash else f'docker.io/library/{image}'


def fetch(image: str, rmw: str = '') -> Command:
    """
    Return the command that downloads an image if necessary, and prints the engine's name of it.

    :param rmw: middleware to add to an image with ROS 2, '' for none.
    """
    return Command(('sh', '-ec', scripts.IMAGE, 'sh', image, qualified(image), rmw,
                    APT.format(packages='"$0"')), what=f"get the image '{image}'")


def run(
    container: Container, number: int, launch: str, image: str, configuration: str,
    variables: str,
) -> Command:
    """
    Return the command that starts a container.

    :param image: output of ``fetch``.
    :param configuration: see ``dds_options``, as for ``variables``.
    """
    words = ('--label', f'{LABEL}={launch}', *dds_options(container, configuration, variables),
             image, *container.command)
    script = scripts.RUN
    if any(docker_lines.MARK in word for word in words):
        # expanded by the login user's shell, before the engine runs as root
        script = f'set -- "$@" {" ".join(map(docker_lines.expression, words))}\n{script}'
        words = ()
    return Command(
        ('sh', '-ec', script, 'sh', called(container, number, launch), container.gpus, *words),
        what=f"start the container '{container.image}'")


def follower(launch: str) -> str:
    """Return the program that follows the containers of a launch."""
    return scripts.FOLLOW.replace('@LAUNCH@', launch)


def follow(container: Container, number: int) -> NodeSpec:
    """Return the process that follows a running container."""
    name = _called(container, number)
    return NodeSpec(
        id=f'container-{name}', name=name.partition('-')[2],
        arguments=('sh', '-c', f'exec sh "$FOGROS2_AGENT_DIRECTORY/{FOLLOWER}" "$0" "$@"', name,
                   container.restart), passes_signals=True, sigterm_timeout=15.0)


def inside(
    node: NodeSpec, image: str, launch: str, workspace: str, configuration: str,
    variables: Iterable[str] = (),
) -> NodeSpec:
    """
    Return the process that runs a node in its image.

    :param image: output of ``fetch``.
    :param workspace: path of the workspace on the machine and in the container, '' for none.
    :param configuration: see ``dds_options``.
    :param variables: names of the launch file's variables for the machine's nodes.
    """
    given = image_of(node)
    container = node_container(given['image'], given.get('image_options', ()))
    candidates = {*_DDS_VARIABLES, *_NODE_VARIABLES, *variables, *node.environment}
    names = sorted(name for name in candidates if _VARIABLE.fullmatch(name))
    options: list[Text] = [
        '--label', f'{LABEL}={launch}', *dds_options(container, configuration)]
    for key in node.files:
        options += ['-v', ({'file': key}, ':', {'file': key}, ':ro')]
    options += ['-w', node.cwd] if node.cwd else []
    # Before the agent kills this process, which would leave the container running.
    grace = max(0.1, node.sigkill_timeout - 1.0)
    name = f'fogros2-{launch}-' + re.sub(r'[^A-Za-z0-9_.-]', '-', node.name)[:60]
    return dataclasses.replace(
        node, package='', executable='', prefix=(), cwd=None, passes_signals=True,
        features={name: each for name, each in node.features.items() if name != NAME},
        files={**node.files, _OUTER: scripts.NODE.replace(
            '@VARIABLES@', ' '.join(names)).replace('@DDS@', ' '.join(_DDS_VARIABLES)),
               _INNER: scripts.INSIDE},
        arguments=(
            'sh', ({'file': _OUTER},), name, container.gpus, workspace, f'{grace:g}',
            ({'file': _INNER},), *options, image, 'sh', ({'file': _INNER},), workspace,
            node.package, node.executable, shlex.join(map(str, node.prefix)), *node.arguments))


def remove(launch: str) -> Command:
    """Return the command that removes all containers of a launch."""
    return Command(('sh', '-ec', scripts.REMOVE, 'sh', LABEL, launch),
                   what='remove its containers')

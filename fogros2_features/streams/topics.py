# SPDX-License-Identifier: Apache-2.0
"""
Name the topics of streams, on the robot and on machines; pure.

On the robot a topic keeps its name, so that drivers and viewers outside the launch work unchanged.
On a machine, image and camera info get a name that contains the machine (``/camera`` becomes
``/fogros2/planner/camera``). With one name on both sides, DDS would connect them, and raw images
would cross the VPN. The stream's name extends that of its source (``/camera/h264``,
``/fogros2/planner/annotated/h264``), so several hosts may publish the same topic. Names of plugins
of ``image_transport`` get an addition (``/camera/fogros2/compressed``): a driver may publish
``/camera/compressed``, and both would cross.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import json
import shlex
from typing import Any

from fogros2.errors import ConfigurationError, PrerequisiteError
from fogros2.host import modules
from fogros2.model import NodeSpec
from fogros2.ros_names import check_name, identifier, local_topic
from fogros2_features.streams.transport import ImageTransport, Stream

#: Options of a Stream that are parameters of the decoder, not of the encoder.
DECODER_PARAMETERS = ('encoding',)
#: Options of all streams that use this project's nodes.
OPTIONS = frozenset({'camera_info', 'priority', *DECODER_PARAMETERS})
#: Last parts of streams' names that no plugin uses.
_OWN = ('h264', 'pointcloud', 'raw')


def check(stream: Stream) -> None:
    """
    Check that a stream is possible.

    :raises ConfigurationError: not a full topic name, or both ends on one host.
    """
    check_name(stream.topic)
    if stream.source == stream.target:
        where = stream.source or 'the robot'
        raise ConfigurationError(f'{stream.topic} would be streamed from {where} to itself',
                                 'source= names another machine; leave it out for the robot')


def check_option(topic: str, name: str, value: Any, transport: ImageTransport) -> None:
    """
    Check the value of a stream's option, unless it is a substitution.

    :raises ConfigurationError: the transport's nodes would refuse it.
    """
    if not isinstance(value, (bool, int, float, str)):
        return
    hint = ''
    if name in transport.numbers:
        least, largest = transport.numbers[name]
        if isinstance(value, (bool, str)) or not least <= value <= largest:
            hint = f'give a number from {least:.10g} to {largest:.10g}'
    elif value not in transport.choices.get(name, (value,)):
        hint = f"there are {', '.join(map(json.dumps, transport.choices[name]))}"
    if hint:
        raise ConfigurationError(f'{topic}: {name}={value!r} is invalid', hint)


def camera_info_topic(topic: str) -> str:
    """Return the camera info topic of an image topic."""
    return topic.rpartition('/')[0] + '/camera_info'


def carries_info(stream: Stream) -> bool:
    """
    Return whether camera info is streamed: by default, only from the robot.

    The stream's option ``camera_info`` overrides the default. An annotated image that comes back
    is often a sibling of the camera's image. Its camera info would have the camera's own name,
    and return to its source.
    """
    return bool(stream.options.get('camera_info', stream.source is None))


def names_of(stream: Stream, role: str, name: str) -> tuple[str, str, str]:
    """
    Return a label of a stream's node, unique on its host; the node's name; the stream's topic.

    :param role: 'encoder' or 'decoder'.
    :param name: last part of the stream's topic.
    """
    machine = stream.source if role == 'encoder' else stream.target
    label = f'{identifier(stream.topic)}_{name}_{role}'
    if role == 'decoder' and stream.source is not None:
        label += f'_from_{identifier(stream.source)}'
    full = label if machine is None else f'{label}_on_{identifier(machine)}'
    between = name if name in _OWN else f'fogros2/{name}'
    return label, full, f'{local_topic(stream.topic, stream.source)}/{between}'


def check_modules(package: str = 'image_transport_h264', what: str = 'images') -> None:
    """
    Check that the nodes of a stream, which a package has, can run on this computer.

    :raises PrerequisiteError: a Python module is missing.
    """
    lacking = [module.requirement for module in modules.lacking_here(
        modules.needed_by([(package, 'encoder')]))]
    if lacking:
        raise PrerequisiteError(
            f"streams of {what} need {', '.join(lacking)}, which this Python does not have",
            f'pip install {shlex.join(lacking)}')


def node(
    stream: Stream, *, role: str, name: str, package: str, topic: str,
    options: Iterable[str], parameters: Mapping[str, Any],
) -> NodeSpec:
    """
    Return one node of a pair with the executables 'encoder' and 'decoder'.

    :param role: 'encoder' or 'decoder'.
    :param name: last part of the stream's topic; viewers look for 'compressed' there.
    :param topic: the nodes' name of the topic, which is remapped.
    :param options: the options of the stream that are parameters of the decoder.
    :param parameters: more parameters of the node.
    :raises ConfigurationError: an option cannot be a parameter.
    """
    machine = stream.source if role == 'encoder' else stream.target
    local = local_topic(stream.topic, machine)
    label, full, between = names_of(stream, role, name)
    values: dict[str, Any] = {**parameters, 'stream': between}
    if role == 'decoder' and stream.links:
        values['links'] = ','.join(f'{link}={bits:.0f}' for link, bits in stream.links.items())
    if role == 'encoder' and local != stream.topic:
        values['topic'] = stream.topic
    for key, value in stream.options.items():
        if key != 'camera_info' and (key in options) == (role == 'decoder'):
            values[key] = value
    words = ['--ros-args', '-r', f'__node:={full}', '-r', f'{topic}:={local}']
    for key, value in values.items():
        words += ['-p', f'{key}:={_yaml(key, value)}']
    return NodeSpec(
        id=f"{machine or 'robot'}/{label}", name=label, package=package,
        executable=role, arguments=tuple(words), respawn=True, respawn_delay=1.0)


def _yaml(key: str, value: Any) -> str:
    if not isinstance(value, (bool, int, float, str)):
        raise ConfigurationError(f"option '{key}' of a stream is {value!r}",
                                 'give a number, a text, true or false')
    return json.dumps(value)  # which rcl reads as YAML, also 1e-05 and Infinity

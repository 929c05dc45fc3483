# SPDX-License-Identifier: Apache-2.0
"""Names of topics and services, on the robot and on machines; how nodes are remapped to them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import dataclasses
import re
from typing import Optional

from fogros2.errors import ConfigurationError
from fogros2.model import NodeSpec, Text

#: The full name of a topic or a service.
TOPIC = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')
#: Suffix by which FogROS2's own launch files mean a topic's name on machines.
_CLOUD = '/cloud'
_RULE = ('-r', '--remap')
_NAMESPACE = '__ns:='


def check_name(topic: str) -> str:
    """
    Check that ``topic`` is the full name of a topic; return it.

    :raises ConfigurationError: it is not.
    """
    if not TOPIC.fullmatch(topic) or '__' in topic:
        raise ConfigurationError(f"'{topic}' is not the full name of a topic",
                                 "write it as ros2 topic list does, such as '/camera/image_raw'")
    return topic


def local_topic(topic: str, machine: Optional[str]) -> str:
    """Return a topic's name on a host: its own name on the robot (None)."""
    if machine is None:
        return topic
    return f'/fogros2/{identifier(machine)}{topic}'


def identifier(text: str) -> str:
    """Convert a name to a part of a ROS name: letters, digits, underscores, no leading digit."""
    plain = re.sub('_+', '_', re.sub('[^A-Za-z0-9]', '_', text)).strip('_')
    return plain if plain[:1].isalpha() else f'm_{plain}'


def absolute(name: str, namespace: str) -> str:
    """Return a topic's full name; private names (``~/x``) are unchanged."""
    if name.startswith(('/', '~', 'rostopic://', 'rosservice://')):
        return name
    return f"/{namespace.strip('/')}/{name}".replace('//', '/')


def rewrite(
    pairs: Iterable[tuple[str, str]], names: Mapping[str, str], namespace: str = '/',
) -> list[tuple[str, str]]:
    """
    Rewrite a node's remappings so that they lead to the new names.

    ROS applies only one rule to a name, so ``image:=/camera`` has to name the new place of
    ``/camera``. Rules for nodes that use the topic's own name follow at the end, because the
    first matching rule wins. A rule that leads to ``/camera/cloud`` means the machine's side of
    ``/camera``, as in FogROS2's README.

    :param pairs: the node's rules, in order: from its group, SetRemap, or itself.
    :param names: new names by full old names.
    :param namespace: the node's namespace, for relative names.
    """
    def renamed(name: str) -> str:
        full = absolute(name, namespace)
        return names.get(full) or names.get(full.removesuffix(_CLOUD), name)

    changed = [(old, renamed(new)) for old, new in pairs]
    old_names = {absolute(old, namespace) for old, _ in pairs}
    return [*changed, *((old, new) for old, new in names.items() if old not in old_names)]


def remapped(node: NodeSpec, names: Mapping[str, str]) -> NodeSpec:
    """
    Rename topics for a process, even if it remaps them itself, and in its ``qos_overrides``.

    A program without ROS arguments is returned unchanged.

    :param names: new topic names by full old names.
    """
    arguments = node.arguments
    if not names or '--ros-args' not in arguments:
        return node
    indices: list[int] = []
    namespace = '/'
    ours = False
    for index, argument in enumerate(arguments):
        if argument in ('--ros-args', '--'):
            ours = argument == '--ros-args'
        elif ours and isinstance(argument, str) and ':=' in argument and index and (
                arguments[index - 1] in _RULE):
            if argument.startswith(_NAMESPACE):
                namespace = argument[len(_NAMESPACE):]
            elif not argument.startswith('__') and ':__' not in argument.partition(':=')[0]:
                indices.append(index)
    pairs: list[tuple[str, str]] = []
    for index in indices:
        rule = arguments[index]
        assert isinstance(rule, str)
        old, _, new = rule.partition(':=')
        pairs.append((old, new))
    rules = [f'{old}:={new}' for old, new in rewrite(pairs, names, namespace)]
    rewritten: list[Text] = [_overrides(argument, names) for argument in arguments]
    for index, rule in zip(indices, rules):
        rewritten[index] = rule
    more = [argument for rule in rules[len(indices):] for argument in ('-r', rule)]
    return dataclasses.replace(
        node, arguments=(*rewritten, *(('--ros-args', *more) if more else ())),
        files={key: _overrides(text, names) for key, text in node.files.items()})


def _overrides(text: Text, names: Mapping[str, str]) -> Text:
    """
    Rename topics in the parameters ``qos_overrides`` of an argument or a parameter file.

    Nodes look these parameters up by the new name of a topic.
    """
    # in a file, the topic may be a key of its own, below qos_overrides
    topic = re.compile(r'''(\bqos_overrides\.|^[ \t]+["']?)(%s)(?=\.|["']?:)''' % '|'.join(
        map(re.escape, names)), re.MULTILINE)

    def renamed(part: str) -> str:
        if 'qos_overrides' not in part:
            return part
        return topic.sub(lambda match: match[1] + names[match[2]], part)

    if isinstance(text, str):
        return renamed(text)
    return tuple(renamed(part) if isinstance(part, str) else part for part in text)

# SPDX-License-Identifier: Apache-2.0
"""Names: what is valid, how they are expanded, and what DDS makes of them."""

import re
import string
from typing import Literal

from rclpy import exceptions

_ALPHANUMERIC = re.compile(r'[^A-Za-z0-9_/]')
_LETTERS = f'{string.ascii_letters}{string.digits}_'
_TOPIC = re.compile(r'~?(?:[A-Za-z0-9_/]|\{(?:[A-Za-z_][A-Za-z0-9_]*)?\})*')  # how far it is fine
_SUBSTITUTION = re.compile(r'\{([^{}]*)\}')

TOPIC_PREFIX, REQUEST_PREFIX, RESPONSE_PREFIX = 'rt', 'rq', 'rr'

Fault = tuple[str, int]  # what is wrong, and where


def _digit_after_slash(name: str) -> int | None:
    found = re.search(r'/[0-9]', name)
    return found.start() + 1 if found else None


def node_name_fault(name: str) -> Fault | None:
    """Find what is wrong with a node's name."""
    if not name:
        return 'node name must not be empty', 0
    if found := re.search(r'[^A-Za-z0-9_]', name):
        return ("node name must not contain characters other than alphanumerics or '_'",
                found.start())
    if name[0].isdigit():
        return 'node name must not start with a number', 0
    if len(name) > 255:
        return "node name length should not exceed '255'", 254
    return None


def _full_fault(name: str, what: str, trailing: str, limit: int) -> Fault | None:
    if not name:
        return f'{what} must not be empty', 0
    if name[0] != '/':
        return f"{what} must be absolute, it must lead with a '/'", 0
    if len(name) > 1 and name[-1] == '/':
        return f"{what} must not end with a '/'{trailing}", len(name) - 1
    if found := _ALPHANUMERIC.search(name):
        return (f"{what} must not contain characters other than alphanumerics, '_', or '/'",
                found.start())
    if (place := name.find('//')) >= 0:
        return f"{what} must not contain repeated '/'", place + 1
    if (digit := _digit_after_slash(name)) is not None:
        return f'{what} must not have a token that starts with a number', digit
    if len(name) > limit:
        kind = 'topic length' if what == 'topic name' else what
        return f"{kind} should not exceed '{limit}'", limit - 1
    return None


def namespace_fault(name: str) -> Fault | None:
    """Find what is wrong with a namespace."""
    return _full_fault(name, 'namespace', ", unless only a '/'", 245)


def full_topic_name_fault(name: str) -> Fault | None:
    """Find what is wrong with an expanded name of a topic or service."""
    return _full_fault(name, 'topic name', '', 247)


def topic_name_fault(name: str) -> Fault | None:
    """Find what is wrong with a name of a topic or service as a program gives it."""
    if not name:
        return 'topic name must not be empty string', 0
    if name[0].isdigit():
        return 'topic name token must not start with a number', 0
    if name[-1] == '/':
        return 'topic name must not end with a forward slash', len(name) - 1
    place = _TOPIC.match(name).end()  # type: ignore[union-attr]
    rest = name[place:]
    unbalanced = "topic name must not have unmatched (unbalanced) curly braces '{}'", place
    if rest.startswith('{'):
        inside = len(rest) - len(rest[1:].lstrip(_LETTERS))
        if rest[1:2].isdigit():
            return 'substitution name must not start with a number', place + 1
        if rest[inside:inside + 1] in ('', '{'):
            return unbalanced
        return ("substitution name must not contain characters other than alphanumerics or '_'",
                place + inside)
    if rest.startswith('}'):
        return unbalanced
    if rest.startswith('~'):
        return "topic name must not have tilde '~' unless it is the first character", place
    if rest:
        return ('topic name must not contain characters other than alphanumerics, '
                "'_', '~', '{', or '}'", place)
    if len(name) > 2 and name[0] == '~' and name[1] != '/':
        return ("topic name must not have a tilde '~' that is not followed by a "
                "forward slash '/'", 1)
    if (digit := _digit_after_slash(name)) is not None:
        return 'topic name token must not start with a number', digit
    return None


def _checked(name: str, fault: Fault | None, error: type[exceptions.NameValidationException],
             ) -> Literal[True]:
    if fault is not None:
        raise error(name, *fault)  # type: ignore[call-arg, arg-type]
    return True


def _topic_error(is_service: bool) -> type[exceptions.NameValidationException]:
    if is_service:
        return exceptions.InvalidServiceNameException  # type: ignore[no-any-return]
    return exceptions.InvalidTopicNameException  # type: ignore[no-any-return]


def validate_node_name(node_name: str) -> Literal[True]:
    """
    Check a name.

    :raises InvalidNodeNameException: if it is invalid.
    """
    return _checked(node_name, node_name_fault(node_name), exceptions.InvalidNodeNameException)


def validate_namespace(namespace: str) -> Literal[True]:
    """
    Check a name.

    :raises InvalidNamespaceException: if it is invalid.
    """
    return _checked(namespace, namespace_fault(namespace), exceptions.InvalidNamespaceException)


def validate_topic_name(name: str, *, is_service: bool = False) -> Literal[True]:
    """
    Check a name as a program gives it.

    :raises InvalidTopicNameException: if it is invalid; for a service its own exception.
    """
    return _checked(name, topic_name_fault(name), _topic_error(is_service))


def validate_full_topic_name(name: str, *, is_service: bool = False) -> Literal[True]:
    """
    Check an expanded name.

    :raises InvalidTopicNameException: if it is invalid; for a service its own exception.
    """
    return _checked(name, full_topic_name_fault(name), _topic_error(is_service))


def join(namespace: str, name: str) -> str:
    """Put a name below a namespace."""
    return f"{namespace.rstrip('/')}/{name}"


def expand(name: str, node: str, namespace: str) -> str:
    """
    Expand ``~``, substitutions and relative names.

    :raises ValueError: if a substitution is unknown or a part is invalid.
    """
    for part, fault in ((name, topic_name_fault(name)), (node, node_name_fault(node)),
                        (namespace, namespace_fault(namespace))):
        if fault is not None:
            raise ValueError(f"topic name '{part}' is invalid: {fault[0]}")
    values = {'node': node, 'ns': namespace, 'namespace': namespace}

    def value(found: 're.Match[str]') -> str:
        if found[1] not in values:
            raise ValueError(f"topic name '{name}' is invalid: unknown substitution: {found[0]}")
        return values[found[1]]

    if name[0] == '~':
        name = join(namespace, node) + name[1:]
    name = _SUBSTITUTION.sub(value, name)
    return name if name.startswith('/') else join(namespace, name)


def dds_type(name: str) -> str:
    """Give DDS's name of ``package/msg/Name``."""
    package, kind, short = name.split('/')
    return f'{package}::{kind}::dds_::{short}_'


def ros_type(name: str) -> str:
    """Give ROS's name of a DDS type, or the name itself if ROS didn't make it."""
    package, separator, rest = name.partition('::')
    if '::dds_::' not in name or not name.endswith('_'):
        return name
    return f'{package}/{rest[:-1]}'.replace('::dds_::', '/').replace('::', '/')


def demangle_topic(name: str) -> str | None:
    """Give the ROS topic of a DDS topic; None if it is none."""
    prefix, separator, rest = name.partition('/')
    return '/' + rest if separator and prefix == TOPIC_PREFIX else None


def demangle_service(topic: str, type_name: str) -> tuple[str, str, bool] | None:
    """Give name and type of the service a DDS topic is part of, and whether of its requests."""
    prefix, separator, rest = topic.partition('/')
    for wanted, ending, part in ((REQUEST_PREFIX, 'Request', '_Request_'),
                                 (RESPONSE_PREFIX, 'Reply', '_Response_')):
        if prefix == wanted and rest.endswith(ending) and type_name.endswith(part):
            kind = ros_type(type_name)[:-len(part) + 1]
            return '/' + rest[:-len(ending)], kind, wanted == REQUEST_PREFIX
    return None

# SPDX-License-Identifier: Apache-2.0
"""What stands between ``--ros-args`` and ``--`` on a command line."""

from collections.abc import Iterator
from dataclasses import dataclass, field
import re
from typing import Any

from rclpy._names import expand, topic_name_fault
from rclpy.exceptions import RCLInvalidROSArgsError, UnknownROSArgsError
from rclpy.impl.logging_severity import LoggingSeverity

_RULE = re.compile(r'((?P<node>[A-Za-z_]\w*):(?!//|=))?(?P<from>(rostopic://|rosservice://)?[^:]+)'
                   r':=(?P<to>.+)$')
_SWITCHES = {f'--{verb}-{what}-logs': (what, verb == 'enable')
             for verb in ('enable', 'disable') for what in ('rosout', 'stdout', 'external-lib')}


@dataclass(frozen=True)
class Rule:
    """A remapping: for one node, or for all (node is None)."""

    node: str | None
    source: str
    target: str


@dataclass
class Arguments:
    """A command line, understood."""

    rules: list[Rule] = field(default_factory=list)
    parameters: list[tuple[str, str, Any]] = field(default_factory=list)  # node, name, value
    levels: list[tuple[str, LoggingSeverity]] = field(default_factory=list)  # logger, level
    switches: dict[str, bool] = field(default_factory=dict)
    enclave: str = '/'
    others: list[str] = field(default_factory=list)  # what isn't ROS's
    unknown: list[str] = field(default_factory=list)


def parse(argv: list[str], failed: str = 'Failed to parse ROS arguments') -> Arguments:
    """
    Parse a command line.

    :param failed: how the error begins.
    :raises RCLInvalidROSArgsError: if something between ``--ros-args`` and ``--`` is malformed.
    """
    found = Arguments()
    inside = False
    rest = list(argv)
    while rest:
        item = rest.pop(0)
        if not inside:
            if item == '--ros-args':
                inside = True
            else:
                found.others.append(item)
        elif item == '--':
            inside = False
        elif item != '--ros-args':
            try:
                _option(found, item, rest)
            except ValueError as error:
                raise RCLInvalidROSArgsError(f"{failed}: Couldn't parse {error}") from error
    return found


def check_known(found: Arguments) -> None:
    """
    Refuse arguments that nobody knows.

    :raises UnknownROSArgsError: if there are any.
    """
    if found.unknown:
        raise UnknownROSArgsError(f'Found unknown ROS arguments: {found.unknown}')


def _option(found: Arguments, item: str, rest: list[str]) -> None:
    def value(what: str) -> str:
        if not rest:
            raise ValueError(f'trailing {item} flag. No {what}')
        return rest.pop(0)

    def refuse(what: str, text: str, why: object) -> ValueError:
        return ValueError(f"{what}: '{item} {text}'. Error: {why}")

    if item in ('-r', '--remap'):
        text = value('remap rule found.')
        try:
            found.rules.append(parse_rule(text))
        except ValueError as error:
            raise refuse('remap rule', text, error) from error
    elif item in ('-p', '--param'):
        text = value('parameter override rule found.')
        name, separator, written = text.partition(':=')
        node, _, name = name.rpartition(':')
        if not separator or not name:
            raise refuse('parameter override rule', text, 'not of the form [node:]name:=value')
        try:
            found.parameters.append((node or '/**', name, parse_value(written)))
        except ValueError as error:
            raise refuse('parameter override rule', text, error) from error
    elif item == '--params-file':
        path = value('file path provided.')
        try:
            found.parameters += read_parameters(path)
        except (OSError, ValueError) as error:
            raise refuse('params file', path, error) from error
    elif item == '--log-level':
        text = value('log level provided.')
        logger, separator, level = text.rpartition(':=')
        if level.upper() not in LoggingSeverity.__members__ or level.upper() == 'UNSET':
            raise refuse('log level', text, f"'{level}' is no severity")
        found.levels.append((logger, LoggingSeverity[level.upper()]))
    elif item in ('-e', '--enclave'):
        found.enclave = value('enclave path provided.')
    elif item in ('--log-config-file', '--log-file-name'):
        value('file path provided.')  # there is no logger behind that it could configure
    elif item in _SWITCHES:
        name, on = _SWITCHES[item]
        found.switches[name] = on
    else:
        found.unknown.append(item)


def parse_rule(text: str) -> Rule:
    """
    Understand ``[node:]from:=to``.

    :raises ValueError: if it isn't that, or what is to be a name is none.
    """
    match = _RULE.match(text)
    if match is None:
        raise ValueError('not of the form [node:]from:=to')
    for name in (match['from'].rpartition('://')[2], match['to']):
        fault = None if name == '/' else topic_name_fault(name)
        if fault is not None:
            raise ValueError(fault[0])
    return Rule(match['node'], match['from'], match['to'])


def parse_value(text: str) -> Any:
    """
    Read a parameter's value as YAML.

    :raises ValueError: if no parameter can hold it.
    """
    import yaml
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"'{text}' is no YAML") from error
    return _checked(value, text)


def _checked(value: Any, text: object) -> Any:
    if value is None:
        return str(text)
    if isinstance(value, list):
        kinds = {type(item) for item in value}
        if kinds == {int, float}:
            value, kinds = [float(item) for item in value], {float}
        if len(kinds) > 1 or kinds and not kinds <= {bool, int, float, str}:
            raise ValueError(f'sequence should be of same type: {value}')
        return value
    if isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, dict):
        raise ValueError('Unknown YAML event')
    return str(value)  # a date, in YAML's eyes


def read_parameters(path: str) -> list[tuple[str, str, Any]]:
    """
    Read a parameter file: (node or pattern, parameter, value), in the file's order.

    :raises OSError: if it can't be read.
    :raises ValueError: if it is no parameter file.
    """
    import yaml
    with open(path, encoding='utf-8') as file:
        try:
            content = yaml.safe_load(file)
        except yaml.YAMLError as error:
            raise ValueError(f"'{path}' is no YAML: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"'{path}' is no parameter file")
    found: list[tuple[str, str, Any]] = []
    _nodes(content, '', found)
    return found


def _nodes(content: dict[str, Any], prefix: str, found: list[tuple[str, str, Any]]) -> None:
    for key, value in content.items():
        if key == 'ros__parameters':
            if not prefix or not isinstance(value, dict):
                raise ValueError('Cannot have a value before ros__parameters')
            found += [(prefix, name, _checked(value, ''))
                      for name, value in flatten(value)]
        elif isinstance(value, dict):
            _nodes(value, f"{prefix}/{str(key).lstrip('/')}" if prefix else str(key), found)
        elif value is not None:
            raise ValueError(f"Cannot have a value before ros__parameters: '{key}'")


def flatten(values: dict[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield names with dots and values of nested parameters."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from flatten(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


class Settings:
    """What a node takes from its own arguments and from the process's."""

    def __init__(self, own: Arguments, common: Arguments | None) -> None:
        self._all = [own] if common is None else [own, common]  # one's own rules come first

    def _target(self, node: str, matches: Any) -> str | None:
        for arguments in self._all:
            for rule in arguments.rules:
                if rule.node in (None, node) and matches(rule.source):
                    return rule.target
        return None

    def node_name(self, name: str) -> str:
        """Apply ``__node:=``."""
        return self._target(name, ('__node', '__name').__contains__) or name

    def namespace(self, name: str, namespace: str) -> str:
        """Apply ``__ns:=``."""
        return self._target(name, ('__ns',).__contains__) or namespace

    def remap(self, full_name: str, node: str, namespace: str, scheme: str) -> str:
        """
        Apply the first rule for a topic or service.

        :param full_name: its expanded name.
        :param scheme: 'rostopic' or 'rosservice'.
        """
        def matches(source: str) -> bool:
            kind, separator, name = source.rpartition('://')
            if separator and kind != scheme or name.startswith('__'):
                return False
            try:
                return expand(name, node, namespace) == full_name
            except ValueError:
                return False

        target = self._target(node, matches)
        return full_name if target is None else expand(target, node, namespace)

    def parameters(self, full_node_name: str) -> dict[str, Any]:
        """Collect the values given for a node's parameters."""
        found: dict[str, Any] = {}
        for arguments in reversed(self._all):
            for node, name, value in arguments.parameters:
                pattern = node if node.startswith('/') else '/' + node
                if re.fullmatch(pattern.replace('/*', r'(/\w+)'), full_node_name):
                    found[name] = value
        return found

    def switch(self, name: str) -> bool:
        """Say whether 'rosout' or 'stdout' logs are on."""
        return all(arguments.switches.get(name, True) for arguments in self._all)

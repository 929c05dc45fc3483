# SPDX-License-Identifier: Apache-2.0
"""Show the machines of a launch description, and which node goes where; no action is executed."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
from decimal import Decimal
import os
from typing import Any, Optional

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity, Substitution
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteLocal,
    IncludeLaunchDescription,
    OpaqueFunction,
    PopLaunchConfigurations,
    PushLaunchConfigurations,
    ResetLaunchConfigurations,
    SetLaunchConfiguration,
    UnsetLaunchConfiguration,
)
from launch.substitutions import Command, PythonExpression, SubstitutionFailure
from launch.utilities import perform_substitutions

from fogros2.actions.cloud_group import CloudGroup
from fogros2.actions.fog_machine import FogMachine
from fogros2.deploy.checks import check_here, check_names
from fogros2.deploy.choosing import Choices
from fogros2.describe import defaults, values
from fogros2.describe.keywords import ROBOT
from fogros2.describe.machines import CloudInstance, unknown_machine
from fogros2.describe.overrides import Overrides
from fogros2.errors import ConfigurationError, FogError
from fogros2.launch_internals.wrapping import below
from fogros2.model import MachineSpec
from fogros2.provider import Provider
from fogros2.runtime.node_spec import program_of
from fogros2.runtime.remote_process import remote_of

#: Raised by substitutions and conditions that only a launch can evaluate, by wrong values, and by
#: the code of included files, which can raise anything.
_UNKNOWN = Exception
#: Executed here as in a launch; scoped groups contain the first three.
_SETTERS = (PushLaunchConfigurations, PopLaunchConfigurations, ResetLaunchConfigurations,
            SetLaunchConfiguration, UnsetLaunchConfiguration)
#: Parts of a Python expression that call nothing.
_HARMLESS = (ast.Expression, ast.Constant, ast.Name, ast.expr_context, ast.List, ast.Tuple,
             ast.Compare, ast.cmpop, ast.BoolOp, ast.boolop, ast.BinOp, ast.operator,
             ast.UnaryOp, ast.unaryop, ast.IfExp)
#: Characters of a value; a longer one is cut.
_LONGEST = 60


@dataclasses.dataclass
class Planned:
    """
    A machine of a launch.

    :param spec: None for the robot, and for a machine whose values are known at launch only.
    :param note: why there is no spec.
    :param error: for which a launch refuses the machine.
    :param nodes: programs, or command lines.
    :param programs: the (package, executable) pairs that run there in any case.
    """

    name: str
    spec: Optional[MachineSpec] = None
    note: str = ''
    error: Optional[FogError] = None
    nodes: list[str] = dataclasses.field(default_factory=list)
    programs: list[tuple[str, str]] = dataclasses.field(default_factory=list)

    def lines(self, price: Optional[Decimal] = None) -> Iterator[str]:
        """
        Yield a line for the machine, and one for each node.

        :param price: US dollars per hour, if it is known.
        """
        what = self.note
        if self.spec is not None:
            options = ', '.join(f'{name}={_short(value)}' for name, value
                                in sorted(self.spec.options.items())
                                if value not in ('', None, [], ()))
            what = self.spec.provider + f' ({options})' * bool(options)
        if price is not None:
            what += f', ${price.normalize():f} an hour'
        yield f'{self.name}: {what}' if what else self.name
        yield from (f'    {node}' for node in self.nodes)


class _Context(LaunchContext):
    """A context in which no substitution runs a command, and no expression calls anything."""

    def perform_substitution(self, substitution: Substitution) -> str:
        """Return the value of a substitution."""
        refused = isinstance(substitution, Command)
        if isinstance(substitution, PythonExpression):
            text = perform_substitutions(self, substitution.expression).strip()
            refused = not all(isinstance(node, _HARMLESS)
                              for node in ast.walk(ast.parse(text, mode='eval')))
            if not refused:  # the text that was checked, and no module but math
                substitution = PythonExpression(text)
        if refused:
            raise SubstitutionFailure(f'{substitution.describe()} runs at launch')
        return str(super().perform_substitution(substitution))


class Preview:
    """
    What a launch description would do.

    :param arguments: launch arguments.
    :param overrides: of ``--machine``.
    :raises ConfigurationError: an override matches no machine.
    """

    def __init__(
        self, description: LaunchDescription, arguments: Mapping[str, str],
        overrides: Optional[Overrides] = None,
    ) -> None:
        self._context = _Context()
        self._context.launch_configurations.update(arguments)
        self._overrides = overrides
        self._machines: dict[str, Planned] = {}
        self._on_robot: set[str] = set()
        #: Whether a function or an unread file may add something.
        self.open = False
        #: Whether all machines of the launch file are known.
        self._whole = True
        self._look(description.entities)
        if self._whole and not self.open:
            self._check_names()

    @property
    def machines(self) -> list[Planned]:
        """The machines, then the robot if it has nodes."""
        robot = [self._machines[ROBOT]] if ROBOT in self._machines else []
        return [one for one in self._machines.values() if one.name != ROBOT] + robot

    def _check_names(self) -> None:
        described = [one.name for one in self._machines.values() if one.spec is not None]
        for name in self._machines.keys() - {*described, ROBOT}:
            self._machines[name].error = unknown_machine(name, described)
        if self._overrides is not None:
            self._overrides.check([*described, *self._on_robot])

    def lines(self, prices: Mapping[str, Decimal] = {}) -> Iterator[str]:
        """
        Yield the lines to show.

        :param prices: US dollars per hour, by the names of machines.
        """
        for one in self.machines:
            yield from one.lines(prices.get(one.name))
        if self.open:
            yield 'Not shown: what functions, and files that cannot be read now, may add.'

    def _look(
        self, entities: Iterable[LaunchDescriptionEntity], where: str = ROBOT, note: str = '',
    ) -> None:
        for entity in entities:
            own = note
            try:
                condition = getattr(entity, 'condition', None)
                if condition is not None and not condition.evaluate(self._context):
                    self._whole = False
                    continue
            except _UNKNOWN:
                own = ' (under a condition)'
            if isinstance(entity, DeclareLaunchArgument):
                if entity.default_value is not None:
                    self._context.launch_configurations.setdefault(
                        entity.name, self._text(entity.default_value))
            elif isinstance(entity, _SETTERS):
                with contextlib.suppress(_UNKNOWN):
                    entity.execute(self._context)
            elif isinstance(entity, FogMachine):
                try:
                    self._name(entity.described(self._context))
                except _UNKNOWN as error:
                    self._refused(self._text(entity.name), '', error)
            elif isinstance(entity, ExecuteLocal):
                remote = remote_of(entity)
                planned = self._planned(where if remote is None else self._name(remote.machine))
                planned.nodes.append(self._program(entity) + own)
                program = program_of(entity) if remote is None else remote.planned[1]
                if program is not None and not own:
                    planned.programs.append(program)
            else:
                self.open = self.open or isinstance(entity, OpaqueFunction)
                self._inside(entity, where, own)

    def _inside(self, entity: LaunchDescriptionEntity, where: str, note: str) -> None:
        if isinstance(entity, IncludeLaunchDescription):
            try:
                entity.launch_description_source.get_launch_description(self._context)
                for name, value in entity.launch_arguments:
                    self._context.launch_configurations[
                        values.resolve(self._context, name)] = values.resolve(
                            self._context, value)
            except _UNKNOWN:
                self.open = True
                return  # its sub-entities would evaluate the file's name anew, with its commands
        if isinstance(entity, CloudGroup):
            where = self._name(entity.machine)
        for some in below(entity):
            self._look(some, where, note)

    def _program(self, action: ExecuteLocal) -> str:
        program = [part for name in ('node_package', 'node_executable')
                   if (part := getattr(action, name, None))]
        words: Sequence[Any] = program or getattr(action, 'cmd', [])
        return _short(' '.join(map(self._text, words)) or type(action).__name__)

    def _text(self, value: Any) -> str:
        try:
            return str(values.resolve(self._context, value))
        except _UNKNOWN:
            return values.describe(value)

    def _planned(self, name: str) -> Planned:
        return self._machines.setdefault(name, Planned(name))

    def _name(self, machine: Any) -> str:
        """Return the name under which a machine is planned, the robot's for one that runs here."""
        if not isinstance(machine, CloudInstance):
            try:
                name: str = values.resolve(self._context, machine)
            except _UNKNOWN:
                self._whole = False
                return str(values.describe(machine))
            return ROBOT if name in self._on_robot else name
        try:
            spec = defaults.resolved(machine, self._overrides, self._context)
            if spec.provider == ROBOT:
                self._on_robot.add(spec.name)
                return ROBOT
            planned = self._planned(spec.name)
            if planned.spec is not None and planned.spec != spec:
                check_names([planned.spec, spec])
            planned.spec = spec
            return spec.name
        except _UNKNOWN as error:
            return self._refused(machine.name, f'{machine.provider}: ', error)

    def _refused(self, name: str, provider: str, error: Exception) -> str:
        self._whole = False
        planned = self._planned(name)
        planned.note = f'{provider}{error}'
        planned.error = error if isinstance(error, FogError) else None
        return name


def arguments(words: Sequence[str]) -> dict[str, str]:
    """
    Parse launch arguments.

    :raises ConfigurationError: one is not of the form ``NAME:=VALUE``.
    """
    mapping = {}
    for word in words:
        name, assigned, value = word.partition(':=')
        if not name or not assigned:
            raise ConfigurationError(f"'{word}' is no argument of a launch file",
                                     'write NAME:=VALUE')
        mapping[name] = value
    return mapping


def priced(
    machine: Planned, choices: Choices, provider: Callable[[str], Provider],
) -> Optional[Decimal]:
    """
    Check a machine and make its open choices as a launch would; return its price, if it is known.

    :raises FogError: a launch refuses the machine, nothing fits, or a cloud does not answer.
    """
    if machine.error is not None:
        raise machine.error
    if machine.spec is None:
        return None
    spec = dataclasses.replace(machine.spec, options=values.await_all(machine.spec.options))
    check_here(spec, provider(spec.provider), machine.programs, os.environ)
    machine.spec = choices.resolved(choices.places(spec)[0])
    return choices.price(machine.spec)


def _short(value: Any) -> str:
    if callable(value):
        return '(chosen at launch)'
    text = str(value)
    return text if len(text) <= _LONGEST else f'{text[:_LONGEST]}...'

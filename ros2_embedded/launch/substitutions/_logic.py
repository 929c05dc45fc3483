# SPDX-License-Identifier: Apache-2.0
"""Booleans and comparisons, as the texts 'true' and 'false'."""
from __future__ import annotations

import math
from typing import Any, cast, Iterable, List, Sequence

from ..frontend.expose import expose_substitution
from ..launch_context import LaunchContext
from ..some_substitutions_type import SomeSubstitutionsType
from ..substitution import Substitution
from ..utilities import normalize_to_list_of_substitutions, perform_substitutions
from ..utilities.type_utils import is_substitution, perform_typed_substitution
from ._values import arguments, Parsed, SubstitutionFailure


def _truth(context: LaunchContext, value: List[Substitution]) -> bool:
    try:
        return bool(perform_typed_substitution(context, value, bool))
    except (TypeError, ValueError) as exc:
        raise SubstitutionFailure(exc) from exc


def _text(truth: bool) -> str:
    return 'true' if truth else 'false'


@expose_substitution('not')
class NotSubstitution(Substitution):
    """Whether the value is false."""

    def __init__(self, value: SomeSubstitutionsType) -> None:
        super().__init__()
        self.__value = normalize_to_list_of_substitutions(value)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(not value)``."""
        return cls, arguments(data, 'not', 'value')

    @property
    def value(self) -> List[Substitution]:
        """The value."""
        return self.__value

    def describe(self) -> str:
        return f'NotSubstitution({self.value})'

    def perform(self, context: LaunchContext) -> str:
        return _text(not _truth(context, self.value))


class _TwoSided(Substitution):
    """Base of those with a left and a right side."""

    _name: str

    def __init__(self, left: Any, right: Any) -> None:
        super().__init__()
        self.__left = normalize_to_list_of_substitutions(left)
        self.__right = normalize_to_list_of_substitutions(right)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(name left right)``."""
        return cls, arguments(data, cls._name, 'left', 'right')

    @property
    def left(self) -> List[Substitution]:
        """The left side."""
        return self.__left

    @property
    def right(self) -> List[Substitution]:
        """The right side."""
        return self.__right

    def describe(self) -> str:
        return f'{type(self).__name__}({self.left} {self.right})'


@expose_substitution('and')
class AndSubstitution(_TwoSided):
    """Whether both sides are true; both are evaluated."""

    _name = 'and'

    def perform(self, context: LaunchContext) -> str:
        left, right = _truth(context, self.left), _truth(context, self.right)
        return _text(left and right)


@expose_substitution('or')
class OrSubstitution(_TwoSided):
    """Whether a side is true; both are evaluated."""

    _name = 'or'

    def perform(self, context: LaunchContext) -> str:
        left, right = _truth(context, self.left), _truth(context, self.right)
        return _text(left or right)


class _OfMany(Substitution):
    """Base of those with any number of arguments."""

    def __init__(self, *args: SomeSubstitutionsType) -> None:
        super().__init__()
        self.__args = [normalize_to_list_of_substitutions(arg) for arg in args]

    @classmethod
    def parse(cls, data: Iterable[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(name value ...)``."""
        return cls, {'args': data}

    @property
    def args(self) -> List[List[Substitution]]:
        """The values."""
        return self.__args

    def describe(self) -> str:
        return f"{type(self).__name__}({' '.join(str(arg) for arg in self.args)})"


@expose_substitution('any')
class AnySubstitution(_OfMany):
    """Whether one of the values is true."""

    def perform(self, context: LaunchContext) -> str:
        truths = [_truth(context, arg) for arg in self.args]
        return _text(any(truths))


@expose_substitution('all')
class AllSubstitution(_OfMany):
    """Whether all of the values are true."""

    def perform(self, context: LaunchContext) -> str:
        truths = [_truth(context, arg) for arg in self.args]
        return _text(all(truths))


def _comparable(side: Any) -> SomeSubstitutionsType:
    if is_substitution(side):
        return cast(SomeSubstitutionsType, side)
    if side is None:
        return ''
    return _text(side) if isinstance(side, bool) else str(side)


@expose_substitution('equals')
class EqualsSubstitution(_TwoSided):
    """Whether both sides are equal: as booleans, as numbers, or else as texts."""

    _name = 'equals'

    def __init__(self, left: Any, right: Any) -> None:
        super().__init__(_comparable(left), _comparable(right))

    def perform(self, context: LaunchContext) -> str:
        left = perform_substitutions(context, self.left)
        right = perform_substitutions(context, self.right)
        truths = {'true': True, '1': True, 'false': False, '0': False}
        if left.lower() in truths and right.lower() in truths:
            return _text(truths[left.lower()] == truths[right.lower()])
        try:
            return _text(math.isclose(float(left), float(right)))
        except ValueError:
            return _text(left == right)


@expose_substitution('not-equals')
class NotEqualsSubstitution(EqualsSubstitution):
    """Whether the sides differ."""

    _name = 'not-equals'

    def perform(self, context: LaunchContext) -> str:
        return _text(super().perform(context) != 'true')


@expose_substitution('if')
class IfElseSubstitution(Substitution):
    """One value if the condition is true, else the other."""

    def __init__(
        self, condition: SomeSubstitutionsType, if_value: SomeSubstitutionsType = '',
        else_value: SomeSubstitutionsType = ''
    ) -> None:
        super().__init__()
        if if_value == '' and else_value == '':
            raise RuntimeError('One of if_value and else_value must be specified')
        self._condition = normalize_to_list_of_substitutions(condition)
        self._if_value = normalize_to_list_of_substitutions(if_value)
        self._else_value = normalize_to_list_of_substitutions(else_value)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(if condition value [other])``."""
        return cls, arguments(data, 'if', 'condition', 'if_value', 'else_value', optional=1)

    @property
    def condition(self) -> List[Substitution]:
        """The condition."""
        return self._condition

    @property
    def if_value(self) -> List[Substitution]:
        """The value if it is true."""
        return self._if_value

    @property
    def else_value(self) -> List[Substitution]:
        """The value if it is false."""
        return self._else_value

    def describe(self) -> str:
        return f'IfElseSubstitution({self.condition}, {self.if_value}, {self.else_value})'

    def perform(self, context: LaunchContext) -> str:
        chosen = self.if_value if _truth(context, self.condition) else self.else_value
        return perform_substitutions(context, chosen)

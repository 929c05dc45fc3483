# SPDX-License-Identifier: Apache-2.0
"""Conditions of actions."""
from __future__ import annotations

from embedded_default.lacking import lacking

from .._base import Condition, SomeSubstitutionsType, Substitution
from ..launch_context import LaunchContext
from ..utilities import normalize_to_list_of_substitutions, perform_substitutions

__all__ = [
    'evaluate_condition_expression', 'IfCondition', 'InvalidConditionExpressionError',
    'UnlessCondition']
__getattr__ = lacking(__name__, 'LaunchConfigurationEquals LaunchConfigurationNotEquals')

_VALUES = {'true': True, '1': True, 'false': False, '0': False}


class InvalidConditionExpressionError(ValueError):
    pass


def evaluate_condition_expression(context: LaunchContext, expression: list[Substitution]) -> bool:
    """
    Return what the expression says: 'true' or '1', 'false' or '0', in upper or lower case.

    :raises InvalidConditionExpressionError: for anything else.
    """
    text = perform_substitutions(context, expression).strip().lower()
    if text not in _VALUES:
        origin = ' + '.join(str(sub) for sub in expression)
        raise InvalidConditionExpressionError(
            f"invalid condition expression, expected one of [{', '.join(_VALUES)}] "
            f"but got '{text}', expanded from '{origin}'")
    return _VALUES[text]


class IfCondition(Condition):

    def __init__(self, predicate_expression: SomeSubstitutionsType) -> None:
        self.__predicate_expression = normalize_to_list_of_substitutions(predicate_expression)
        super().__init__(predicate=self._predicate_func)

    def _predicate_func(self, context: LaunchContext) -> bool:
        return evaluate_condition_expression(context, self.__predicate_expression)


class UnlessCondition(IfCondition):

    def _predicate_func(self, context: LaunchContext) -> bool:
        return not super()._predicate_func(context)

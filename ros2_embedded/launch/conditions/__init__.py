# SPDX-License-Identifier: Apache-2.0
"""Conditions of actions."""
from __future__ import annotations

from typing import Iterable, List, Optional
import warnings

from .._aliases import alias_submodules
from .._base import Condition, SomeSubstitutionsType, Substitution
from ..launch_context import LaunchContext
from ..utilities import normalize_to_list_of_substitutions, perform_substitutions

__all__ = [
    'evaluate_condition_expression', 'IfCondition', 'InvalidConditionExpressionError',
    'LaunchConfigurationEquals', 'LaunchConfigurationNotEquals', 'UnlessCondition']

VALID_TRUE_EXPRESSIONS = ['true', '1']
VALID_FALSE_EXPRESSIONS = ['false', '0']


class InvalidConditionExpressionError(ValueError):

    def __init__(
        self, expression: str, unexpanded_expression: Iterable[Substitution],
        valid_expressions: List[str]
    ) -> None:
        origin = ' + '.join(str(sub) for sub in unexpanded_expression)
        super().__init__(
            f"invalid condition expression, expected one of [{', '.join(valid_expressions)}] "
            f"but got '{expression}', expanded from '{origin}'")


def evaluate_condition_expression(context: LaunchContext, expression: List[Substitution]) -> bool:
    """
    Return what the expression says: 'true' or '1', 'false' or '0', in upper or lower case.

    :raises InvalidConditionExpressionError: for anything else.
    """
    text = perform_substitutions(context, expression).strip().lower()
    if text in VALID_TRUE_EXPRESSIONS:
        return True
    if text in VALID_FALSE_EXPRESSIONS:
        return False
    raise InvalidConditionExpressionError(
        text, expression, VALID_TRUE_EXPRESSIONS + VALID_FALSE_EXPRESSIONS)


class IfCondition(Condition):

    def __init__(self, predicate_expression: SomeSubstitutionsType) -> None:
        self.__predicate_expression = normalize_to_list_of_substitutions(predicate_expression)
        super().__init__(predicate=self._predicate_func)

    def _predicate_func(self, context: LaunchContext) -> bool:
        return evaluate_condition_expression(context, self.__predicate_expression)


class UnlessCondition(IfCondition):

    def _predicate_func(self, context: LaunchContext) -> bool:
        return not super()._predicate_func(context)


class LaunchConfigurationEquals(Condition):
    """Holds if the launch configuration has that value, or, for None, doesn't exist."""

    def __init__(
        self, launch_configuration_name: str, expected_value: Optional[SomeSubstitutionsType]
    ) -> None:
        warnings.warn(
            "The 'LaunchConfigurationEquals' and 'LaunchConfigurationNotEquals' Conditions are "
            " deprecated. Use the 'EqualsSubstitution' and 'NotEqualsSubstitution' substitutions "
            'instead!', UserWarning, stacklevel=2)
        self.__name = launch_configuration_name
        self.__expected = None if expected_value is None else (
            normalize_to_list_of_substitutions(expected_value))
        super().__init__(predicate=self._predicate_func)

    def _predicate_func(self, context: LaunchContext) -> bool:
        expected = None if self.__expected is None else (
            perform_substitutions(context, self.__expected))
        return bool(context.launch_configurations.get(self.__name) == expected)


class LaunchConfigurationNotEquals(LaunchConfigurationEquals):

    def _predicate_func(self, context: LaunchContext) -> bool:
        return not super()._predicate_func(context)


alias_submodules(
    __name__, __all__, evaluate_condition_expression_impl=('evaluate_condition_expression',))

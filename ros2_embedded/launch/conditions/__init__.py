# SPDX-License-Identifier: Apache-2.0
"""Conditions of actions."""
from embedded_default.lacking import lacking

from .._base import evaluate_condition_expression as evaluate_condition_expression
from .._base import IfCondition as IfCondition
from .._base import InvalidConditionExpressionError as InvalidConditionExpressionError
from .._base import UnlessCondition as UnlessCondition

__getattr__ = lacking(__name__, 'LaunchConfigurationEquals LaunchConfigurationNotEquals')

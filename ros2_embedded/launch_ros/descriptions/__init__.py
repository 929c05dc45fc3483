# SPDX-License-Identifier: Apache-2.0
"""What nodes are made of."""
from launch._aliases import missing

from ..parameter_descriptions import Parameter, ParameterFile, ParameterValue
from .composable_node import ComposableNode

__all__ = ['ComposableNode', 'Parameter', 'ParameterFile', 'ParameterValue']


def __getattr__(name: str) -> object:
    missing(__name__, name)

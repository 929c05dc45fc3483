# SPDX-License-Identifier: Apache-2.0
"""What nodes are made of."""
from launch._aliases import missing

from .composable_node import ComposableNode
from ..parameter_descriptions import Parameter, ParameterFile, ParameterValue

__all__ = ['ComposableNode', 'Parameter', 'ParameterFile', 'ParameterValue']


def __getattr__(name: str) -> object:
    missing(__name__, name)

# SPDX-License-Identifier: Apache-2.0
"""Texts that are only known when the launch runs."""
from .._aliases import alias_submodules, missing
from ._logic import (
    AllSubstitution,
    AndSubstitution,
    AnySubstitution,
    EqualsSubstitution,
    IfElseSubstitution,
    NotEqualsSubstitution,
    NotSubstitution,
    OrSubstitution,
)
from ._system import Command, FileContent, FindExecutable, PythonExpression
from ._values import (
    AnonName,
    EnvironmentVariable,
    LaunchConfiguration,
    LaunchLogDir,
    LocalSubstitution,
    PathJoinSubstitution,
    SubstitutionFailure,
    TextSubstitution,
    ThisLaunchFile,
    ThisLaunchFileDir,
)

__all__ = [
    'AllSubstitution',
    'AndSubstitution',
    'AnySubstitution',
    'AnonName',
    'Command',
    'EqualsSubstitution',
    'EnvironmentVariable',
    'FileContent',
    'FindExecutable',
    'IfElseSubstitution',
    'LaunchConfiguration',
    'LaunchLogDir',
    'LocalSubstitution',
    'NotSubstitution',
    'NotEqualsSubstitution',
    'OrSubstitution',
    'PathJoinSubstitution',
    'PythonExpression',
    'SubstitutionFailure',
    'TextSubstitution',
    'ThisLaunchFile',
    'ThisLaunchFileDir',
]

alias_submodules(__name__, __all__, {'boolean_substitution': (
    'AllSubstitution', 'AndSubstitution', 'AnySubstitution', 'NotSubstitution',
    'OrSubstitution')})


def __getattr__(name: str) -> object:
    missing(__name__, name)

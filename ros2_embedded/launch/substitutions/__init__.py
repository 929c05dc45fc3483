# SPDX-License-Identifier: Apache-2.0
"""Texts that are only known when the launch runs."""
from ._logic import AllSubstitution, AndSubstitution, AnySubstitution, EqualsSubstitution
from ._logic import IfElseSubstitution, NotEqualsSubstitution, NotSubstitution, OrSubstitution
from ._system import Command, FileContent, FindExecutable, PythonExpression
from ._values import AnonName, EnvironmentVariable, LaunchConfiguration, LaunchLogDir
from ._values import LocalSubstitution, PathJoinSubstitution, SubstitutionFailure
from ._values import TextSubstitution, ThisLaunchFile, ThisLaunchFileDir
from .._aliases import alias_submodules, missing

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

# SPDX-License-Identifier: Apache-2.0
"""
Record the variables that a launch file sets, also to the value that they have already.

launch keeps no record: the ``execute`` methods of its actions are replaced. The record is a
launch configuration, because launch scopes these as it scopes the environment.
"""

from __future__ import annotations

from collections.abc import Mapping
import functools
import json
from typing import Any

from launch import LaunchContext
from launch.actions import AppendEnvironmentVariable, SetEnvironmentVariable
from launch.utilities import perform_substitutions

#: The launch configuration: the values by the variables' names, as JSON: users' code expects text.
_SET = 'fogros2_environment'


@functools.cache
def record() -> None:
    """Record the variables that actions set, from now on."""
    for cls in (SetEnvironmentVariable, AppendEnvironmentVariable):
        _replace(cls)


def _replace(cls: Any) -> None:
    before = cls.execute

    @functools.wraps(before)
    def execute(self: Any, context: LaunchContext) -> None:
        before(self, context)
        name = perform_substitutions(context, self.name)
        configurations = context.launch_configurations
        configurations[_SET] = json.dumps({
            **_values(context), name: context.environment.get(name)})

    cls.execute = execute


def _values(context: LaunchContext) -> Mapping[str, str]:
    values: Mapping[str, str] = json.loads(context.launch_configurations.get(_SET, '{}'))
    return values


def is_set(context: LaunchContext, name: str) -> bool:
    """Return whether the launch file has set a variable to its present value, in this scope."""
    values = _values(context)
    return name in values and values[name] == context.environment.get(name)

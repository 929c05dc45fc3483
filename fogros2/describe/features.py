# SPDX-License-Identifier: Apache-2.0
"""The keywords of features (:mod:`fogros2.feature`) in the descriptions of machines."""

from __future__ import annotations

from collections.abc import Mapping
import functools
from typing import Any

from fogros2 import plugin_system
from fogros2.describe.kinds import Keyword, marked, parameters_of
from fogros2.feature import GROUP, options


@functools.cache
def keywords() -> Mapping[str, Keyword]:
    """Return the keywords of all features."""
    return {name: keyword for feature in plugin_system.names(GROUP)
            for name, keyword in _keywords(feature).items()}


def _keywords(feature: str) -> Mapping[str, Keyword]:
    return parameters_of(plugin_system.load(GROUP, feature).options)


def own(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return those of some values by name that are of features, marked by their kinds.

    :raises ConfigurationError: a value has a wrong type, or is known already and wrong.
    """
    mine = {name: keyword for name, keyword in keywords().items() if name in values}
    result = marked(mine, values)
    for name in mine:
        if _is_plain(values[name]):
            by_feature({name: values[name]})
    return result


def _is_plain(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return all(isinstance(one, str) for one in value)
    return isinstance(value, (str, int, float))


def by_feature(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """
    Return the values of keywords by feature, as a MachineSpec has them; check them.

    :raises ConfigurationError: a value is wrong.
    """
    result = {}
    for feature in plugin_system.names(GROUP) if values else ():
        given = {name: values[name] for name in _keywords(feature) if name in values}
        if given:
            options(feature, given)
            result[feature] = given
    return result


def merged(
    first: Mapping[str, Mapping[str, Any]], second: Mapping[str, Mapping[str, Any]],
) -> dict[str, Mapping[str, Any]]:
    """Return the values of both; those of the second win."""
    return {feature: {**first.get(feature, {}), **second.get(feature, {})}
            for feature in {**first, **second}}

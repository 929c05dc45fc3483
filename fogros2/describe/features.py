# SPDX-License-Identifier: Apache-2.0
"""The keywords of features (:mod:`fogros2.feature`) in the descriptions of machines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from fogros2 import plugin_system
from fogros2.describe import values
from fogros2.describe.kinds import Keyword, marked, parameters_of
from fogros2.errors import ConfigurationError
from fogros2.feature import Feature, GROUP, options


def keywords(of: str = 'options') -> Mapping[str, Keyword]:
    """
    Return the keywords of all features.

    :param of: ``options``, or ``node_options`` for those of nodes.
    :raises ConfigurationError: two features have the same.
    """
    result: dict[str, Keyword] = {}
    for feature in plugin_system.names(GROUP):
        for name, keyword in _keywords(feature, of).items():
            if name in result:
                raise ConfigurationError(f"the feature '{feature}' and another have the same "
                                         f"keyword '{name}'", 'uninstall one of them')
            result[name] = keyword
    return result


def _keywords(feature: str, of: str) -> Mapping[str, Keyword]:
    return parameters_of(getattr(plugin_system.load(GROUP, feature), of))


def node_lists() -> Mapping[str, str]:
    """Return the keywords of nodes and groups that take a list, each with its element's name."""
    return {each.node_list[0]: each.node_list[1] for each in _installed() if each.node_list[0]}


def machine_lists() -> Mapping[str, tuple[str, Callable[..., Any]]]:
    """Return the keywords and the items of machines' lists by the elements' names."""
    return {each.machine_list[1]: (each.machine_list[0], each.item)
            for each in _installed() if each.machine_list[1]}


def containers() -> set[str]:
    """Return the keywords of machines and nodes that run containers on the machine."""
    return {keyword for each in _installed() for keyword in each.containers}


def _installed() -> list[type[Feature]]:
    return [plugin_system.load(GROUP, name) for name in plugin_system.names(GROUP)]


def take_lists(arguments: dict[str, Any]) -> dict[str, Any]:
    """Remove the features' lists from a node's arguments; return those with items by keyword."""
    return {keyword: list(items) for keyword in node_lists()
            if (items := arguments.pop(keyword, ()))}


def own(given: Mapping[str, Any], of: str = 'options') -> dict[str, Any]:
    """
    Return those of some values by name that are of features, marked by their kinds.

    :raises ConfigurationError: a value has a wrong type, or is known already and wrong.
    """
    mine = {name: keyword for name, keyword in keywords(of).items() if name in given}
    result = marked(mine, given)
    by_feature(values.known({name: value for name, value in result.items()
                             if values.is_known(value)}), of)
    return result


def by_feature(given: Mapping[str, Any], of: str = 'options') -> dict[str, dict[str, Any]]:
    """
    Return the values of keywords by feature, as a MachineSpec has them; check them.

    An empty text is what an argument of a launch file has without a value.

    :raises ConfigurationError: a value is wrong.
    """
    result = {}
    given = {name: value for name, value in given.items() if value is not None and value != ''}
    for feature in plugin_system.names(GROUP) if given else ():
        mine = {name: given[name] for name in _keywords(feature, of) if name in given}
        if mine:
            options(feature, mine, of)
            result[feature] = mine
    return result


def merged(
    first: Mapping[str, Mapping[str, Any]], second: Mapping[str, Mapping[str, Any]],
) -> dict[str, Mapping[str, Any]]:
    """Return the values of both; those of the second win."""
    return {feature: {**first.get(feature, {}), **second.get(feature, {})}
            for feature in {**first, **second}}

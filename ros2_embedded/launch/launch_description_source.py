# SPDX-License-Identifier: Apache-2.0
"""Where a launch description comes from."""
from __future__ import annotations

import traceback
from typing import Optional

import launch.logging

from .launch_context import LaunchContext
from .launch_description import LaunchDescription
from .some_substitutions_type import SomeSubstitutionsType
from .utilities import normalize_to_list_of_substitutions, perform_substitutions


class LaunchDescriptionSource:
    """
    A launch description, or the location to load it from.

    :param location: a path, or a word for where it came from.
    :param method: how it is loaded, in words.
    """

    def __init__(
        self, launch_description: Optional[LaunchDescription] = None,
        location: SomeSubstitutionsType = '<string>',
        method: str = 'unspecified mechanism from a script'
    ) -> None:
        self.__launch_description = launch_description
        self.__expanded_location: Optional[str] = None
        self.__location = normalize_to_list_of_substitutions(location)
        self.__method = method
        self.__logger = launch.logging.get_logger(__name__)

    def try_get_launch_description_without_context(self) -> Optional[LaunchDescription]:
        """Return the description, or None where loading it fails without a context."""
        if self.__launch_description is not None:
            return self.__launch_description
        try:
            return self._get_launch_description(
                perform_substitutions(LaunchContext(), self.__location))
        except Exception as exc:  # noqa: BLE001 - A launch file can raise anything.
            self.__logger.debug(traceback.format_exc())
            self.__logger.debug(f'Failed to load the launch file without a context: {exc}')
        return None

    def get_launch_description(self, context: LaunchContext) -> LaunchDescription:
        """Return the description, loaded once."""
        if self.__expanded_location is None:
            self.__expanded_location = perform_substitutions(context, self.__location)
        if self.__launch_description is None:
            self.__launch_description = self._get_launch_description(self.__expanded_location)
        return self.__launch_description

    def _get_launch_description(self, location: str) -> LaunchDescription:
        raise RuntimeError(
            'LaunchDescriptionSource.get_launch_description(): '
            'called without launch description being set')

    @property
    def location(self) -> str:
        """The location; before it is known, its substitutions in words."""
        if self.__expanded_location is None:
            return ' + '.join(str(sub) for sub in self.__location)
        return self.__expanded_location

    @property
    def method(self) -> str:
        """How the description is loaded, in words."""
        return self.__method

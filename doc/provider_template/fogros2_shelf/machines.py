# SPDX-License-Identifier: Apache-2.0
"""The class that launch files use."""

from __future__ import annotations

from typing import Any, Optional, TYPE_CHECKING

from fogros2 import CloudInstance
from fogros2.describe.kinds import options_of

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType


class ShelfInstance(CloudInstance):
    """
    A free computer of the shelf.

    :param folder: the shelf's folder, with a JSON file for each computer.
    :param user: login user.
    """

    provider = 'shelf'

    def __init__(
        self, folder: Optional[SomeSubstitutionsType] = None,
        user: Optional[SomeSubstitutionsType] = None, **common: Any,
    ) -> None:
        super().__init__(options=options_of(ShelfInstance.__init__, locals()), **common)

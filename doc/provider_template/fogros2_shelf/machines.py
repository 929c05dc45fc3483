# SPDX-License-Identifier: Apache-2.0
"""The class that launch files use."""

from typing import Any, Optional

from fogros2 import CloudInstance


class ShelfInstance(CloudInstance):
    """
    A free computer of the shelf.

    :param folder: the shelf's folder, with a JSON file for each computer.
    :param user: login user.
    """

    provider = 'shelf'

    def __init__(
        self, folder: Optional[str] = None, user: Optional[str] = None, **common: Any,
    ) -> None:
        super().__init__(options={'folder': folder, 'user': user}, **common)

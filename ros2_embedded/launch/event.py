# SPDX-License-Identifier: Apache-2.0
"""Base of all events."""


class Event:
    """Something that happened or shall happen; handlers are asked in turn whether they match."""

    name = 'launch.Event'

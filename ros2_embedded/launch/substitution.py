# SPDX-License-Identifier: Apache-2.0
"""Base of all substitutions."""
from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .launch_context import LaunchContext


class Substitution:
    """A text that is only known when the launch runs."""

    def describe(self) -> str:
        """Return a description for humans."""
        return repr(self)

    def perform(self, context: LaunchContext) -> str:
        """Return the text, in the given context."""
        raise NotImplementedError('perform() not implemented for Substitution base class.')

# SPDX-License-Identifier: Apache-2.0
"""What can be executed."""
from .executable import Executable

__all__ = ['Executable']

# SPDX-License-Identifier: Apache-2.0
"""What turns XML, YAML and other files into launch descriptions."""
from . import type_utils
from .entity import Entity
from .expose import expose_action, expose_substitution
from .parser import InvalidFrontendLaunchFileError, Parser

__all__ = [
    'Entity',
    'InvalidFrontendLaunchFileError',
    'Parser',
    'expose_action',
    'expose_substitution',
    'type_utils',
]

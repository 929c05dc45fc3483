# SPDX-License-Identifier: Apache-2.0
"""What turns XML, YAML and other files into launch descriptions."""
from .._aliases import alias_submodules
from . import type_utils
from .expose import expose_action, expose_substitution
from .parser import InvalidFrontendLaunchFileError, Parser
from .type_utils import Entity

__all__ = [
    'Entity', 'InvalidFrontendLaunchFileError', 'Parser', 'expose_action', 'expose_substitution',
    'type_utils']

alias_submodules(__name__, ('Entity',))

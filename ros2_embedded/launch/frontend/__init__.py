# SPDX-License-Identifier: Apache-2.0
"""What turns XML, YAML and other files into launch descriptions."""
from . import type_utils as type_utils
from .expose import expose_action as expose_action
from .expose import expose_substitution as expose_substitution
from .parser import InvalidFrontendLaunchFileError as InvalidFrontendLaunchFileError
from .parser import Parser as Parser
from .type_utils import Entity as Entity

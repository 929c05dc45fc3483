# SPDX-License-Identifier: Apache-2.0
"""What a launch can do."""
from embedded_default.lacking import lacking

from ._simple import *  # noqa: F403
from ._structure import *  # noqa: F403
from .execute_local import ExecuteLocal as ExecuteLocal
from .execute_process import ExecuteProcess as ExecuteProcess

__getattr__ = lacking(__name__, 'OpaqueCoroutine UnregisterEventHandler')

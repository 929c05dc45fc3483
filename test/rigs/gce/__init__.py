# SPDX-License-Identifier: Apache-2.0
"""
Compute Engine in a box, for tests of what uses Google Cloud: see :class:`GceBox`.

``box`` is what a test holds, ``loopback`` an API without computers, ``server`` the process behind
a box. The API: ``discovery`` (Google's description of it), ``errors``, ``filters``, ``catalogue``
(zones, types, images), ``resources`` (instances, firewall rules, images, operations), ``api``. It
is in front of ``rigs.computers`` (``cloud``, ``metadata``).
"""

from rigs.computers.box import Call, Instance
from rigs.gce.box import GceBox

__all__ = ['Call', 'GceBox', 'Instance']

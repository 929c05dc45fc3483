# SPDX-License-Identifier: Apache-2.0
"""
Azure in a box, for tests of what uses Azure: see :class:`AzureBox`.

``service`` is Azure Resource Manager in memory, with what ``catalogue`` sells; ``schema`` compares
requests with the models of Azure's SDK. ``cloud`` and ``metadata`` are the computers behind it,
``server`` the process that has all of it, ``box`` what a test holds.
"""

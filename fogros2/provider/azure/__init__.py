# SPDX-License-Identifier: Apache-2.0
"""
Virtual machines of Azure, by its REST API.

In reading order: ``login``, ``options``, ``failures`` (Azure's refusals), ``account``
(requests), ``machines`` (requests and reports by value), ``ending``, ``prices``, ``images``,
``disks``,
``cloud`` (the adapter), ``provider``.
"""

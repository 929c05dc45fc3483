# SPDX-License-Identifier: Apache-2.0
"""
Google Compute Engine, by its REST API.

In reading order: ``login``, ``options``, ``guest`` (commands on the machine), ``failures``
(Google's refusals), ``account`` (requests), ``instances``, ``disks``, ``firewall``, ``images``,
``prices``,
``cloud`` (the adapter), ``provider``.
"""

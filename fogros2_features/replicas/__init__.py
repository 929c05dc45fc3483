# SPDX-License-Identifier: Apache-2.0
"""
Replicas: the action ``Replicated``, and its element of XML and YAML.

In reading order: ``starting`` checks a group, starts the node ``first_answer`` of
``fogros2_replicas`` and tells it of ended processes, ``action`` has the action, ``parsing`` reads
the element, and ``elements`` registers it with launch. ``feature`` shows their figures.
"""

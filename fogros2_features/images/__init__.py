# SPDX-License-Identifier: Apache-2.0
"""
Images of machines, from which later machines start.

In reading order: ``keepers`` (providers that keep images), ``baking`` makes, lists and deletes
them, ``pods`` builds an image for pods, and ``verbs`` has the verb of ``ros2 fog``.
"""

# SPDX-License-Identifier: Apache-2.0
"""
Features of machines, each a module with one :class:`fogros2.feature.Feature`.

``replicas`` is an action, and ``hosts`` a provider.
"""

# SPDX-License-Identifier: Apache-2.0
"""
Features of machines, each a module with one :class:`fogros2.feature.Feature`.

``replicas`` alone is an action and no feature.
"""

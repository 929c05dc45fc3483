# SPDX-License-Identifier: Apache-2.0
"""
Features of machines, each a module or package with one :class:`fogros2.feature.Feature`.

``images`` and ``prices`` have verbs, ``hosts`` and ``prices`` a provider, ``replicas`` an action.
"""

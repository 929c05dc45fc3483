# SPDX-License-Identifier: Apache-2.0
"""Add the element ``<replicated>`` to launch files of XML and YAML."""

from fogros2.actions.frontend.elements import expose

expose('replicated', 'fogros2_features.replicas.parsing')

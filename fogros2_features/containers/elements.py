# SPDX-License-Identifier: Apache-2.0
"""Add the element ``<docker_container>`` to launch files of XML and YAML."""

from fogros2.actions.frontend.elements import expose

expose('docker_container', 'fogros2_features.containers.parsing')

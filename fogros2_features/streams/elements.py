# SPDX-License-Identifier: Apache-2.0
"""Add the element ``<stream_topic>`` to launch files of XML and YAML."""

from fogros2.actions.frontend.elements import expose

expose('stream_topic', 'fogros2_features.streams.parsing')

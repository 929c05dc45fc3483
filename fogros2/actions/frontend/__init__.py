# SPDX-License-Identifier: Apache-2.0
"""
Read machines, cloud nodes and cloud groups in launch files of XML and YAML.

In reading order: ``entity`` reads attributes, ``actions`` has actions that only XML and YAML need,
``parsing`` reads each element, ``elements`` registers them with launch.
"""

# SPDX-License-Identifier: Apache-2.0
"""The node that verbs look at the graph with."""

NODE_NAME_PREFIX = '_ros2cli'

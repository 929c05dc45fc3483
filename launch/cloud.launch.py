# SPDX-License-Identifier: Apache-2.0
"""Runs the nodes of a cloud machine; started there by the agent, not by people."""

from fogros2.cloud_launch import generate_launch_description

__all__ = ['generate_launch_description']

# SPDX-License-Identifier: Apache-2.0
"""Nodes and launch files to start from."""

# SPDX-License-Identifier: Apache-2.0
"""Example nodes and launch files."""

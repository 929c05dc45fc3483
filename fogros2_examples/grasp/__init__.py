# SPDX-License-Identifier: Apache-2.0
"""Grasp planning from depth images: the planner's node, a camera over a bin, and their code."""

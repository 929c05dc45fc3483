# SPDX-License-Identifier: Apache-2.0
"""Motion planning of rigid bodies: the planner's node, its client, and their code."""

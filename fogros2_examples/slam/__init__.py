# SPDX-License-Identifier: Apache-2.0
"""Visual SLAM from a stereo or RGB-D camera: algorithm, nodes, synthetic room, evaluation."""

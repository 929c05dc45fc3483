# SPDX-License-Identifier: Apache-2.0
"""
Transport point clouds over thin links, by a codec without ROS and two nodes.

``cloud`` describes point clouds, ``numbers`` codes columns of numbers. ``ranges`` predicts
organised scans as range images, ``codec`` codes clouds. ``message`` converts ROS messages,
``control`` adapts the resolution to the links. ``encoder`` and ``decoder`` are the nodes, which
share their base and the slices with ``image_transport_h264``.
"""

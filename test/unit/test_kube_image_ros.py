# SPDX-License-Identifier: Apache-2.0
"""Which ROS 2 the machine images of the tests' cluster get."""

from __future__ import annotations

import os

from rigs.cluster import ros


def test_ros_prefix_is_the_one_with_the_middleware(tmp_path):
    overlay, underlay = tmp_path / 'overlay', tmp_path / 'jazzy'
    (overlay / 'share').mkdir(parents=True)
    index = underlay / 'share/ament_index/resource_index/rmw_typesupport'
    index.mkdir(parents=True)
    environment = {'AMENT_PREFIX_PATH': f'{overlay}:{underlay}'}
    assert ros.prefix(environment) is None
    (index / 'rmw_cyclonedds_cpp').touch()
    assert ros.prefix(environment) == underlay
    assert ros.prefix({}) is None


def test_an_image_is_made_anew_when_something_is_installed(tmp_path):
    (tmp_path / 'share').mkdir()
    os.utime(tmp_path / 'share', (1, 1))
    before = ros.key(tmp_path)
    assert ros.key(tmp_path) == before
    (tmp_path / 'share' / 'turtlesim').mkdir()
    assert ros.key(tmp_path) != before

# SPDX-License-Identifier: Apache-2.0
"""Tests that hold for ROS 2 and for the embedded default alike."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from rigs.domains import taken


@pytest.fixture(autouse=True, scope='module')
def ros_of_this_computer() -> Iterator[None]:
    """
    Let nodes see no others.

    They use no shared memory either: Fast DDS writes errors to stdout where a process of another
    network namespace has the same port in /dev/shm.
    """
    with pytest.MonkeyPatch.context() as patch, taken() as domain:
        patch.setenv('ROS_DOMAIN_ID', domain)
        patch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE',
                     str(Path(__file__).with_name('loopback.xml')))
        for name in ('RMW_IMPLEMENTATION', 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_STATIC_PEERS',
                     'ROS_LOCALHOST_ONLY'):
            patch.delenv(name, raising=False)
        patch.setenv('RCUTILS_COLORIZED_OUTPUT', '0')
        yield


@pytest.fixture
def own_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let launch log into the test's folder, and leave its parameter files there."""
    import launch.logging
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    launch.logging.reset()
    yield
    launch.logging.reset()

# SPDX-License-Identifier: Apache-2.0
"""``make cloud-check PROVIDER=kubernetes`` by a user of a real cluster."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

import pytest

from rigs.cluster import READY

PROGRAM = Path(__file__).resolve().parents[3] / 'tools' / 'cloud_check.py'


@pytest.mark.usefixtures('nothing_left')
def test_check_runs_the_talker_in_a_pod_and_deletes_it(kubernetes, namespace, tmp_path):
    if reason := kubernetes.why_not_ready:
        pytest.skip(reason)
    done = subprocess.run(
        [sys.executable, str(PROGRAM), 'kubernetes', '--options', f'container_image={READY}'],
        env={**os.environ, 'YES': '1', 'ROS_LOG_DIR': str(tmp_path)}, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'the provider names no price' in done.stdout
    assert 'kubernetes works: 5 messages arrived, and nothing is left.' in done.stdout
    assert namespace.left() == []

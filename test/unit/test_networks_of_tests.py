# SPDX-License-Identifier: Apache-2.0
"""Which container networks a run of the tests removes."""

from __future__ import annotations

import json
import os

from fogros2.store import process_start
from rigs.networks import abandoned, LABEL


def test_networks_of_ended_runs_are_removed() -> None:
    pid, start = os.getpid(), process_start(os.getpid())
    assert start is not None
    assert abandoned(json.dumps([
        {'name': 'podman'}, {'name': 'of-a-user', 'labels': {'pid': '1-1'}},
        {'name': 'none', 'labels': None}, {'name': 'own', 'labels': {LABEL: f'{pid}-{start}'}},
        {'name': 'before', 'labels': {LABEL: f'{pid}-{start - 1}'}}])) == ['before']

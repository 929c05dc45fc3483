# SPDX-License-Identifier: Apache-2.0
"""The start of a bridge on a machine; ``security/test_websites.py`` has what it leads to."""

from __future__ import annotations

import sys

import pytest

serve = pytest.importorskip(
    'fogros2_monitor.serve', reason='rclpy is not installed')


def test_unwritable_token_folder_is_named(tmp_path, monkeypatch):
    (tmp_path / 'file').touch()
    monkeypatch.setattr(sys, 'argv', ['bridge', '--secrets', f'{tmp_path}/file/secrets'])
    with pytest.raises(SystemExit, match='its token to .*\n--secrets names another folder'):
        serve.main()

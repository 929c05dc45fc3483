# SPDX-License-Identifier: Apache-2.0
"""Asserts of the contracts are explained."""

from __future__ import annotations

import pytest

pytest.register_assert_rewrite(
    'fogros2.testing.provider_contract', 'fogros2.testing.shell_contract')

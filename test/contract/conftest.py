# SPDX-License-Identifier: Apache-2.0
"""Asserts of the contracts are explained."""

from __future__ import annotations

import pytest

pytest.register_assert_rewrite(
    'fogros2_testing.provider_contract', 'fogros2_testing.shell_contract')

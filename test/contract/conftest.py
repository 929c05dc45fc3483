# SPDX-License-Identifier: Apache-2.0
"""Lets pytest explain the asserts of the contracts as it explains a test's own."""

import pytest

pytest.register_assert_rewrite(
    'fogros2.testing.provider_contract', 'fogros2.testing.shell_contract')

# SPDX-License-Identifier: Apache-2.0
"""
Fakes and contracts, for the tests of those who write plugins, and for ours.

A provider's author subclasses :class:`ProviderContract`, gives it a ``make`` method, and pytest
runs the contract against the real thing; likewise :class:`ShellContract`. The fakes pass the same
suites, so a test that uses them holds for the real ones.
"""

from fogros2.testing.fakes import FakeClock, FakeProvider, FakeShell, FakeStream
from fogros2.testing.provider_contract import ProviderContract, request_for
from fogros2.testing.shell_contract import ShellContract

__all__ = [
    'FakeClock', 'FakeProvider', 'FakeShell', 'FakeStream', 'ProviderContract', 'ShellContract',
    'request_for',
]

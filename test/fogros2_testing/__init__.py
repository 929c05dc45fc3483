# SPDX-License-Identifier: Apache-2.0
"""
Fakes and contracts for the tests of plugin authors, and for our own tests.

A provider's author subclasses :class:`ProviderContract` and writes its method ``make``; pytest
then runs the contract against the provider. :class:`VmContract` has more tests, for a cloud of
virtual machines whose service a test can disturb. :class:`ShellContract` works the same way.
``FakeProvider`` passes the same contract; ``FakeShell`` runs no command. ``FakeRunning`` is a
machine for tests of features.
"""

from fogros2_testing.fakes import FakeProvider, FakeRunning, FakeShell, FakeStream, FakeVpn
from fogros2_testing.provider_contract import ProviderContract, request_for
from fogros2_testing.shell_contract import ShellContract
from fogros2_testing.vm_contract import VmContract

__all__ = [
    'FakeProvider', 'FakeRunning', 'FakeShell', 'FakeStream', 'FakeVpn', 'ProviderContract',
    'ShellContract', 'VmContract', 'request_for',
]

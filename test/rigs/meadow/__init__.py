# SPDX-License-Identifier: Apache-2.0
"""
Meadow, a made-up service of virtual machines: proves that doc/developers/providers_vm.md suffices.

``server`` is the service over HTTP; ``provider`` is its provider, written from that page.
"""

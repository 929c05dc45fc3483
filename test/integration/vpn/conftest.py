# SPDX-License-Identifier: Apache-2.0
"""The network of these tests."""

from __future__ import annotations

from rigs.vpn_lab import lab, middleware, vpn

__all__ = ['lab', 'middleware', 'vpn']

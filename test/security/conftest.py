# SPDX-License-Identifier: Apache-2.0
"""The network of the attacks on DDS."""

from __future__ import annotations

from rigs.vpn_lab import lab, middleware, vpn

__all__ = ['lab', 'middleware', 'vpn']

# SPDX-License-Identifier: Apache-2.0
"""Machines at AWS: EC2 instances, found, priced, made, baked into images and ended by boto3."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from fogros2.provider.aws.provider import AWSProvider

__all__ = ['AWSProvider']


def __getattr__(name: str) -> Any:
    """Return the provider; what only looks at prices or regions doesn't load it."""
    if name == 'AWSProvider':
        from fogros2.provider.aws.provider import AWSProvider
        return AWSProvider
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')

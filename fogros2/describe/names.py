# SPDX-License-Identifier: Apache-2.0
"""Generate names for machines without a name."""

from __future__ import annotations

import os

_ADJECTIVES = (
    'amber', 'bold', 'brisk', 'calm', 'clear', 'cloudy', 'crisp', 'dewy', 'early', 'fresh',
    'gentle', 'golden', 'hazy', 'keen', 'light', 'lofty', 'lucid', 'mellow', 'misty', 'nimble',
    'quiet', 'rapid', 'rosy', 'silver', 'steady', 'still', 'sunny', 'swift', 'tidy', 'vivid',
    'warm', 'windy')
_NOUNS = (
    'badger', 'beaver', 'bison', 'crane', 'curlew', 'dipper', 'eagle', 'egret', 'falcon',
    'finch', 'gannet', 'heron', 'ibex', 'kestrel', 'lark', 'lynx', 'marten', 'merlin', 'osprey',
    'otter', 'petrel', 'plover', 'puffin', 'raven', 'robin', 'sable', 'seal', 'skylark', 'swift',
    'tern', 'walrus', 'wren')


def two_words() -> str:
    """Return a new random name, such as 'misty-otter-3fa2'."""
    first, second, *number = os.urandom(4)
    return (f'{_ADJECTIVES[first % len(_ADJECTIVES)]}-{_NOUNS[second % len(_NOUNS)]}-'
            f'{bytes(number).hex()}')

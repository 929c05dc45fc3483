# SPDX-License-Identifier: Apache-2.0
"""Store tags as labels of a cloud that restricts their characters and their length."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import re


@dataclasses.dataclass(frozen=True)
class LabelRules:
    """
    What a cloud accepts as the value of a label; keys of FogROS2 are valid everywhere.

    A character that is not accepted is stored as ``_`` and its code in hexadecimal digits with
    another ``_``. A long value is split over labels with the keys ``key``, ``key_1``, ``key_2``.

    :param plain: characters that are accepted as they are, as in a regular expression's ``[]``;
        the digits, the letters a to f, and ``_`` must be accepted. ``_`` itself is always coded.
    :param longest: maximum length of a value.
    """

    plain: str = 'a-z0-9-'
    longest: int = 63

    def encode(self, tags: Mapping[str, str]) -> dict[str, str]:
        """Return tags as labels."""
        labels: dict[str, str] = {}
        for key, value in tags.items():
            coded = re.sub(f'[^{self.plain}]', lambda match: f'_{ord(match[0]):x}_', value)
            parts = [coded[start:start + self.longest]
                     for start in range(0, len(coded), self.longest)] or ['']
            labels.update((f'{key}_{index}' if index else key, part)
                          for index, part in enumerate(parts))
        return labels

    def decode(self, labels: Mapping[str, str]) -> dict[str, str]:
        """Return the tags that ``encode`` stored."""
        tags: dict[str, str] = {}
        for key in labels:
            if self._continues(key, labels):
                continue
            coded, index = labels[key], 1
            while self._continues(f'{key}_{index}', labels):
                coded += labels[f'{key}_{index}']
                index += 1
            # no other number is a character's
            tags[key] = re.sub('_([0-9a-f]{1,5}|10[0-9a-f]{4})_',
                               lambda match: chr(int(match[1], 16)), coded)
        return tags

    def _continues(self, key: str, labels: Mapping[str, str]) -> bool:
        """Return whether a label continues a value; a user's own ``team_1`` need not."""
        base, _, number = key.rpartition('_')
        if key not in labels or not number.isdecimal():
            return False
        before = base if number == '1' else f'{base}_{int(number) - 1}'
        return len(labels.get(before, '')) == self.longest

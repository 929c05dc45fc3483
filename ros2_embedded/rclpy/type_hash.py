# SPDX-License-Identifier: Apache-2.0
"""Type hashes."""

from dataclasses import dataclass


@dataclass
class TypeHash:
    """A type's hash: version 1 is RIHS01, 32 bytes."""

    version: int = -1
    value: bytes = bytes(32)

    def __str__(self) -> str:
        if self.version != 1 or len(self.value) != 32:
            return 'INVALID'
        return f'RIHS{self.version:02}_{self.value.hex()}'

    @classmethod
    def _parse(cls, text: str | None) -> 'TypeHash':
        if not text or not text.startswith('RIHS01_') or len(text) != 71:
            return cls()
        try:
            return cls(1, bytes.fromhex(text[7:]))
        except ValueError:
            return cls()

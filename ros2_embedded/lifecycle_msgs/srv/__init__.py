# SPDX-License-Identifier: Apache-2.0
from typing import Any

from rosidl_embedded import importer


def __getattr__(name: str) -> Any:
    return importer.contents(__name__) if name == '__all__' else importer.interface(__name__, name)


def __dir__() -> list[str]:
    return importer.contents(__name__)

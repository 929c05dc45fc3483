# SPDX-License-Identifier: Apache-2.0
"""What is accepted as remappings of a node, and what becomes of that."""
from typing import Iterable, Tuple

from launch import SomeSubstitutionsType, Substitution

SomeRemapRule = Tuple[SomeSubstitutionsType, SomeSubstitutionsType]
SomeRemapRules = Iterable[SomeRemapRule]
RemapRule = Tuple[Tuple[Substitution, ...], Tuple[Substitution, ...]]
RemapRules = Iterable[RemapRule]

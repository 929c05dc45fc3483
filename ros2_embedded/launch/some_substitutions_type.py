# SPDX-License-Identifier: Apache-2.0
"""What is accepted where a text or substitutions are expected."""
import collections.abc
from typing import Iterable, Union

from .substitution import Substitution

SomeSubstitutionsType = Union[str, Substitution, Iterable[Union[str, Substitution]]]
SomeSubstitutionsType_types_tuple = (str, Substitution, collections.abc.Iterable)

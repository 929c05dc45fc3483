# SPDX-License-Identifier: Apache-2.0
"""What is accepted as parameters of a node, and what becomes of that."""
from typing import Any, Mapping, Sequence

#: Files (texts with substitutions, paths, ParameterFile), Parameter and dictionaries.
SomeParameters = Sequence[Any]
SomeParametersDict = Mapping[Any, Any]
#: ParameterFile, Parameter, and dictionaries of values by tuples of substitutions.
Parameters = Sequence[Any]
ParametersDict = dict[tuple[Any, ...], Any]
#: Paths, Parameter, and dictionaries of values by name.
EvaluatedParameters = Sequence[Any]

# SPDX-License-Identifier: Apache-2.0
"""Types as launch files name them."""
from typing import Any, List

from ..utilities.type_utils import is_typing_list
from .entity import Entity

_TYPES = {
    'str': str,
    'bool': bool,
    'float': float,
    'int': int,
    'list_of_str': List[str],
    'list_of_bool': List[bool],
    'list_of_float': List[float],
    'list_of_int': List[int],
    'yaml': None,
}


def check_is_list_entity(data_type: Any) -> bool:
    """Say whether it is ``List[Entity]``, or of a class derived from that."""
    if not is_typing_list(data_type):
        return False
    kind = data_type.__args__[0]
    return isinstance(kind, type) and issubclass(kind, Entity)


def get_data_type_from_identifier(type_identifier: str) -> Any:
    """
    Return the type of that name; None for 'yaml'.

    :raises ValueError: if there is none.
    """
    if type_identifier not in _TYPES:
        raise ValueError(f"Got invalid type identifier '{type_identifier}'")
    return _TYPES[type_identifier]

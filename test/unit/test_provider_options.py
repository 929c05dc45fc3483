# SPDX-License-Identifier: Apache-2.0
"""Tests of reading a provider's options: values in, values out."""

from __future__ import annotations

import pytest

from fogros2.errors import ConfigurationError
from fogros2.provider.options import convert


@pytest.mark.parametrize(('value', 'default', 'result'), [
    ('a', '', 'a'), (7, '', '7'), (2, 1.0, 2.0), (['a', 'b'], (), ('a', 'b')),
    (30, 8, 30), ('30', 8, 30), (0, 8, 0), (True, False, True), ('True', False, True),
    ('false', True, False), ({'a': 'b'}, {}, {'a': 'b'})])
def test_a_value_comes_in_the_kind_of_its_default(value, default, result):
    found = convert('x', value, default)
    assert found == result and type(found) is type(result)


@pytest.mark.parametrize(('value', 'default', 'expected'), [
    (True, '', 'a string'), ('a', (), 'a list of strings'), (-1.0, 1.0, 'a number above 0'),
    (float('inf'), 1.0, 'a number above 0'), (float('nan'), 1.0, 'a number above 0'),
    ('²', 8, 'a whole number'),
    ('many', 8, 'a whole number'), (True, 8, 'a whole number'), (1.5, 8, 'a whole number'),
    ('yes', False, 'True or False'), (1, False, 'True or False'),
    ({'a': 1}, {}, 'names and strings')])
def test_another_kind_is_refused_by_name(value, default, expected):
    with pytest.raises(ConfigurationError, match=f"'x' can't be .*{expected}"):
        convert('x', value, default)

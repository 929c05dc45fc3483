# SPDX-License-Identifier: Apache-2.0
"""The one check of text from elsewhere: names, numbers, JSON."""

from __future__ import annotations

from typing import Any, Literal, Optional, TypedDict

import pytest

from fogros2 import untrusted
from fogros2.untrusted import InvalidMessage


@pytest.mark.parametrize('name', ['fog', '_apt', 'ec2-user', 'robot_1', 'a' * 32])
def test_name_of_an_account_is_returned(name: str) -> None:
    assert untrusted.matched(untrusted.NAME, name) == name


@pytest.mark.parametrize('name', [
    '', 'Fog', '-oProxyCommand=x', "x' -o ProxyCommand='x", 'a b', 'fog\n', 'a/b', 'fög', '1a',
    'a' * 33, None, 7, ['fog']])
def test_other_name_is_refused(name: object) -> None:
    with pytest.raises(InvalidMessage):
        untrusted.matched(untrusted.NAME, name)


@pytest.mark.parametrize(('text', 'value'), [('0', 0), ('-7', -7), ('9' * 20, 10 ** 20 - 1)])
def test_number_is_returned(text: str, value: int) -> None:
    assert untrusted.number(text) == value


@pytest.mark.parametrize('text', ['', '-', 'x', '1.5', '1_0', ' 1', '٣', '²', '9' * 21, '--1'])
def test_other_number_is_refused(text: str) -> None:
    with pytest.raises(InvalidMessage):
        untrusted.number(text)


@pytest.mark.parametrize(('text', 'value'), [
    ('', ''), ('192.0.2.1', '192.0.2.1'), ('2001:DB8::1', '2001:db8::1')])
def test_address_is_returned(text: str, value: str) -> None:
    assert untrusted.address(text) == value


@pytest.mark.parametrize('text', [
    'localhost', '192.0.2.1/24', '192.0.2.1 ', '192.0.2.256', '-oProxyCommand=x', 'fe80::1%x y'])
def test_other_address_is_refused(text: str) -> None:
    with pytest.raises(InvalidMessage):
        untrusted.address(text)


class Part(TypedDict):
    number: int


class Whole(TypedDict, total=False):
    parts: list[Part]
    names: dict[str, str]
    size: Optional[float]
    kind: Literal['a', 'b']


def test_json_of_a_type_is_returned_without_control_characters() -> None:
    text = ('{"parts": [{"number": -9007199254740992, "new": [[]]}], "size": null, '
            '"names": {"\\u001b[a": "\\u001b[2Jb"}, "kind": "a"}')
    assert untrusted.parsed(text, Whole) == {
        'parts': [{'number': -untrusted.LARGEST, 'new': [[]]}], 'size': None,
        'names': {'\ufffd[a': '\ufffd[2Jb'}, 'kind': 'a'}
    assert untrusted.parsed(text.encode()) == untrusted.parsed(text)


@pytest.mark.parametrize(('text', 'why'), [
    ('{"size": -Infinity}', "field 'size': a number out of range"),
    ('{"size": 1e999}', "field 'size': a number out of range"),
    ('{"parts": [{"number": %s}]}' % ('9' * 5000), "field 'number': a number out of range"),
    ('{"parts": [{"number": 9007199254740993}]}', "field 'parts.number': expected int, got a nu"),
    ('{"parts": [{"number": 1.5}]}', "field 'parts.number': expected int, got float"),
    ('{"parts": [{"number": true}]}', "field 'parts.number': expected int, got bool"),
    ('{"parts": [{"number": null}]}', "field 'parts.number': expected int, got NoneType"),
    ('{"parts": [{}]}', "field 'parts.number' is missing"),
    ('{"parts": {}}', "field 'parts': expected list, got dict"),
    ('{"names": {"a": 1}}', "field 'names': expected str, got int"),
    ('{"kind": "c"}', "field 'kind': expected"),
    ('[]', "field '': expected Whole, got list"),
    ('[' * 200_000, 'no JSON'), ('', 'no JSON'), ('[' * 40 + ']' * 40, 'too deep'),
    ('"%s"' % ('x' * untrusted.LONGEST), 'characters of JSON')], ids=lambda text: text[:20])
def test_other_json_is_refused(text: str, why: str) -> None:
    with pytest.raises(InvalidMessage, match=why):
        untrusted.parsed(text, Whole)


@pytest.mark.parametrize('data', [b'"\xff\xfe"', b'"\\ud800"'])
def test_json_that_is_no_text_becomes_text(data: bytes) -> None:
    found: Any = untrusted.parsed(data, str)
    assert found.encode() and '\ufffd' in found


@pytest.mark.parametrize('text', [
    'Température\u202f: 25\xa0°C', '位置\u3000推定', 'می\u200cخواهم', '👩\u200d🔧 ready'])
def test_text_of_any_language_stays(text: str) -> None:
    assert untrusted.clean(text) == untrusted.one_line(text) == text


@pytest.mark.parametrize('character', '\a\x7f\x85\u061c\u200e\u202e\u2028\u2029\u2066\U000e0041')
def test_text_loses_characters_that_control_or_reorder(character: str) -> None:
    text = f'位置\u3000{character}推定'
    assert untrusted.clean(text) == untrusted.one_line(text) == '位置\u3000\ufffd推定'

# SPDX-License-Identifier: Apache-2.0
"""Google's own description of the API, against which every request and answer is checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import functools
from importlib import resources
import json
import re
from typing import Any, NamedTuple, Optional

ROOT = '/compute/v1/'
#: Parameters that every request may have.
_COMMON = ('alt', 'prettyPrint', 'key', 'fields', 'quotaUser')


class Route(NamedTuple):
    """A method of the API: such as 'instances.insert', its description, the path's parameters."""

    name: str
    method: Mapping[str, Any]
    words: Mapping[str, str]


class Mismatch(ValueError):
    """A value is not what the description says."""


@functools.lru_cache(maxsize=2)
def document(api: str = 'compute') -> Mapping[str, Any]:
    """Return the discovery document of an API."""
    text = (resources.files('googleapiclient') / 'discovery_cache' / 'documents'
            / f'{api}.v1.json').read_text()
    found: Mapping[str, Any] = json.loads(text)
    return found


@functools.lru_cache(maxsize=1)
def _routes() -> list[tuple[str, re.Pattern[str], str, Mapping[str, Any]]]:
    found = []
    for resource, entry in document()['resources'].items():
        for verb, method in entry['methods'].items():
            pattern = re.sub(r'\{(\w+)\}', r'(?P<\1>[^/]+)', method['path'])
            found.append((method['httpMethod'], re.compile(pattern), f'{resource}.{verb}', method))
    # 'images/family/{family}' before 'images/{image}'
    return sorted(found, key=lambda entry: entry[3]['path'].count('{'))


def route(verb: str, path: str) -> Optional[Route]:
    """Return the method that a request is for, None for none."""
    for http, pattern, name, method in _routes():
        words = pattern.fullmatch(path)
        if http == verb and words:
            return Route(name, method, words.groupdict())
    return None


def check_parameters(found: Route, query: Mapping[str, str]) -> None:
    """
    Check the parameters of a request.

    :raises Mismatch: one is unknown, or has another form.
    """
    for name, value in {**query, **found.words}.items():
        known = found.method['parameters'].get(name)
        if known is None and name not in _COMMON:
            raise Mismatch(f"{found.name} has no parameter '{name}'")
        if known and 'pattern' in known and not re.fullmatch(known['pattern'], value):
            raise Mismatch(f"the parameter {name} '{value}' is not {known['pattern']}")


def check_body(found: Route, body: Any) -> None:
    """
    Check the body of a request, and the fields that the method requires.

    :raises Mismatch: a field is unknown, missing or of another type.
    """
    asked = found.method.get('request')
    if (asked is None) != (body is None):
        raise Mismatch(f'{found.name} takes {"a" if asked else "no"} body')
    if asked is None:
        return
    schema = document()['schemas'][asked['$ref']]
    check(schema, body, asked['$ref'])
    for name, field in schema['properties'].items():
        required = field.get('annotations', {}).get('required', ())
        if f'compute.{found.name}' in required and name not in body:
            raise Mismatch(f'{found.name} requires {name}')


def check_answer(found: Route, answer: Any) -> None:
    """
    Check an answer.

    :raises Mismatch: it is not what the method returns.
    """
    check(document()['schemas'][found.method['response']['$ref']], answer, found.name)


def check(schema: Mapping[str, Any], value: Any, where: str, api: str = 'compute') -> None:
    """
    Check a value against a schema.

    :raises Mismatch: it does not fit.
    """
    for problem in _problems(schema, value, where, api):
        raise Mismatch(problem)


def _problems(schema: Mapping[str, Any], value: Any, where: str, api: str) -> Iterator[str]:
    if '$ref' in schema:
        schema = document(api)['schemas'][schema['$ref']]
    kind = schema.get('type', 'any')
    types: dict[str, Any] = {
        'string': str, 'integer': int, 'number': (int, float), 'boolean': bool, 'array': list,
        'object': dict}
    if kind != 'any' and not isinstance(value, types[kind]) \
            or kind in ('integer', 'number') and isinstance(value, bool):
        yield f'{where} is {value!r}, no {kind}'
    elif kind == 'string':
        if 'enum' in schema and value not in schema['enum']:
            yield f'{where} is {value!r}, not one of {schema["enum"]}'
        if 'pattern' in schema and not re.fullmatch(schema['pattern'], value):
            yield f'{where} is {value!r}, not {schema["pattern"]}'
        if schema.get('format') in ('int64', 'uint64') and not re.fullmatch(r'-?\d+', value):
            yield f'{where} is {value!r}, no number'
    elif kind == 'array':
        for index, item in enumerate(value):
            yield from _problems(schema['items'], item, f'{where}[{index}]', api)
    elif kind == 'object':
        for name, item in value.items():
            known = schema.get('properties', {}).get(name) or schema.get('additionalProperties')
            if known is None:
                yield f'{where} has no field {name!r}'
            else:
                yield from _problems(known, item, f'{where}.{name}', api)

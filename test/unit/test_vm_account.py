# SPDX-License-Identifier: Apache-2.0
"""Requests to clouds whose network or front end fails, by value."""

from __future__ import annotations

import pytest

from fogros2.errors import PrerequisiteError
from fogros2.provider.gcp import account as gcp
from rigs import serving

#: A page of Google's front end.
PAGE = '<!DOCTYPE html>\n<title>Error 502 (Server Error)!!1</title>'


@pytest.fixture
def answers(hasty, loopback_only, monkeypatch):
    """Serve the answers of a list as Google, one after the other: status and body."""
    said = []

    def answer(environ, start_response):
        status, body = said.pop(0)
        start_response(f'{status} {status}', [('Content-Length', str(len(body)))])
        return [body.encode()]

    monkeypatch.setattr(gcp.Account, 'token', lambda *_: 'secret')
    with serving.serve(answer) as url:
        monkeypatch.setenv(gcp.ENDPOINT_VARIABLE, url)
        yield said


def test_page_of_a_fault_is_no_answer_yet(answers):
    answers += [(502, PAGE), (200, '{"name": "robots"}')]
    assert gcp.Account().call('GET', 'robots', 'looking') == {'name': 'robots'}


def test_damaged_answer_leaves_open_whether_it_had_an_effect(answers):
    for status, body, refused in ((200, PAGE, False), (407, PAGE, True)):
        answers.append((status, body))
        with pytest.raises(PrerequisiteError, match='is there a proxy') as caught:
            gcp.Account().call('POST', 'robots', 'creating it')
        assert caught.value.refused is refused

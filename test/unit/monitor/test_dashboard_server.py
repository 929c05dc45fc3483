# SPDX-License-Identifier: Apache-2.0
"""Who gets something from the dashboard, and what."""

from __future__ import annotations

from collections.abc import Iterator
import http.client
import json
import re
import socket
import time
from typing import Any, Optional

import pytest
from ros2cli.cli import main

from fogros2.errors import NameTaken
from fogros2_monitor.dashboard.server import content_policy, Dashboard, HEADER, PAGE


class Canned:
    """A source that remembers what it was asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []

    def state(self, after: int, timeout: float) -> dict[str, Any]:
        self.asked.append(('state', after))
        return {'version': 1, 'machines': []}

    def log(self, machine: str, after: int) -> list[dict[str, Any]]:
        self.asked.append(('log', machine, after))
        return [{'number': after + 1, 'text': '</script><b>'}]

    def picture(self, stream: str) -> Optional[bytes]:
        return b'\xff\xd8picture' if stream == '/camera' else None

    def delete(self, machine: str, force: bool) -> None:
        self.asked.append(('delete', machine, force))
        if machine == 'taken':
            raise NameTaken('a launch has it', 'end that')


@pytest.fixture
def dashboard() -> Iterator[Dashboard]:
    made = Dashboard(Canned())
    yield made
    made.close()


def ask(
    dashboard: Dashboard, path: str, *, method: str = 'GET', body: Any = None,
    **headers: Optional[str],
) -> tuple[int, bytes, dict[str, str]]:
    link = http.client.HTTPConnection('127.0.0.1', dashboard.server_port, timeout=10)
    told = {HEADER: dashboard.token, **{
        key.replace('_', '-'): value for key, value in headers.items()}}
    if body is not None:
        told.setdefault('Content-Type', 'application/json')
    try:
        link.request(method, path, body=body,
                     headers={key: value for key, value in told.items() if value is not None})
        answer = link.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        link.close()


def asked(dashboard: Dashboard) -> list[tuple[Any, ...]]:
    source = dashboard.source
    assert isinstance(source, Canned)
    return source.asked


def test_dashboard_serves_page_state_log_and_pictures(dashboard: Dashboard) -> None:
    assert json.loads(ask(dashboard, '/api/state?after=7')[1]) == {'version': 1, 'machines': []}
    assert json.loads(ask(dashboard, '/api/log?machine=a%20b&after=3')[1])[0]['number'] == 4
    assert asked(dashboard) == [('state', 7), ('log', 'a b', 3)]
    status, data, headers = ask(dashboard, '/api/picture?of=/camera')
    assert (status, data, headers['Content-Type']) == (200, b'\xff\xd8picture', 'image/jpeg')
    assert ask(dashboard, '/api/picture?of=/other')[0] == 404
    status, data, headers = ask(dashboard, '/', **{HEADER: None})
    assert status == 200 and data == PAGE.read_bytes()
    assert dashboard.token.encode() not in data
    assert headers['X-Content-Type-Options'] == 'nosniff'
    assert headers['Cache-Control'] == 'no-store'
    assert "frame-ancestors 'none'" in headers['Content-Security-Policy']


def test_dashboard_deletes_a_machine(dashboard: Dashboard) -> None:
    request = json.dumps({'name': 'planner', 'force': True})
    assert ask(dashboard, '/api/delete', method='POST', body=request)[0] == 200
    status, data, _ = ask(dashboard, '/api/delete', method='POST', body='{"name": "taken"}')
    assert (status, json.loads(data)) == (409, {'error': 'a launch has it', 'hint': 'end that'})
    assert asked(dashboard) == [('delete', 'planner', True), ('delete', 'taken', False)]


@pytest.mark.parametrize(('headers', 'status'), [
    ({HEADER: None}, 401),
    ({HEADER: 'x' * 32}, 401),
    ({HEADER: ''}, 401),
    ({HEADER: '\xe4'}, 401),
    ({'Host': 'evil.example'}, 421),
    ({'Host': 'evil.example:{port}'}, 421),
    ({'Host': '127.0.0.1'}, 421),
    ({'Host': '127.0.0.1.evil.example:{port}'}, 421),
    ({'Host': ''}, 421),
    ({'Origin': 'http://evil.example'}, 403),
    ({'Origin': 'null'}, 403),
    ({'Origin': 'http://127.0.0.1:1'}, 403),
    ({'Origin': 'https://127.0.0.1:{port}'}, 403),
    ({'Origin': 'http://localhost:{port}'}, 403),
    ({'Sec-Fetch-Site': 'cross-site'}, 403),
    ({'Sec-Fetch-Site': 'same-site'}, 403),
    ({'Host': 'localhost:{port}', 'Origin': 'http://localhost:{port}'}, 200),
    ({'Origin': 'http://127.0.0.1:{port}', 'Sec-Fetch-Site': 'same-origin'}, 200),
])
def test_requests_need_token_host_and_origin(
    dashboard: Dashboard, headers: dict[str, Optional[str]], status: int,
) -> None:
    told = {key: value and value.replace('{port}', str(dashboard.server_port))
            for key, value in headers.items()}
    assert ask(dashboard, '/api/state', **told)[0] == status
    request = json.dumps({'name': 'planner'})
    assert ask(dashboard, '/api/delete', method='POST', body=request, **told)[0] == status
    assert len(asked(dashboard)) == (2 if status == 200 else 0)


@pytest.mark.parametrize('body', [
    '', 'x', '[]', '"planner"', 'null', '{}', '{"name": 1}', '{"name": "a", "force": "yes"}',
    '[' * 9000, '{"name": "' + 'a' * 20_000 + '"}'], ids=lambda body: body[:12])
def test_invalid_delete_request_is_refused(dashboard: Dashboard, body: str) -> None:
    status, data, _ = ask(dashboard, '/api/delete', method='POST', body=body)
    assert status == 400 and 'request' in json.loads(data)['error']
    assert asked(dashboard) == []


@pytest.mark.parametrize('length', ['', '-1', '1e1', '\xb2', '9' * 5000], ids=len)
def test_request_with_an_invalid_length_is_refused(dashboard: Dashboard, length: str) -> None:
    status, data, _ = ask(dashboard, '/api/delete', method='POST', body='{"name": "a"}',
                          Content_Length=length)
    assert status == 400 and 'length' in json.loads(data)['error']
    assert asked(dashboard) == []


def test_delete_request_of_a_form_is_refused(dashboard: Dashboard) -> None:
    for kind in ('text/plain', 'application/x-www-form-urlencoded', 'multipart/form-data'):
        assert ask(dashboard, '/api/delete', method='POST', body='{"name": "a"}',
                   Content_Type=kind)[0] == 415
    assert ask(dashboard, '/api/delete?name=a')[0] == 404
    assert ask(dashboard, '/api/delete', method='PUT', body='{}')[0] == 501
    assert asked(dashboard) == []


@pytest.mark.parametrize('path', [
    '/api/', '/api/states', '/etc/passwd', '/../server.py', '//evil.example/', '/page.html',
    '/favicon.ico'])
def test_unknown_path_is_not_found(dashboard: Dashboard, path: str) -> None:
    assert ask(dashboard, path)[0] == 404


def test_invalid_number_in_a_query_is_refused(dashboard: Dashboard) -> None:
    assert ask(dashboard, '/api/state?after=x')[0] == 400
    assert ask(dashboard, '/api/log?machine=a&after=')[0] == 200


def test_dashboard_listens_only_on_the_loopback(dashboard: Dashboard) -> None:
    # a socket that listens on all addresses has this one, too, on any computer
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(('127.0.0.2', dashboard.server_port), timeout=5).close()


def test_each_dashboard_has_its_own_token() -> None:
    one, other = Dashboard(Canned()), Dashboard(Canned())
    try:
        assert one.token != other.token and len(one.token) >= 32
        assert one.url == f'http://127.0.0.1:{one.server_port}/#{one.token}'
    finally:
        one.close()
        other.close()


def test_page_loads_nothing_and_escapes_its_data() -> None:
    page = PAGE.read_text()
    for words in ('innerHTML', 'outerHTML', 'insertAdjacentHTML', 'document.write', 'eval(',
                  'new Function', 'onclick="'):
        assert words not in page, words
    addresses = set(re.findall(r'https?://[^\s\'"]+', page))
    assert addresses == {'http://www.w3.org/2000/svg'}  # the name of SVG, which nobody asks for
    assert not re.search(r'<(script|link|img|iframe)[^>]+(src|href)="(?!data:)', page)


def test_content_policy_allows_only_the_pages_script() -> None:
    policy = content_policy('<style>a</style><script>b</script>')
    assert "script-src 'sha256-PiPoFgA5WUoziU9lZOGxNIu9egCI1CxKy3PurtWcAJ0='" in policy
    assert "default-src 'none'" in policy and 'unsafe' not in policy


def test_server_stops_at_once() -> None:
    durations = []
    for _ in range(3):
        server = Dashboard(Canned())
        begin = time.monotonic()
        server.close()
        durations.append(time.monotonic() - begin)
    assert min(durations) < 0.3


def test_taken_or_invalid_port_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(('127.0.0.1', 0)) as taken:
        port = taken.getsockname()[1]
        assert 'another --port' in str(main(argv=[
            'fog', 'dashboard', '--no-browser', '--port', str(port)]))
    for verb in (['dashboard'], ['monitor', 'slam']):
        for none in ('-1', '70000', '99999', '1e3', ''):
            with pytest.raises(SystemExit):
                main(argv=['fog', *verb, f'--port={none}'])
            assert f"'{none}' is no port (0 to 65535)" in capsys.readouterr().err

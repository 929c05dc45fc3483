# SPDX-License-Identifier: Apache-2.0
"""The API server's side of requests and watches, with an API server that the tests control."""

from __future__ import annotations

import base64
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
import http.server
import inspect
import json
import os
from pathlib import Path
import re
import ssl
import subprocess
import sys
import threading
import time
from typing import Any
from unittest.mock import Mock
from urllib.parse import parse_qs, urlsplit

import pytest
import yaml

from fogros2 import kubernetes_client
from fogros2.errors import Cancelled, DeadlineExceeded, PrerequisiteError
from fogros2.kubernetes_client import ApiError, Unreachable
from fogros2.provider import TAG_ON_EXIT
from fogros2.provider.kubernetes import KubernetesProvider, names
from fogros2.provider.kubernetes.start import Start
from fogros2.store import Store
from fogros2.waiting import ON_ITS_WAY, wait_until
from fogros2_testing.shell_contract import raised

pytest.importorskip('kubernetes', reason='needs the client: pip install kubernetes')

#: What a request is answered: a status and an object, or lines and whether to hold on then.
Answer = tuple[int, Any]


class Server(http.server.ThreadingHTTPServer):
    """Answers each request by the next of ``answers``, and notes it."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(('127.0.0.1', 0), Handler)
        self.answers: list[Answer | Callable[[], Answer]] = []
        self.asked: list[tuple[str, str, dict[str, list[str]], dict[str, str]]] = []
        self.ended = threading.Event()


class Handler(http.server.BaseHTTPRequestHandler):

    protocol_version = 'HTTP/1.1'
    server: Server

    def do_GET(self) -> None:
        self.rfile.read(int(self.headers.get('content-length') or 0))
        url = urlsplit(self.path)
        self.server.asked.append(
            (self.command, url.path, parse_qs(url.query), dict(self.headers)))
        answer = self.server.answers.pop(0)
        status, what = answer() if callable(answer) else answer
        self.send_response(status)
        if isinstance(what, list):
            self.send_header('transfer-encoding', 'chunked')
            self.end_headers()
            for event in what:
                if event == 'hold':
                    self.server.ended.wait(60.0)
                    break
                line = json.dumps(event).encode() + b'\n'
                self.wfile.write(f'{len(line):x}\r\n'.encode() + line + b'\r\n')
                self.wfile.flush()
            self.wfile.write(b'0\r\n\r\n')
            return
        data = json.dumps(what).encode()
        self.send_header('content-length', str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    do_POST = do_PATCH = do_DELETE = do_GET

    def log_message(self, *words: object) -> None:
        """Say nothing."""


def kubeconfig(path: Path, server: str, **user: Any) -> Path:
    path.write_text(yaml.safe_dump({
        'apiVersion': 'v1', 'kind': 'Config', 'current-context': 'first',
        'clusters': [{'name': 'c', 'cluster': {'server': server}}],
        'users': [{'name': 'u', 'user': user or {'token': 'a-token'}}],
        'contexts': [
            {'name': 'first', 'context': {'cluster': 'c', 'user': 'u', 'namespace': 'robots'}},
            {'name': 'second', 'context': {'cluster': 'c', 'user': 'u'}}]}))
    return path


def certify(folder: Path, name: str, by: str, *extensions: str) -> None:
    """Make a key and a certificate, without key identifiers, of the authority ``by``."""
    (folder / 'openssl.cnf').write_text(
        f'[req]\ndistinguished_name=n\nprompt=no\n[n]\nCN={name}\n[x]\n'
        + '\n'.join(('authorityKeyIdentifier=none', 'subjectKeyIdentifier=none', *extensions)))
    words = ['req', '-config', 'openssl.cnf', '-newkey', 'ec', '-pkeyopt',
             'ec_paramgen_curve:P-256', '-nodes', '-keyout', f'{name}.key']
    if by == name:
        words += ['-x509', '-extensions', 'x', '-out', f'{name}.crt']
    subprocess.run(['openssl', *words, *([] if by == name else ['-out', 'request'])],
                   check=True, cwd=folder, capture_output=True)
    if by != name:
        subprocess.run([
            'openssl', 'x509', '-req', '-in', 'request', '-CA', f'{by}.crt', '-CAkey',
            f'{by}.key', '-CAcreateserial', '-extfile', 'openssl.cnf', '-extensions', 'x',
            '-out', f'{name}.crt'], check=True, cwd=folder, capture_output=True)


@pytest.fixture
def server():
    with Server() as found:
        thread = threading.Thread(target=found.serve_forever, args=(0.02,))
        thread.start()
        yield found
        found.ended.set()
        found.shutdown()
        thread.join()


@pytest.fixture
def api(server, tmp_path, monkeypatch):
    path = kubeconfig(tmp_path / 'config', f'http://127.0.0.1:{server.server_port}')
    monkeypatch.setenv('KUBECONFIG', str(path))
    return kubernetes_client.connect()


def test_kept_pod_is_as_old_as_its_cluster_says(api, server, monkeypatch):
    monkeypatch.setattr(
        Handler, 'date_time_string', lambda *_: 'Mon, 01 Jan 2035 01:00:00 GMT')
    monkeypatch.setattr(Start, 'wait', lambda *_: {'metadata': {'uid': 'pod'}})
    provider, request, sent = KubernetesProvider(), api.request, []
    monkeypatch.setattr(api, 'request', lambda method, path, body=None, **words: (
        sent.append(body), request(method, path, body, **words))[1])
    monkeypatch.setattr(provider, '_machine', lambda *_: None)
    provider._lifetimes['fogros2-slam'] = 60.0
    job = {'metadata': {
        'name': 'fogros2-slam', 'uid': '1', 'annotations': {
            names.TAGS: json.dumps({TAG_ON_EXIT: 'keep'}), names.EXPOSURE: 'pod_ip 10.0.0.1 1'}},
        'status': {'startTime': '2035-01-01T00:00:00Z'}}
    server.answers = [(200, job), (200, {})]
    provider.reachable('robots/fogros2-slam/1@', name='slam', timeout=5.0)
    assert sent == [None, {'spec': {'activeDeadlineSeconds': 3600 + 60 + 1}}]


def refusal(status: int, reason: str, message: str) -> Answer:
    return status, {'kind': 'Status', 'status': 'Failure', 'reason': reason, 'message': message}


def event(kind: str, name: str) -> dict[str, Any]:
    return {'type': kind, 'object': {'metadata': {'name': name}}}


def follow(api, look, **more: Any) -> Any:
    return api.follow('/api/v1/pods', look, **{
        'timeout': 10.0, 'what': 'the pod', 'labelSelector': 'a=b', **more})


def names_of(seen: list[str]) -> Callable[[str, dict[str, Any]], str | None]:
    def look(kind: str, thing: dict[str, Any]) -> str | None:
        name = str(thing['metadata']['name'])
        seen.append(f'{kind} {name}')
        return name if name == 'last' else None
    return look


def test_the_context_says_where_and_as_whom(api, server):
    server.answers = [(200, {'items': []})]
    assert (api.context, api.namespace) == ('first', 'robots')
    api.request('GET', '/api/v1/pods', labelSelector='a=b,c', nothing=None)
    (method, path, query, headers), = server.asked
    assert (method, path, query) == ('GET', '/api/v1/pods', {'labelSelector': ['a=b,c']})
    assert headers['authorization'] == 'Bearer a-token'


def test_one_context_by_two_names_is_one(api):
    assert kubernetes_client.connect('first') is api
    other = kubernetes_client.connect('second')
    assert other is not api
    assert other.namespace == 'default'


def test_a_context_that_is_not_there_is_named(api):
    error = raised(PrerequisiteError, lambda: kubernetes_client.connect('third'))
    assert "'third'" in str(error)
    assert 'first, second' in error.hint


def test_invalid_kubeconfig_is_reported(tmp_path, monkeypatch):
    path = tmp_path / 'config'
    monkeypatch.setenv('KUBECONFIG', str(path))
    assert kubernetes_client.configured()  # so `ros2 fog list` reports the error
    error = raised(PrerequisiteError, kubernetes_client.connect)
    assert f"KUBECONFIG names the kubeconfig '{path}', and there is no such file" in str(error)
    for text in ('', 'no: [yaml', '[]', 'contexts: 3'):
        path.write_text(text)
        assert 'kubeconfig' in str(raised(PrerequisiteError, kubernetes_client.connect))


@pytest.mark.parametrize('end', ['', 'os.kill(os.getpid(), 9)'])
def test_keys_of_a_kubeconfig_stay_in_the_state_folder(tmp_path, end):
    state, elsewhere = tmp_path / 'state', tmp_path / 'tmp'
    elsewhere.mkdir()
    certify(tmp_path, 'robot', 'robot')
    path = kubeconfig(tmp_path / 'config', 'https://127.0.0.1:9', **{
        f'client-{each}-data': base64.b64encode((tmp_path / file).read_bytes()).decode()
        for each, file in (('certificate', 'robot.crt'), ('key', 'robot.key'))})
    code = ('import os\nfrom fogros2.kubernetes_client import configuration\n'
            f'print(configuration.load("")[2].configuration.key_file, flush=True)\n{end}')
    done = subprocess.run(
        [sys.executable, '-c', code], text=True, stdout=subprocess.PIPE, env={
            **os.environ, 'FOGROS2_STATE_HOME': str(state), 'TMPDIR': str(elsewhere),
            'KUBECONFIG': str(path)})
    key = Path(done.stdout.strip())
    assert key.parent.parent == state and list(elsewhere.iterdir()) == []
    if end:
        # killed: until `ros2 fog gc`, only the user can read it
        assert key.read_text() == (tmp_path / 'robot.key').read_text()
        assert [each.stat().st_mode & 0o77 for each in (key, key.parent)] == [0, 0]
        Store(state).sweep()
    assert list(state.iterdir()) == []


@pytest.fixture(scope='module')
def certificates(tmp_path_factory):
    """Return a folder with two authorities, and the keys that the first has signed."""
    folder = tmp_path_factory.mktemp('certificates')
    root = 'basicConstraints=critical,CA:true', 'keyUsage=critical,keyCertSign'
    for name, by, *extensions in (
            ('ca', 'ca', *root), ('other', 'other', *root), ('robot', 'ca'),
            ('server', 'ca', 'subjectAltName=IP:127.0.0.1')):
        certify(folder, name, by, *extensions)
    return folder


@pytest.mark.parametrize(('host', 'authority', 'user', 'error'), [
    ('127.0.0.1', 'ca', 'robot', None),
    ('localhost', 'ca', 'robot', "doesn't match|mismatch"),
    ('127.0.0.1', 'other', 'robot', 'CERTIFICATE_VERIFY_FAILED'),
    ('127.0.0.1', None, 'robot', 'CERTIFICATE_VERIFY_FAILED'),
    ('127.0.0.1', 'ca', None, '')])
def test_python_3_13_verifies_servers_as_kubectl_does(
        server, certificates, tmp_path, monkeypatch, host, authority, user, error):
    """EKS's certificates have no key identifiers, which Python 3.13 demands by default."""
    from urllib3.util import ssl_
    usual = ssl_.create_urllib3_context

    def strict(*given: Any, **options: Any) -> ssl.SSLContext:
        context = usual(*given, **options)
        context.verify_flags |= ssl.VERIFY_X509_STRICT
        return context

    for module in ('urllib3.util.ssl_', 'urllib3.connection'):
        monkeypatch.setattr(f'{module}.create_urllib3_context', strict)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(certificates / 'ca.crt')
    context.load_cert_chain(certificates / 'server.crt', certificates / 'server.key')
    server.socket = context.wrap_socket(server.socket, server_side=True)
    path = kubeconfig(tmp_path / 'config', f'https://{host}:{server.server_port}', **{
        'token': 'a-token', **({
            'client-certificate': str(certificates / 'robot.crt'),
            'client-key': str(certificates / 'robot.key')} if user else {})})
    if authority:
        text = yaml.safe_load(path.read_text())
        text['clusters'][0]['cluster']['certificate-authority'] = str(
            certificates / f'{authority}.crt')
        path.write_text(yaml.safe_dump(text))
    monkeypatch.setenv('KUBECONFIG', str(path))
    server.answers = [(200, {'a': 1})]
    api = kubernetes_client.connect()
    if error is None:
        assert api.request('GET', '/x', timeout=5.0) == {'a': 1}
    else:
        told = str(raised(Unreachable, lambda: api.request('GET', '/x', timeout=0.3)))
        assert re.search(error, told), told
        assert server.asked == []


def test_failing_credential_plugin_is_reported(tmp_path, monkeypatch):
    monkeypatch.setenv('KUBECONFIG', str(kubeconfig(tmp_path / 'config', 'http://127.0.0.1:9', **{
        'exec': {'apiVersion': 'client.authentication.k8s.io/v1', 'interactiveMode': 'Never',
                 'command': '/no/such/plugin', 'args': []}})))
    error = raised(PrerequisiteError, kubernetes_client.connect)
    assert '/no/such/plugin' in str(error)


def test_a_refusal_keeps_its_words(api, server):
    server.answers = [refusal(409, 'AlreadyExists', 'jobs.batch "x" already exists')]
    error = raised(ApiError, lambda: api.request('POST', '/x', {'a': 1}))
    assert isinstance(error, ApiError)
    assert (error.status, error.reason) == (409, 'AlreadyExists')
    assert str(error) == 'jobs.batch "x" already exists'
    assert server.asked[0][3]['content-type'] == 'application/json'


@pytest.mark.parametrize(('ask', 'answer'), [
    (lambda api: api.request('POST', '/x', {}), (201, {})),
    (lambda api: follow(api, lambda kind, thing: kind), (200, [event('ADDED', 'a')])),
    (lambda api: api.websocket('/exec', {}, timeout=5.0), (404, {}))])
def test_credentials_that_expired_are_read_again(api, server, tmp_path, ask, answer):
    expired = refusal(401, 'Unauthorized', 'Unauthorized')
    server.answers = [expired, expired]
    assert raised(ApiError, lambda: ask(api)).status == 401
    # the user logs in again, with another current context and another namespace
    path = kubeconfig(tmp_path / 'config', api.server, token='a-new-token')
    path.write_text(path.read_text().replace('current-context: first', 'current-context: second')
                    .replace('robots', 'others'))
    server.asked.clear()
    server.answers = [expired, answer]
    if answer[0] < 400:
        ask(api)
    else:
        assert raised(ApiError, lambda: ask(api)).status == answer[0]
    assert [headers['authorization'] for *_, headers in server.asked] == [
        'Bearer a-token', 'Bearer a-new-token']
    assert (api.context, api.namespace) == ('first', 'robots')


def test_another_cluster_of_the_same_name_is_not_asked(api, server, tmp_path):
    expired = refusal(401, 'Unauthorized', 'Unauthorized')
    for other in ('http://127.0.0.1:9', ''):
        (tmp_path / 'config').unlink()
        if other:
            kubeconfig(tmp_path / 'config', other, token='of another')
        server.answers = [expired]
        assert raised(ApiError, lambda: api.request('GET', '/x')).status == 401
    assert [headers['authorization'] for *_, headers in server.asked] == 2 * ['Bearer a-token']


def test_an_overloaded_server_is_asked_again(api, server):
    server.answers = [refusal(429, 'TooManyRequests', 'later'), (503, 'no JSON object'),
                      (200, {'a': 1})]
    assert api.request('GET', '/x') == {'a': 1}


def test_quota_that_two_requests_change_at_once_is_asked_again(api, server):
    conflict = ('Operation cannot be fulfilled on {} "q": the object has been modified; please '
                'apply your changes to the latest version and try again')
    server.answers = [refusal(409, 'Conflict', conflict.format('resourcequotas')), (201, {'a': 1}),
                      refusal(409, 'Conflict', conflict.format('jobs.batch'))]
    assert api.request('POST', '/x', {}) == {'a': 1}
    assert raised(ApiError, lambda: api.request('PATCH', '/x', {})).status == 409


def test_a_server_that_does_not_answer_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setenv('KUBECONFIG', str(kubeconfig(tmp_path / 'config', 'http://127.0.0.1:9')))
    api = kubernetes_client.connect()
    begin = time.monotonic()
    error = raised(Unreachable, lambda: api.request('GET', '/x', timeout=0.5))
    assert 0.4 < time.monotonic() - begin < 30.0
    assert 'Connection refused' in str(error)
    assert '0x' not in str(error)


def test_dead_connections_leave_time_for_a_new_one(api, server, monkeypatch):
    answer = Handler.do_GET

    def first_alone(own):
        if not hasattr(own, 'used'):
            own.used = True
            answer(own)
        else:
            server.ended.wait(60.0)

    monkeypatch.setattr(Handler, 'do_GET', first_alone)
    monkeypatch.setattr('fogros2.kubernetes_client.api.CONNECT', 1.0)
    together = threading.Barrier(3, timeout=60.0)
    server.answers = [*3 * [lambda: (200, {'number': together.wait()})], (200, {'a': 1})]
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda _: api.request('GET', '/x'), range(3)))
    assert api.request('GET', '/x', timeout=6.0) == {'a': 1}


def test_a_right_that_lacks_is_believed_but_not_after_a_restart(api, server):
    lacking = refusal(403, 'Forbidden', 'User "robot" cannot get resource "jobs"')
    server.answers = [lacking]
    raised(ApiError, lambda: api.request('GET', '/x'))
    server.answers = [lacking, lacking, (200, {})]
    api.request('DELETE', '/x', doubt=5.0)
    api.lost()
    server.answers = [lacking, (200, {})]
    api.request('GET', '/x')


def test_a_watch_tells_what_is_there_and_what_comes(api, server):
    seen: list[str] = []
    server.answers = [(200, [event('ADDED', 'a'), event('MODIFIED', 'a'), event('ADDED', 'last'),
                             'hold'])]
    assert follow(api, names_of(seen)) == 'last'
    assert seen == ['ADDED a', 'MODIFIED a', 'ADDED last']
    assert server.asked[0][2] == {
        'watch': ['true'], 'timeoutSeconds': ['30'], 'labelSelector': ['a=b']}


def test_a_watch_that_ends_is_begun_anew_from_what_is_there_then(api, server):
    seen: list[str] = []
    asked: list[int] = []
    server.answers = [(200, [event('ADDED', 'a')]), refusal(410, 'Expired', 'too old'),
                      refusal(503, '', 'restarting'), (200, [event('ADDED', 'last'), 'hold'])]

    def again() -> None:
        asked.append(len(server.asked))

    assert follow(api, names_of(seen), again=again, resourceVersion='7') == 'last'
    assert seen == ['ADDED a', 'ADDED last']
    assert 'resourceVersion' in server.asked[0][2]
    assert all('resourceVersion' not in query for _, _, query, _ in server.asked[1:])
    assert asked == [1, 2, 3]


def test_what_is_there_after_a_loss_may_be_enough(api, server):
    server.answers = [(200, [])]
    assert follow(api, lambda kind, thing: None, again=lambda: 'gone') == 'gone'


def test_forbidden_watch_is_reported(api, server):
    server.answers = [refusal(403, 'Forbidden', 'cannot watch resource "pods"')]
    error = raised(ApiError, lambda: follow(api, lambda kind, thing: None))
    assert 'cannot watch' in str(error)


def test_a_watch_ends_with_the_launch_and_by_its_deadline(api, server, monkeypatch):
    monkeypatch.setattr(kubernetes_client.api, 'WATCH', 1)
    server.answers = [(200, ['hold']), (200, ['hold'])]
    before, cancel = {*threading.enumerate()}, threading.Event()
    timer = threading.Timer(0.2, cancel.set)
    timer.start()
    begin = time.monotonic()
    raised(Cancelled, lambda: follow(api, lambda kind, thing: None, cancel=cancel))
    timer.join()
    raised(DeadlineExceeded, lambda: follow(api, lambda kind, thing: None, timeout=0.3))
    # nobody waits for a thread that reads on
    assert time.monotonic() - begin < ON_ITS_WAY
    wait_until(lambda: not [thread for thread in {*threading.enumerate()} - before
                            if thread.name == 'fog-watch'], timeout=60, what='no thread')


def test_something_else_can_end_a_watch(api, server):
    server.answers = [(200, ['hold'])]
    ticks: list[int] = []

    def tick() -> str | None:
        ticks.append(1)
        return 'late' if len(ticks) > 2 else None

    assert follow(api, lambda kind, thing: None, tick=tick) == 'late'


def test_ctrl_c_ends_a_request_without_an_answer(api, server):
    asked = threading.Event()

    def silent() -> Answer:
        asked.set()
        server.ended.wait(60.0)
        return 200, {}

    server.answers = [silent]
    cancel = threading.Event()
    interrupting = threading.Thread(target=lambda: (asked.wait(60.0), cancel.set()))
    interrupting.start()
    begin = time.monotonic()
    raised(Cancelled, lambda: api.request('GET', '/api/v1/pods', cancel=cancel))
    interrupting.join()
    assert time.monotonic() - begin < ON_ITS_WAY


def test_what_is_made_just_after_a_ctrl_c_is_known(api, server):
    """The request was under way: its undo has to know what it made."""
    cancel = threading.Event()

    def late() -> Answer:
        cancel.set()
        threading.Event().wait(1.5)
        return 201, {'made': 'it'}

    server.answers = [late]
    assert api.request('POST', '/api/v1/pods', {}, cancel=cancel) == {'made': 'it'}


@pytest.mark.parametrize('old', [False, True])
def test_refused_exec_is_reported(api, server, monkeypatch, old):
    """The client that Debian 12 has passes no body of the refusal on."""
    import websocket
    body = not old and 'resp_body' in inspect.signature(
        websocket.WebSocketBadStatusException).parameters
    if old:
        monkeypatch.setattr(websocket.WebSocketBadStatusException, 'resp_body', property(
            lambda self: object.__getattribute__(self, 'absent'), lambda self, body: None),
            raising=False)
    server.answers = [(500, {'kind': 'Status', 'message': 'container not running'})]
    error = raised(ApiError, lambda: api.websocket('/exec', {}, timeout=5.0))
    assert error.status == 500
    assert ('container not running' in str(error)) is body


@pytest.mark.parametrize(('proxy', 'kind', 'port'), [
    ('http://me:pw@127.0.0.1:3128', 'http', 3128), ('http://127.0.0.1', 'http', 80),
    ('socks5://127.0.0.1:1080', 'socks5', 1080), ('socks5h://127.0.0.1:1080', 'socks5h', 1080)])
def test_exec_uses_the_proxy_of_the_kubeconfig(api, monkeypatch, proxy, kind, port):
    import websocket
    connect = Mock(side_effect=OSError('no proxy'))
    monkeypatch.setattr(websocket, 'create_connection', connect)
    api._client.configuration.proxy = proxy
    raised(Unreachable, lambda: api.websocket('/exec', {}, timeout=5.0))
    options = connect.call_args.kwargs
    assert (options['proxy_type'], options['http_proxy_host'], options['http_proxy_port']) == (
        kind, '127.0.0.1', port)
    assert options.get('http_proxy_auth') == (('me', 'pw') if '@' in proxy else None)


def test_the_provider_is_there_without_the_client():
    """``ros2 fog list`` names it, and must not take the time that the client takes to load."""
    code = ('import sys; import fogros2.provider.kubernetes, fogros2.shell.kubernetes, '
            'fogros2.kubernetes_client; '
            'print([m for m in ("kubernetes", "urllib3", "websocket") if m in sys.modules])')
    told = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          check=True, env={**os.environ, 'KUBECONFIG': '/nowhere'})
    assert told.stdout == '[]\n'

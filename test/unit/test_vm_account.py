# SPDX-License-Identifier: Apache-2.0
"""Requests to clouds whose network or front end fails, by value."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from fogros2.deploy.steps import watching
from fogros2.errors import FogError, PrerequisiteError
from fogros2.provider.aws import clients, failures
from fogros2.provider.azure import account as azure
from fogros2.provider.gcp import account as gcp
from fogros2.provider.vm import account, rest
from fogros2.provider.vm.failures import Silent
from rigs import serving

exceptions = pytest.importorskip('botocore.exceptions')
requests = pytest.importorskip('requests')
urllib3 = pytest.importorskip('urllib3')
#: A page of Google's front end.
PAGE = '<!DOCTYPE html>\n<title>Error 502 (Server Error)!!1</title>'


class Clock(threading.Event):
    """A cancel that never comes, whose waits take no time."""

    now = 0.0

    def monotonic(self):
        return self.now

    def wait(self, timeout=None):
        self.now += timeout


@pytest.fixture
def answers(hasty, loopback_only, monkeypatch):
    """Serve the answers of a list as all clouds, one after the other: status and body."""
    said = []

    def answer(environ, start_response):
        status, body = said.pop(0)
        start_response(f'{status} {status}', [('Content-Length', str(len(body)))])
        return [body.encode()]

    with serving.serve(answer) as url:
        for module in (azure, gcp):
            monkeypatch.setattr(module.Account, 'token', lambda *_: 'secret')
            monkeypatch.setenv(module.ENDPOINT_VARIABLE, url)
        for name, value in {'AWS_ACCESS_KEY_ID': 'x', 'AWS_SECRET_ACCESS_KEY': 'x',
                            'AWS_ENDPOINT_URL': url}.items():
            monkeypatch.setenv(name, value)
        yield said


def test_password_of_netrc_replaces_no_token(gce, monkeypatch, tmp_path):
    (tmp_path / 'netrc').write_text('default login a password b\n')
    monkeypatch.setenv('NETRC', str(tmp_path / 'netrc'))
    headers = []

    def answer(environ, start_response):
        headers.append(environ.get('HTTP_AUTHORIZATION'))
        start_response('200 OK', [('Content-Length', '2')])
        return [b'{}']

    with serving.serve(answer) as url:
        monkeypatch.setenv(gcp.ENDPOINT_VARIABLE, url)
        gcp.Account().call('GET', 'robots', 'looking')
    (header,) = headers
    assert header.startswith('Bearer ')


def test_page_of_a_fault_is_no_answer_yet(answers):
    answers += [(502, PAGE), (200, '{"name": "robots"}')]
    assert gcp.Account().call('GET', 'robots', 'looking') == {'name': 'robots'}


def test_damaged_answer_leaves_open_whether_it_had_an_effect(answers):
    for status, body, refused in ((200, PAGE, False), (200, '', False), (407, PAGE, True)):
        answers.append((status, body))
        with pytest.raises(PrerequisiteError, match='is there a proxy') as caught:
            gcp.Account().run('POST', 'robots', 'creating it')
        assert caught.value.refused is refused


@pytest.mark.parametrize(('ask', 'body'), [
    (lambda: list(azure.Account().pages('/things', 'looking')), ''),
    (lambda: azure.Account().call('PUT', '/things', 'looking')['id'], ''),
    (lambda: gcp.Account().call('GET', 'robots', 'looking')['name'], '{}'),
    (lambda: list(clients.Account().pages(
        'pricing', 'us-east-1', 'get_products', 'PriceList', 'looking', ServiceCode='AmazonEC2',
    )), '{"PriceList": ["{'),
    (lambda: clients.Account().call(
        'ssm', 'us-east-1', 'get_parameter', 'looking', Name='image')['Parameter'], '')])
def test_incomplete_answer_is_a_known_error(answers, ask, body):
    answers.append((200, body))
    with pytest.raises(PrerequisiteError, match='looking failed: what answered is not'):
        ask()


@pytest.mark.parametrize(('unsent', 'hasty', 'times', 'attempts', 'refused'), [
    (True, False, 1, 2, None), (True, False, 99, 4, True), (True, True, 99, 1, True),
    (False, False, 99, 2, False)])
def test_request_without_an_answer_is_made_again(
    monkeypatch, unsent, hasty, times, attempts, refused,
):
    clock = Clock()
    monkeypatch.setattr(account, 'time', clock)
    silence = [Silent('no answer', '', unsent=unsent) for _ in range(times)]
    asked = []

    def send():
        asked.append(clock.now)
        if silence:
            raise silence.pop()
        return 'answer'

    own = account.Account().having(clock, hasty=hasty)
    if refused is None:
        assert own.repeated(send, 'creating it', reads=False) == 'answer'
    else:
        with pytest.raises(Silent) as caught:
            own.repeated(send, 'creating it', reads=False)
        assert caught.value.refused is refused
    assert asked == [0.0, 1.0, 3.0, 7.0][:attempts]


def test_retry_comes_after_the_pause_that_the_cloud_names(monkeypatch):
    clock, asked = Clock(), []
    error = {'error': {'code': 429, 'message': 'x', 'errors': [{'reason': 'rateLimitExceeded'}]}}
    answers = [
        SimpleNamespace(status_code=429, content=b'{', json=lambda: error,
                        headers={'Retry-After': '7'}),
        SimpleNamespace(status_code=200, content=b'{}', json=dict, headers={})]

    def request(*words, **options):
        asked.append(clock.now)
        return answers.pop(0)

    monkeypatch.setattr(rest, '_session', lambda: SimpleNamespace(request=request))
    monkeypatch.setattr(gcp.Account, 'token', lambda *_: 'secret')
    gcp.Account().having(clock).call('GET', 'robots', 'looking')
    assert asked == [0.0, 7.0]


@pytest.mark.parametrize(('status', 'repeatable', 'attempts'), [
    (504, True, 8), (504, False, 1), (429, False, 8), (0, True, 2), (0, False, 1)])
def test_request_that_cannot_be_repeated_is_made_once(status, repeatable, attempts):
    asked = []

    def send():
        asked.append(status)
        raise azure.refusal(status, None, 'creating it') if status else \
            Silent('no answer', '', unsent=False)

    with pytest.raises(FogError):
        account.Account().having(Clock()).repeated(
            send, 'creating it', reads=False, repeatable=repeatable)
    assert len(asked) == attempts


def test_certificate_that_does_not_hold_is_the_reason(monkeypatch):
    reason = '[SSL: CERTIFICATE_VERIFY_FAILED] certificate is not yet valid'
    tls = urllib3.exceptions.SSLError(reason)
    pool = urllib3.HTTPSConnectionPool('compute.googleapis.com')

    def request(*words, **options):
        raise requests.exceptions.SSLError(
            urllib3.exceptions.MaxRetryError(pool, f'/{500 * "x"}', tls))

    monkeypatch.setattr(rest, '_session', lambda: SimpleNamespace(request=request))
    monkeypatch.setattr(gcp.Account, 'token', lambda *_: 'secret')
    aws = failures._unsent(exceptions.SSLError(endpoint_url='https://aws', error=reason), 'asking')
    with pytest.raises(Silent) as caught:
        gcp.Account().having(None, hasty=True).call('GET', 'robots', 'asking')
    for error in (aws, caught.value):
        assert reason in error.args[0] and 'clock' in error.hint and error.refused


def test_dead_connection_is_replaced_before_a_machine_is_lost(hasty, monkeypatch):
    timeouts = []

    def send(own, method, url, what, body, query, timeout):
        timeouts.append(timeout)
        raise Silent('no answer', '', unsent=False)

    monkeypatch.setattr(gcp.Account, '_send', send)
    for method in ('GET', 'POST'):
        with pytest.raises(Silent):
            gcp.Account().ask(method, 'robots', 'looking')
    assert timeouts == [20.0, 30.0, 30.0, 30.0]
    begin = watching.SILENCE + watching.POLL_INTERVAL
    assert begin + max(timeouts[0], clients.READ_TIMEOUT) < watching.LOSS

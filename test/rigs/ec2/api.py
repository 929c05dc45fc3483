# SPDX-License-Identifier: Apache-2.0
"""
The box's AWS: Moto's server, with the rules that it lacks, and a record of calls.

A WSGI application around Moto's. What Moto can't answer (prices, public parameters) is answered
here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import datetime
import io
import json
import re
import threading
from typing import Any
from urllib.parse import parse_qsl

from rigs.computers.box import Call
from rigs.ec2 import answers, hooks, market, rules
from rigs.ec2.answers import Answer, Refusal
from rigs.ec2.cloud import Cloud

_SCOPE = re.compile(r'Credential=([^/]+)/\d+/([^/]+)/([^/]+)/aws4_request')
#: Actions after which the router's rules may have to be others.
_GUARDING = ('SecurityGroup', 'ModifyInstanceAttribute', 'ModifyNetworkInterface')
Start = Callable[..., Any]


class Api:
    """
    The WSGI application.

    :param inner: Moto's.
    """

    def __init__(self, inner: Callable[..., Iterable[bytes]], cloud: Cloud) -> None:
        self._inner = inner
        self._cloud = cloud
        self._lock = threading.Lock()
        self.calls: list[Call] = []

    def __call__(self, environ: dict[str, Any], start_response: Start) -> Iterable[bytes]:
        """Answer a request."""
        answer = self._answer(environ)
        start_response(f'{answer.status} {answer.status}', [
            ('Content-Type', answer.content_type), ('Content-Length', str(len(answer.body)))])
        return [answer.body]

    def _answer(self, environ: dict[str, Any]) -> Answer:
        body = environ['wsgi.input'].read(int(environ.get('CONTENT_LENGTH') or 0))
        environ['wsgi.input'] = io.BytesIO(body)
        scope = _SCOPE.search(environ.get('HTTP_AUTHORIZATION', ''))
        if scope is None:
            return answers.refusal('ec2', 'MissingAuthenticationToken')
        region, service = scope[2], scope[3]
        target = environ.get('HTTP_X_AMZ_TARGET', '')
        if target:
            action = target.rpartition('.')[2]
            params = json.loads(body or b'{}')
        else:
            params = dict(parse_qsl(body.decode(), keep_blank_values=True))
            action = params.get('Action', '')
        try:
            answer = self._carry_out(environ, service, region, action, params)
        except Refusal as error:
            answer = answers.refusal(service, error.code, str(error))
        code = ''
        if answer.status >= 400:
            found = re.search(rb'<Code>([^<]+)|"__type": ?"(?:[^"#]*#)?([^"]+)', answer.body)
            code = (found[1] or found[2]).decode() if found else str(answer.status)
        with self._lock:
            self.calls.append(Call(service, region, action, code))
        return answer

    def _carry_out(
        self, environ: dict[str, Any], service: str, region: str, action: str,
        params: Mapping[str, Any],
    ) -> Answer:
        if region not in market.ENABLED:
            raise Refusal('AuthFailure')
        if service == 'pricing':
            wanted = {entry['Field']: entry['Value'] for entry in params['Filters']}
            return answers.of_json({'FormatVersion': 'aws_v1', 'PriceList': [
                *market.products(wanted)]})
        if service == 'ssm' and (image := market.image_of(params['Name'], region)) is not None:
            hooks.publish(region, image)
            return answers.of_json({'Parameter': {
                'Name': params['Name'], 'Type': 'String', 'Value': image.id}})
        if service != 'ec2':
            return self._pass_on(environ)
        if action == 'DescribeSpotPriceHistory':
            return self._spot_prices(region, params)
        if action == 'DescribeSpotInstanceRequests':
            return self._spot_requests(params)
        rules.check(region, action, params)
        answer = self._pass_on(environ)
        if any(word in action for word in _GUARDING) and not action.startswith('Describe'):
            self._cloud.protect()
        return answer

    def _pass_on(self, environ: dict[str, Any]) -> Answer:
        got: list[Any] = []

        def start_response(status: str, headers: list[tuple[str, str]], *_: Any) -> None:
            got.extend((status, headers))

        body = b''.join(self._inner(environ, start_response))
        kinds = [value for name, value in got[1] if name.lower() == 'content-type']
        return Answer(int(got[0].split()[0]), kinds[0] if kinds else 'text/plain', body)

    # -- what Moto doesn't know -----------------------------------------------------------

    def _spot_requests(self, params: Mapping[str, str]) -> Answer:
        if params.get('Filter.1.Name') != 'instance-id':
            raise Refusal('InvalidParameterValue', 'a box looks requests up by instance-id')
        machine = self._cloud.machines.get(params.get('Filter.1.Value.1', ''))
        code = 'marked-for-termination' if machine and machine.notice else 'fulfilled'
        return answers.of_ec2('DescribeSpotInstanceRequests', '<spotInstanceRequestSet>' + (
            f'<item><spotInstanceRequestId>sir-{machine.id[-8:]}</spotInstanceRequestId>'
            f'<instanceId>{machine.id}</instanceId><state>active</state><status><code>{code}'
            '</code></status></item>' if machine and machine.spot else '')
            + '</spotInstanceRequestSet>')

    def _spot_prices(self, region: str, params: Mapping[str, str]) -> Answer:
        named = [value for key, value in params.items() if key.startswith('InstanceType.')]
        zones: dict[str, list[str]] = {}
        for zone, kinds in rules.offered(region).items():
            for kind in kinds:
                zones.setdefault(kind, []).append(zone)
        return answers.of_ec2('DescribeSpotPriceHistory', market.spot_history(
            region, named or market.PRICES, zones, datetime.datetime.now(datetime.timezone.utc)))

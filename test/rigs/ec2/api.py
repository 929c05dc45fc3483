# SPDX-License-Identifier: Apache-2.0
"""
The box's AWS: Moto's server, with faults to order, the rules it lacks, and a record of calls.

A WSGI application around Moto's. What Moto can't answer (prices, public parameters) is answered
here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import dataclasses
import datetime
import io
import json
import re
import threading
from typing import Any, Optional
from urllib.parse import parse_qsl

from rigs.computers import faults
from rigs.computers.box import Call
from rigs.ec2 import answers, hooks, market, rules
from rigs.ec2.answers import Answer, Refusal
from rigs.ec2.cloud import Cloud

_SCOPE = re.compile(r'Credential=([^/]+)/\d+/([^/]+)/([^/]+)/aws4_request')
#: Actions after which the router's rules may have to be others.
_GUARDING = ('SecurityGroup', 'ModifyInstanceAttribute', 'ModifyNetworkInterface')
Start = Callable[..., Any]


@dataclasses.dataclass
class Fault:
    """
    An error to order.

    :param code: AWS's error code.
    :param action: the call that gets it, such as RunInstances; '' for every call.
    :param region: '' for every region.
    :param params: the request's parameters that have to have these values.
    :param times: how often; 0 for always.
    :param after: carry the request out first, as if its answer was lost.
    """

    code: str
    action: str = ''
    region: str = ''
    message: str = ''
    params: Mapping[str, str] = dataclasses.field(default_factory=dict)
    times: int = 1
    after: bool = False

    def fits(self, region: str, action: str, params: Mapping[str, str]) -> bool:
        """Return whether a request gets this error."""
        return (self.action in ('', action) and self.region in ('', region)
                and all(params.get(key) == value for key, value in self.params.items()))


class Api:
    """
    The WSGI application.

    :param inner: Moto's.
    """

    def __init__(self, inner: Callable[..., Iterable[bytes]], cloud: Cloud) -> None:
        self._inner = inner
        self._cloud = cloud
        self._lock = threading.Lock()
        self._tokens = rules.Tokens()
        self.faults: list[Fault] = []
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
        fault = self._fault(region, action, params)
        try:
            if fault is not None and not fault.after:
                raise Refusal(fault.code, fault.message)
            answer = self._carry_out(environ, service, region, action, params)
            if fault is not None:
                raise Refusal(fault.code, fault.message)
        except Refusal as error:
            answer = answers.refusal(service, error.code, str(error))
        code = ''
        if answer.status >= 400:
            found = re.search(rb'<Code>([^<]+)|"__type": ?"(?:[^"#]*#)?([^"]+)', answer.body)
            code = (found[1] or found[2]).decode() if found else str(answer.status)
        with self._lock:
            self.calls.append(Call(service, region, action, code))
        return answer

    def _fault(self, region: str, action: str, params: Mapping[str, Any]) -> Optional[Fault]:
        with self._lock:
            return faults.due(self.faults, lambda one: one.fits(region, action, params))

    def _carry_out(
        self, environ: dict[str, Any], service: str, region: str, action: str,
        params: Mapping[str, Any],
    ) -> Answer:
        if region not in market.ENABLED:
            raise Refusal('AuthFailure')
        if service == 'pricing':
            return self._pricing(action, params)
        if service == 'ssm' and action in ('GetParameter', 'GetParameters'):
            found = self._parameters(region, action, params)
            if found is not None:
                return found
        if service != 'ec2':
            return self._pass_on(environ)
        if action == 'DescribeSpotPriceHistory':
            return self._spot_prices(region, params)
        if action == 'DescribeSpotInstanceRequests':
            return self._spot_requests(params)
        rules.check(region, action, params, self._cloud)
        if action == 'RunInstances':
            return self._run(environ, region, params)
        answer = self._pass_on(environ)
        if any(word in action for word in _GUARDING) and not action.startswith('Describe'):
            self._cloud.protect()
        return answer

    def _run(
        self, environ: dict[str, Any], region: str, params: Mapping[str, str],
    ) -> Answer:
        token = params.get('ClientToken', '')
        if not token:
            return self._ran(self._pass_on(environ), region, params)[0]
        with self._tokens.lock(region, token):
            earlier = self._tokens.earlier(region, params)
            if earlier is not None:
                return earlier
            answer, made = self._ran(self._pass_on(environ), region, params)
            if answer.status == 200 and params.get('DryRun', '').lower() != 'true':
                self._tokens.remember(region, params, answer, made)
            return answer

    def _ran(
        self, answer: Answer, region: str, params: Mapping[str, str],
    ) -> tuple[Answer, list[str]]:
        made = [number.decode() for number in
                re.findall(rb'<instanceId>([^<]+)</instanceId>', answer.body)]
        backend = hooks.backend_of(region)
        tags = _tags_of(params, 'network-interface')
        for number in made:
            for nic in backend.get_instance(number).nics.values():
                nic.add_tags(tags)
        return answer, made

    def _pass_on(self, environ: dict[str, Any]) -> Answer:
        got: list[Any] = []

        def start_response(status: str, headers: list[tuple[str, str]], *_: Any) -> None:
            got.extend((status, headers))

        body = b''.join(self._inner(environ, start_response))
        kinds = [value for name, value in got[1] if name.lower() == 'content-type']
        return Answer(int(got[0].split()[0]), kinds[0] if kinds else 'text/plain', body)

    # -- what Moto doesn't know -----------------------------------------------------------

    def _pricing(self, action: str, params: Mapping[str, Any]) -> Answer:
        if action != 'GetProducts' or params.get('ServiceCode') != 'AmazonEC2':
            raise Refusal('InvalidParameterException', f'{action} is not known in a box')
        wanted = {entry['Field']: entry['Value'] for entry in params.get('Filters', ())}
        regions = [wanted['regionCode']] if 'regionCode' in wanted else []
        found = list(market.products(wanted, rules.types(), regions))
        begin = int(params.get('NextToken') or 0)
        size = int(params.get('MaxResults') or 100)
        answer: dict[str, Any] = {
            'FormatVersion': 'aws_v1', 'PriceList': found[begin:begin + size]}
        if begin + size < len(found):
            answer['NextToken'] = str(begin + size)
        return answers.of_json(answer)

    def _parameters(
        self, region: str, action: str, params: Mapping[str, Any],
    ) -> Optional[Answer]:
        names = [params['Name']] if action == 'GetParameter' else list(params.get('Names', ()))
        found = []
        for name in names:
            image = market.image_of(name, region)
            if image is None:
                continue
            hooks.publish(region, image)
            found.append({
                'Name': name, 'Type': 'String', 'Value': image.id, 'Version': 1,
                'LastModifiedDate': 1767225600.0, 'ARN': f'arn:aws:ssm:{region}::parameter{name}',
                'DataType': 'aws:ec2:image'})
        if action == 'GetParameter':
            return answers.of_json({'Parameter': found[0]}) if found else None
        known = {entry['Name'] for entry in found}
        return answers.of_json({
            'Parameters': found, 'InvalidParameters': [n for n in names if n not in known]})

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
            if params.get('AvailabilityZone', zone) == zone:
                for kind in kinds:
                    zones.setdefault(kind, []).append(zone)
        return answers.of_ec2('DescribeSpotPriceHistory', market.spot_history(
            region, named or market.PRICES, zones, datetime.datetime.now(datetime.timezone.utc)))


def _tags_of(params: Mapping[str, str], resource: str) -> dict[str, str]:
    """Return the tags that a request has for a kind of resource."""
    tags = {}
    for key, value in params.items():
        found = re.fullmatch(r'TagSpecification\.(\d+)\.ResourceType', key)
        if found and value == resource:
            top = f'TagSpecification.{found[1]}.Tag.'
            for number in range(1, 51):
                if f'{top}{number}.Key' in params:
                    tags[params[f'{top}{number}.Key']] = params.get(f'{top}{number}.Value', '')
    return tags

# SPDX-License-Identifier: Apache-2.0
"""A provider of AWS at Moto's API whose calls are counted, and refused as a test says."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import functools
import json
from typing import Any, ClassVar, Optional

import boto3
from botocore.awsrequest import AWSResponse

from fogros2.provider.aws import instances
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.cloud import Ec2
from fogros2.provider.aws.provider import AWSProvider

#: The session and its clients, which take longest to make, for all tests of a process.
_SHARED: dict[str, Any] = {}
HOME = 'eu-central-1'
NOTHING: dict[str, list[str]] = {
    'instances': [], 'groups': [], 'keys': [], 'volumes': [], 'addresses': []}


class Watched:
    """
    A provider whose calls are counted, and refused as a test says.

    :ivar calls: (service:Operation, parameters), each call once however often it is repeated.
    """

    #: That of the test that runs.
    newest: ClassVar[Watched]

    def __init__(self) -> None:
        #: Codes of the refusals that were sent, each repetition anew.
        self.sent: list[str] = []
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.refusals: dict[str, list[Optional[tuple[str, str]]]] = {}
        if not _SHARED:
            session = _SHARED['session'] = boto3.session.Session()
            session.events.register(
                'provide-client-params', lambda **words: Watched.newest._called(**words))
            session.events.register('before-send', lambda **words: Watched.newest._sent(**words))
        Watched.newest = self
        self.account = Account()
        self.account._known = _SHARED
        self.provider = AWSProvider(Ec2(self.account))

    def _called(self, params: Any, model: Any, **words: Any) -> None:
        self.calls.append((f'{model.service_model.endpoint_prefix}:{model.name}', dict(params)))

    def refuse(
        self, operation: str, *codes: Optional[str], said: str = 'as AWS said', status: int = 400,
    ) -> None:
        """Answer the next calls of an operation so; None lets one through."""
        self.status = status
        self.refusals[operation] = [
            (code, said) if code else None for code in codes]

    def _sent(self, event_name: str, request: Any, **words: Any) -> Any:
        waiting = self.refusals.get(event_name.rsplit('.', 1)[-1])
        refusal = waiting.pop(0) if waiting else None
        if refusal is None:
            return None
        code, said = refusal
        if 'ssm' in event_name:
            body = json.dumps({'__type': code, 'message': said})
        else:
            body = (f'<Response><Errors><Error><Code>{code}</Code><Message>{said}</Message>'
                    '</Error></Errors><RequestID>1</RequestID></Response>')
        self.sent.append(code)
        status = 503 if code == 'RequestLimitExceeded' else 500 if 'Capacity' in code \
            else self.status
        return AWSResponse(request.url, status, {}, _Raw(body.encode()))

    def count(self) -> Counter[str]:
        """Return how often each call was made."""
        return Counter(name for name, _ in self.calls)

    def asked(self, operation: str) -> list[dict[str, Any]]:
        """Return the parameters of the calls of an operation."""
        return [params for name, params in self.calls if name.endswith(f':{operation}')]


class _Raw:
    """The body of an answer as urllib3 hands it over."""

    def __init__(self, body: bytes) -> None:
        self._body = body

    def stream(self, **words: Any) -> Iterator[bytes]:
        """Yield it."""
        yield self._body


@functools.lru_cache
def ec2(region: str = HOME) -> Any:
    """Return the test's own client: what it asks isn't counted."""
    return boto3.client('ec2', region)


def left(region: str = HOME) -> dict[str, list[str]]:
    """Return what of ours is in a region."""
    client = ec2(region)
    found = instances.instances_in(client.describe_instances(
        Filters=[{'Name': 'instance-state-name', 'Values': list(instances.ALIVE)}]
    )['Reservations'])
    return {
        'instances': [entry['InstanceId'] for entry in found],
        'groups': [entry['GroupId'] for entry in client.describe_security_groups()[
            'SecurityGroups'] if entry['GroupName'] != 'default'],
        'keys': [entry['KeyName'] for entry in client.describe_key_pairs()['KeyPairs']],
        'volumes': [entry['VolumeId'] for entry in client.describe_volumes()['Volumes']],
        'addresses': [entry['PublicIp'] for entry in client.describe_addresses()['Addresses']],
    }

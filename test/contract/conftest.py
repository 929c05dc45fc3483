# SPDX-License-Identifier: Apache-2.0
"""What the contracts need: asserts explained, and an AWS of Moto's on the loopback."""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal
import datetime
import logging
from pathlib import Path
import urllib.request

import pytest

pytest.register_assert_rewrite(
    'fogros2.testing.provider_contract', 'fogros2.testing.shell_contract')


#: Regions that the AWS of the tests has.
MOTO_REGIONS = ('eu-central-1', 'us-east-1')


@pytest.fixture(scope='session')
def moto_server() -> Iterator[str]:
    """Serve Moto's AWS on the loopback; returns its URL."""
    server_module = pytest.importorskip(
        'moto.server', reason="Moto's server is not installed: pip install 'moto[server]'")
    logging.getLogger('werkzeug').setLevel(logging.ERROR)
    server = server_module.ThreadedMotoServer(ip_address='127.0.0.1', port=0, verbose=False)
    server.start()
    yield 'http://{}:{}'.format(*server.get_host_and_port())
    server.stop()


@pytest.fixture
def moto_aws(moto_server: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """Lead boto3 to an empty AWS of Moto's that has the public images; returns its URL."""
    import boto3
    from moto.core import DEFAULT_ACCOUNT_ID
    from moto.ssm.models import Parameter, ssm_backends

    from fogros2.provider.aws import images

    urllib.request.urlopen(urllib.request.Request(
        f'{moto_server}/moto-api/reset', method='POST'), timeout=10.0).close()
    for name, value in {
            'AWS_ENDPOINT_URL': moto_server, 'AWS_ACCESS_KEY_ID': 'test',
            'AWS_SECRET_ACCESS_KEY': 'test', 'AWS_DEFAULT_REGION': 'eu-central-1',
            'AWS_EC2_METADATA_DISABLED': 'true', 'AWS_CONFIG_FILE': str(tmp_path / 'none'),
            'AWS_SHARED_CREDENTIALS_FILE': str(tmp_path / 'none'),
            'FOGROS2_ROBOT_ADDRESS': '198.51.100.7',
            'FOGROS2_AWS_REGIONS': ' '.join(MOTO_REGIONS)}.items():
        monkeypatch.setenv(name, value)
    for name in ('AWS_PROFILE', 'AWS_SESSION_TOKEN', 'AWS_REGION'):
        monkeypatch.delenv(name, raising=False)
    # Moto has no price list
    monkeypatch.setattr('fogros2.provider.aws.choices.price_of',
                        lambda *args, **kwargs: Decimal('0.0416'))
    for region in MOTO_REGIONS:
        ec2 = boto3.client('ec2', region)
        for arch in images.UBUNTU:
            # Moto takes no parameter whose name is AWS's own, and has none of these
            for path in (images.UBUNTU[arch], images.DEEP_LEARNING[arch]):
                image = ec2.register_image(
                    Name=path, Architecture=arch, RootDeviceName='/dev/sda1',
                    VirtualizationType='hvm')['ImageId']
                ssm_backends[DEFAULT_ACCOUNT_ID][region]._parameters[path] = [Parameter(
                    DEFAULT_ACCOUNT_ID, path, image, 'String', None, None, None,
                    datetime.datetime.now(), 1, 'text')]
    return moto_server

# SPDX-License-Identifier: Apache-2.0
"""What the contracts need: asserts explained, and an AWS of Moto's on the loopback."""

from __future__ import annotations

from collections.abc import Iterator
import datetime
from decimal import Decimal
import logging
import os
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
def moto_aws(moto_server: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Lead boto3 to an empty AWS of Moto's that has the public images; returns its URL."""
    from moto.core import DEFAULT_ACCOUNT_ID
    from moto.ec2.models import ec2_backends
    from moto.ec2.models.amis import AmiBackend
    from moto.ssm.models import Parameter, ssm_backends

    from fogros2.provider.aws import images

    # a thousand of other people's images, loaded anew for each test and region
    monkeypatch.setenv('MOTO_EC2_LOAD_DEFAULT_AMIS', 'false')
    urllib.request.urlopen(urllib.request.Request(
        f'{moto_server}/moto-api/reset', method='POST'), timeout=10.0).close()
    for name, value in {
            'AWS_ENDPOINT_URL': moto_server, 'AWS_ACCESS_KEY_ID': 'test',
            'AWS_SECRET_ACCESS_KEY': 'test', 'AWS_DEFAULT_REGION': 'eu-central-1',
            'AWS_EC2_METADATA_DISABLED': 'true', 'AWS_CONFIG_FILE': os.devnull,
            'AWS_SHARED_CREDENTIALS_FILE': os.devnull,
            'FOGROS2_ROBOT_ADDRESS': '198.51.100.7',
            'FOGROS2_AWS_REGIONS': ' '.join(MOTO_REGIONS)}.items():
        monkeypatch.setenv(name, value)
    for name in ('AWS_PROFILE', 'AWS_SESSION_TOKEN', 'AWS_REGION'):
        monkeypatch.delenv(name, raising=False)
    create_image = AmiBackend.create_image

    def create_with_snapshots(self, instance_id, name, description, tag_specifications):
        """Tag an image's snapshot as well, which Moto doesn't know of."""
        kinds = {kind: [tag for spec in tag_specifications if spec['ResourceType'] == kind
                        for tag in spec['Tags']] for kind in ('image', 'snapshot')}
        image = create_image(self, instance_id, name, description, [
            {'ResourceType': 'image', 'Tags': kinds['image']}])
        image.ebs_snapshot.add_tags({tag['Key']: tag['Value'] for tag in kinds['snapshot']})
        return image

    monkeypatch.setattr(AmiBackend, 'create_image', create_with_snapshots)
    # Moto has no price list
    monkeypatch.setattr('fogros2.provider.aws.choices.price_of',
                        lambda *args, **kwargs: Decimal('0.0416'))
    for region in MOTO_REGIONS:
        for arch in images.UBUNTU:
            for path in (images.UBUNTU[arch], images.DEEP_LEARNING[arch]):
                # by its insides: Moto drops what an image is registered with, and takes no
                # parameter whose name is AWS's own
                image = ec2_backends[DEFAULT_ACCOUNT_ID][region].register_image(path, path)
                image.architecture, image.virtualization_type = arch, 'hvm'
                ssm_backends[DEFAULT_ACCOUNT_ID][region]._parameters[path] = [Parameter(
                    DEFAULT_ACCOUNT_ID, path, image.id, 'String', None, None, None,
                    datetime.datetime.now(), 1, 'text')]
    return moto_server

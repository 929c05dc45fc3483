# SPDX-License-Identifier: Apache-2.0
"""
What the provider and the simulated Azure say to each other is what Azure's specification has.

``azure_traffic.json`` has the shapes that Microsoft's validator ``oav`` has accepted. When a shape
changes, validate again (below) and write the new shapes with ``FOGROS2_TRAFFIC=write``.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
import shutil
import subprocess

import pytest

from fogros2.model import MachineSpec
from fogros2.provider.azure.provider import AzureProvider
from fogros2_features.images.keepers import image_keeper
from fogros2_testing import request_for
from rigs.azure import service, traffic

FIXTURE = Path(__file__).with_name('azure_traffic.json')


def spec(name, size, **options):
    return MachineSpec(name, 'azure', {'vm_size': size, 'region': 'westeurope', **options})


@pytest.fixture
def exchanges(azure_service):
    """Return all that three machines say in their lives: usual, evictable, and with a GPU."""
    provider, usual = AzureProvider(), spec('planner', 'Standard_B2als_v2')
    with traffic.recorded(azure_service) as found:
        machine = provider.create(usual, request_for(usual))
        assert list(provider.find({})) and provider.describe(machine)
        provider.allow(machine, 8765, ['198.51.100.0/24'])
        provider.adopt(machine, usual, {'fogros2-launch': 'l2'})
        provider.stop(machine)
        provider.start(machine)
        image = image_keeper(provider).bake(machine, 'mine', 'abc')
        assert list(image_keeper(provider).images())
        image_keeper(provider).delete_image(image)
        provider.destroy(machine)
        azure_service.rights = service.CONTRIBUTOR
        for other in (spec('cheap', 'Standard_B2als_v2', spot=True),
                      spec('seer', 'Standard_NC4as_T4_v3')):
            provider.destroy(provider.create(other, request_for(other)))
    return found


def test_launches_say_what_the_validator_accepted(exchanges):
    # how often something is polled, and in which states, depends on time
    shapes = sorted({one.shape() for one in exchanges
                     if one.method != 'GET' and one.specification()})
    fixture = json.loads(FIXTURE.read_text())
    if os.environ.get('FOGROS2_TRAFFIC') == 'write':
        FIXTURE.write_text(json.dumps({**fixture, 'accepted': shapes}, indent=1) + '\n')
    assert shapes == fixture['accepted']


@pytest.mark.timeout(900)
def test_oav_accepts_what_launches_say(exchanges, tmp_path):
    """By hand: ``oav`` on PATH, and a checkout of azure-rest-api-specs."""
    specs = os.environ.get('FOGROS2_AZURE_SPECS', '')
    if shutil.which('oav') is None or not specs:
        pytest.skip('needs oav on PATH, and FOGROS2_AZURE_SPECS: a checkout of its files')
    runs = {}
    for number, one in enumerate(exchanges):
        if pattern := one.specification():
            version = one.target.partition('api-version=')[2][:10]
            file = traffic.newest(Path(specs), pattern, version)
            folder = tmp_path / f'{file.parent.name}-{file.stem}'
            folder.mkdir(exist_ok=True)
            (folder / f'{number}.json').write_text(json.dumps(one.pair(file.parent.name)))
            runs[folder] = file
    for folder, file in runs.items():
        report = tmp_path / 'report.json'
        subprocess.run(['oav', 'validate-traffic', folder, file, '--jsonReport', report,
                        '--report', tmp_path / 'report.html', '--logLevel', 'off'],
                       check=False, capture_output=True, timeout=300)
        found = json.loads(report.read_text())
        report.unlink()
        assert found['coveredOperations'] and not found['errors'], (file, found['errors'])

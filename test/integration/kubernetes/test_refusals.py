# SPDX-License-Identifier: Apache-2.0
"""What a real cluster refuses: told at once, with the remedy, and nothing is left of the try."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import shutil
import time
import uuid

import pytest

from fogros2.deploy import Launch
from fogros2.errors import FogError
from fogros2.model import MachineSpec
from rigs.cluster import BARE

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]


def refused(timeout: float, *machines: dict[str, object]) -> list[str]:
    """Return the errors, with their hints, of a launch whose machines can't be had."""
    specs = [MachineSpec(f'no-{uuid.uuid4().hex[:6]}', 'kubernetes',
                         {'container_image': BARE, **options}) for options in machines]
    launch = Launch()
    said = []

    def up(spec: MachineSpec) -> str:
        with pytest.raises(FogError) as caught:
            launch.up(spec)
        return f'{caught.value}\n{caught.value.hint}'

    begin = time.monotonic()
    try:
        try:
            launch.prepare(specs)
        except FogError as error:
            return [f'{error}\n{error.hint}']
        with ThreadPoolExecutor() as pool:
            said = list(pool.map(up, specs))
        assert time.monotonic() - begin < timeout, 'it took too long to say so'
    finally:
        assert launch.down() == []
    return said


def test_reason_why_a_pod_does_not_run_is_reported(namespace, monkeypatch):
    # what time might mend is given less of it than usual
    for limit in ('TIMEOUT', 'SCHEDULING'):
        monkeypatch.setattr(f'fogros2.provider.kubernetes.start.{limit}', 4.0)
    gpu, labels, image = refused(
        40.0, {'gpus': 1}, {'node_selector': {'kind': 'moon'}},
        {'container_image': 'fogros2.test/nothing:1'})
    assert 'FailedScheduling: 0/1 nodes are available: 1 Insufficient nvidia.com/gpu' in gpu, gpu
    assert 'device plugin' in gpu, gpu
    assert 'node_selector=' in labels, labels
    assert 'fogros2.test/nothing:1' in image and 'Pull' in image, image
    assert namespace.left() == []


def test_the_quota_is_used_up(namespace):
    namespace.client.create(
        f'/api/v1/namespaces/{namespace.name}/resourcequotas', 'v1 ResourceQuota', 'small',
        spec={'hard': {'limits.memory': '100Mi'}})
    (said,) = refused(15.0, {'mb': 200})
    assert 'exceeded quota: small' in said and 'mb=' in said, said
    assert namespace.left() == []


def test_the_role_is_a_verb_short(namespaces, monkeypatch):
    def without(role):
        (rule,) = [r for r in role['rules'] if r['resources'] == ['pods/exec']]
        rule['verbs'].remove('create')

    space = namespaces(without)
    monkeypatch.setenv('KUBECONFIG', str(space.kubeconfig))
    (said,) = refused(15.0, {})
    assert 'create pods/exec' in said, said
    assert 'role.yaml' in said, said
    assert space.left() == []

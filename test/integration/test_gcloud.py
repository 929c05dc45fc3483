# SPDX-License-Identifier: Apache-2.0
"""Google's command line creates, lists and deletes an instance in the simulated service."""

from __future__ import annotations

import json
import os
import subprocess

from rigs import isolated
from rigs.gce.catalogue import IMAGES


def test_gcloud_creates_lists_and_deletes(gce, tmp_path):
    url = 'http://127.0.0.1:8080'
    variables = {
        'PATH': os.environ['PATH'], 'HOME': str(tmp_path), 'LANG': 'C.UTF-8',
        'CLOUDSDK_CONFIG': str(tmp_path / 'gcloud'), 'CLOUDSDK_CORE_PROJECT': 'robots',
        'CLOUDSDK_CORE_DISABLE_PROMPTS': '1', 'CLOUDSDK_CORE_DISABLE_USAGE_REPORTING': '1',
        'CLOUDSDK_COMPONENT_MANAGER_DISABLE_UPDATE_CHECK': '1',
        'CLOUDSDK_AUTH_CREDENTIAL_FILE_OVERRIDE': str(tmp_path / 'key.json'),
        'CLOUDSDK_AUTH_TOKEN_HOST': f'{url}/token',
        'CLOUDSDK_API_ENDPOINT_OVERRIDES_COMPUTE': f'{url}/compute/v1/'}
    with isolated.serve(gce.api, 'gcloud', port=8080) as prefix:
        def gcloud(*words):
            done = subprocess.run(
                [*prefix, 'gcloud', 'compute', *words, '--format=json'], env=variables, text=True,
                capture_output=True, timeout=400)
            assert done.returncode == 0, done.stderr
            return json.loads(done.stdout or 'null')

        (made,) = gcloud('instances', 'create', 'planner', '--zone=us-central1-a',
                         '--machine-type=e2-medium', f'--image-project={IMAGES[0][0]}',
                         f'--image-family={IMAGES[0][2]}', '--labels=team=slam')
        assert made['status'] == 'RUNNING'
        assert [(one['name'], one['labels']) for one in gcloud('instances', 'list')] == [
            ('planner', {'team': 'slam'})]
        gcloud('instances', 'delete', 'planner', '--zone=us-central1-a')
        assert gcloud('instances', 'list') == []
    assert gce.instances == []

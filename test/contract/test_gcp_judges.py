# SPDX-License-Identifier: Apache-2.0
"""Google's own client of Compute Engine accepts the box."""

from __future__ import annotations

import pytest

from rigs.gce.catalogue import IMAGES

IMAGE = f'projects/{IMAGES[0][0]}/global/images/family/{IMAGES[0][2]}'


@pytest.fixture
def google(gce):
    """Return Google's client of a kind of resource, led to the box."""
    compute = pytest.importorskip('google.cloud.compute_v1', reason='needs google-cloud-compute')
    from google.api_core.client_options import ClientOptions
    from google.auth.credentials import Credentials

    class Token(Credentials):
        """A token of the box, which needs no renewal."""

        def __init__(self):
            super().__init__()
            self.token = gce.api.token()

        def refresh(self, request):
            """Keep the token."""

    def client(kind):
        return getattr(compute, kind)(
            credentials=Token(), transport='rest',
            client_options=ClientOptions(api_endpoint=gce.url))
    return compute, client


def test_googles_client_creates_lists_and_deletes(gce, google):
    compute, client = google
    instances = client('InstancesClient')
    body = compute.Instance(
        name='planner', machine_type='zones/us-central1-a/machineTypes/e2-medium',
        labels={'team': 'slam'},
        disks=[compute.AttachedDisk(
            boot=True, auto_delete=True,
            initialize_params=compute.AttachedDiskInitializeParams(
                source_image=IMAGE, disk_size_gb=20))],
        network_interfaces=[compute.NetworkInterface(
            network='global/networks/default', access_configs=[compute.AccessConfig(
                name='External NAT', type_='ONE_TO_ONE_NAT')])])
    place = {'project': 'robots', 'zone': 'us-central1-a'}
    # an operation that waits for itself would ask Google
    waiting = client('ZoneOperationsClient')

    def done(operation):
        assert not waiting.wait(**place, operation=operation.name).error.errors

    done(instances.insert(**place, instance_resource=body))
    found = instances.get(**place, instance='planner')
    assert (found.status, found.labels) == ('RUNNING', {'team': 'slam'})
    assert found.network_interfaces[0].access_configs[0].nat_i_p
    listed = [instance.name for _, scope in instances.aggregated_list(project='robots')
              for instance in scope.instances]
    assert listed == ['planner']
    done(instances.delete(**place, instance='planner'))
    assert gce.instances == []


def test_googles_client_reads_our_firewall_rules(gce, google):
    from fogros2.model import MachineSpec
    from fogros2.provider.gcp.provider import GCPProvider
    from fogros2_testing import request_for
    _, client = google
    provider, spec = GCPProvider(), MachineSpec('planner', 'gcp', {})
    machine = provider.create(spec, request_for(spec))
    rules = {rule.name.rpartition('-')[2]: rule for rule in client('FirewallsClient').list(
        project='robots') if rule.name.startswith('fogros2-')}
    assert rules['deny'].denied[0].I_p_protocol == 'all'
    assert rules['22'].source_ranges == ['198.51.100.7/32']
    assert max(rules['22'].priority, rules['vpn'].priority) < rules['deny'].priority < 65534
    provider.destroy(machine)

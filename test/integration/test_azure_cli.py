# SPDX-License-Identifier: Apache-2.0
"""Microsoft's command line finds, stops and deletes machines of ours in the simulated service."""

from __future__ import annotations

import pytest

from fogros2.model import MachineSpec
from fogros2.provider.azure.provider import AzureProvider
from fogros2_testing import request_for
from rigs.azure import cli, service

SPEC = MachineSpec('planner', 'azure', {'vm_size': 'Standard_B2als_v2', 'region': 'westeurope'})


@pytest.fixture
def az(azure_service, tmp_path):
    """Yield ``az``, logged in, whose network holds the simulated service and nothing else."""
    with cli.serve(azure_service, tmp_path) as found:
        yield found


@pytest.fixture
def machine(azure_service):
    """Create a machine with our provider; return its id."""
    machine = AzureProvider().create(SPEC, request_for(SPEC))
    # the first description is that of the creation
    assert AzureProvider().describe(machine).state.value == 'running'
    return machine


def test_az_finds_our_machine_and_deletes_it(az, machine):
    name = machine.split('/')[1]
    (group,) = az.ask('group', 'list', '--tag', 'fogros2-name=planner')
    assert (group['name'], group['location']) == (name, 'westeurope')
    (vm,) = az.ask('vm', 'list')
    assert (vm['name'], vm['resourceGroup']) == (name, name)
    assert vm['hardwareProfile']['vmSize'] == 'Standard_B2als_v2'
    shown = az.ask('vm', 'show', '--ids', vm['id'], '--show-details')
    assert (shown['powerState'], shown['provisioningState']) == ('VM running', 'Succeeded')
    assert shown['publicIps'].startswith('198.51.100.')
    az.ask('vm', 'deallocate', '--ids', vm['id'])
    assert AzureProvider().describe(machine).state.value == 'stopped'
    az.ask('vm', 'delete', '--ids', vm['id'], '--yes')
    assert az.ask('vm', 'list', '--resource-group', name) == []
    az.ask('group', 'delete', '--name', name, '--yes')
    assert az.ask('group', 'list') == []
    refused = az.run('group', 'show', '--name', name)
    assert refused.returncode == 3 and 'ResourceGroupNotFound' in refused.stderr


def test_az_rest_reads_what_our_provider_made(az, machine):
    name = machine.split('/')[1]
    root = f'/subscriptions/{service.SUBSCRIPTION}/resourceGroups/{name}/providers'
    rules = az.ask('rest', '--method', 'get', '--url',
                   f'{root}/Microsoft.Network/networkSecurityGroups/{name}/securityRules'
                   '?api-version=2024-05-01')
    assert {rule['properties']['access'] for rule in rules['value']} == {'Allow', 'Deny'}
    missing = az.run('rest', '--method', 'get', '--url',
                     f'{root}/Microsoft.Compute/virtualMachines/nobody?api-version=2024-07-01')
    assert missing.returncode and 'ResourceNotFound' in missing.stderr

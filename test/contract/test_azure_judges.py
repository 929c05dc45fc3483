# SPDX-License-Identifier: Apache-2.0
"""Azure's own SDK finds in the simulated service what it expects of Azure."""

from __future__ import annotations

import base64

import pytest

pytest.importorskip('azure.mgmt.compute', reason='needs azure-mgmt-compute')

from azure.core.exceptions import HttpResponseError, ResourceNotFoundError
from azure.core.pipeline.policies import SansIOHTTPPolicy
from azure.mgmt.compute import ComputeManagementClient
from azure.mgmt.network import NetworkManagementClient
from azure.mgmt.resource.resources import ResourceManagementClient

from rigs.azure import service

HOME = 'westeurope'


class Token(SansIOHTTPPolicy):
    """Authenticates without TLS, which the SDK's own policy refuses."""

    def on_request(self, request):
        request.http_request.headers['Authorization'] = f'Bearer {service.TOKEN}'


@pytest.fixture
def sdk(azure_service, monkeypatch):
    import os
    words = {'base_url': os.environ['FOGROS2_AZURE_ENDPOINT'], 'polling_interval': 0.02,
             'authentication_policy': Token()}
    return [kind(object(), service.SUBSCRIPTION, **words) for kind in (
        ResourceManagementClient, NetworkManagementClient, ComputeManagementClient)]


def network(client, group):
    """Make what a machine needs, and return its network interface."""
    rules = [{'name': 'ssh', 'properties': {
        'priority': 100, 'direction': 'Inbound', 'access': 'Allow', 'protocol': 'Tcp',
        'sourceAddressPrefix': '198.51.100.7/32', 'sourcePortRange': '*',
        'destinationAddressPrefix': '*', 'destinationPortRange': '22'}}]
    firewall = client.network_security_groups.begin_create_or_update(
        group, 'one', {'location': HOME, 'properties': {'securityRules': rules}}).result()
    address = client.public_ip_addresses.begin_create_or_update(group, 'one', {
        'location': HOME, 'sku': {'name': 'Standard'},
        'properties': {'publicIPAllocationMethod': 'Static'}}).result()
    assert address.properties.ip_address
    net = client.virtual_networks.begin_create_or_update(group, 'one', {
        'location': HOME, 'properties': {
            'addressSpace': {'addressPrefixes': ['10.0.0.0/24']},
            'subnets': [{'name': 'a', 'properties': {'addressPrefix': '10.0.0.0/24'}}]}}).result()
    return client.network_interfaces.begin_create_or_update(group, 'one', {
        'location': HOME, 'properties': {
            'networkSecurityGroup': {'id': firewall.id},
            'ipConfigurations': [{'name': 'a', 'properties': {
                'subnet': {'id': net.properties.subnets[0].id},
                'publicIPAddress': {'id': address.id}}}]}}).result()


def machine(nic, size='Standard_D2s_v5'):
    return {
        'location': HOME, 'tags': {'who': 'sdk'}, 'identity': {'type': 'SystemAssigned'},
        'properties': {
            'hardwareProfile': {'vmSize': size},
            'storageProfile': {
                'imageReference': {'publisher': 'Canonical', 'offer': 'ubuntu-24_04-lts',
                                   'sku': 'server', 'version': 'latest'},
                'osDisk': {'createOption': 'FromImage', 'diskSizeGB': 30}},
            'osProfile': {
                'computerName': 'one', 'adminUsername': 'ubuntu',
                'customData': base64.b64encode(b'#!/bin/sh\n').decode(),
                'linuxConfiguration': {'disablePasswordAuthentication': True, 'ssh': {
                    'publicKeys': [{'path': '/home/ubuntu/.ssh/authorized_keys',
                                    'keyData': 'ssh-ed25519 AAAA sdk'}]}}},
            'networkProfile': {'networkInterfaces': [{'id': nic.id}]}}}


def test_sdk_creates_lists_stops_and_deletes_a_machine(sdk):
    groups, net, compute = sdk
    groups.resource_groups.create_or_update('robots', {'location': HOME, 'tags': {'who': 'sdk'}})
    assert [group.name for group in groups.resource_groups.list(
        filter="tagName eq 'who' and tagValue eq 'sdk'")] == ['robots']
    made = compute.virtual_machines.begin_create_or_update(
        'robots', 'one', machine(network(net, 'robots'))).result()
    assert made.properties.provisioning_state == 'Succeeded' and made.identity.principal_id
    assert [vm.name for vm in compute.virtual_machines.list_all()] == ['one']
    view = compute.virtual_machines.get('robots', 'one', expand='instanceView')
    assert [status.code for status in view.properties.instance_view.statuses] == [
        'ProvisioningState/succeeded', 'PowerState/running']
    compute.virtual_machines.begin_deallocate('robots', 'one').result()
    compute.virtual_machines.begin_start('robots', 'one').result()
    with pytest.raises(HttpResponseError):
        net.network_security_groups.begin_delete('robots', 'one').result()
    groups.resource_groups.begin_delete(
        'robots', force_deletion_types='Microsoft.Compute/virtualMachines').result()
    with pytest.raises(ResourceNotFoundError):
        compute.virtual_machines.get('robots', 'one')
    assert not list(groups.resource_groups.list())


def test_sdk_sees_an_allocation_that_fails_late(sdk, azure_service):
    groups, net, compute = sdk
    groups.resource_groups.create_or_update('robots', {'location': HOME})
    azure_service.faults.append(service.Fault(
        'AllocationFailed', 409, 'PUT', 'virtualMachines', late=True))
    begun = compute.virtual_machines.begin_create_or_update(
        'robots', 'one', machine(network(net, 'robots')))
    with pytest.raises(HttpResponseError, match='AllocationFailed'):
        begun.result()
    with pytest.raises(HttpResponseError, match='is not valid'):
        compute.virtual_machines.begin_create_or_update(
            'robots', 'two', machine(network(net, 'robots'), 'Standard_X1'))

# SPDX-License-Identifier: Apache-2.0
"""Requests and reports of machines and their network, converted without any call."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fogros2.model import MachineState
from fogros2.provider.azure.options import OLD_UBUNTU, Options
from fogros2.provider.vm.cloud import Order, own_name, Place, TAG_DISK, Vm, when
from fogros2.provider.vm.options import FREE_PORTS, ipv4, SSH

#: The static public address, and on a network of the user's the private one: VMs do not have it.
TAG_ADDRESS, TAG_PRIVATE = 'fogros2-address', 'fogros2-private-ip'
#: Ubuntu 24.04 of Canonical by architecture and generation; ROS 2 Jazzy is for Ubuntu 24.04.
UBUNTU = {('x86_64', 'V2'): 'server', ('x86_64', 'V1'): 'server-gen1',
          ('arm64', 'V2'): 'server-arm64'}
#: GB of the Ubuntu image's disk.
UBUNTU_DISK = 30
_POWER = {'starting': MachineState.PENDING, 'running': MachineState.RUNNING,
          'stopping': MachineState.STOPPING, 'deallocating': MachineState.STOPPING,
          'stopped': MachineState.STOPPED, 'deallocated': MachineState.STOPPED}


class Prepared(NamedTuple):
    """What is known of a size before a machine is created."""

    image: Mapping[str, str]
    #: GB of the image's disk, the minimum of a machine's; 0 if it is unknown.
    disk: int
    nvidia: bool
    premium: bool
    subnet: str
    guarded: bool


def name_of(order: Order, place: Place) -> str:
    """Return the name of the machine and of its group; the same for the same place."""
    return f'{own_name(order.attempt)}-{order.token(place)[:8]}'


def image_of(named: str, arch: str, generation: str) -> dict[str, str]:
    """Return the reference to the image that is named, or to Ubuntu."""
    if named.startswith('/'):
        return {'id': named}
    if named and named != OLD_UBUNTU:
        return dict(zip(('publisher', 'offer', 'sku', 'version'), named.split(':')))
    return {'publisher': 'Canonical', 'offer': 'ubuntu-24_04-lts', 'version': 'latest',
            'sku': UBUNTU[arch, generation]}


def rule(
    name: str, priority: int, protocol: str, ports: str, sources: Sequence[str], *,
    access: str = 'Allow',
) -> dict[str, Any]:
    """Return an inbound rule; a machine has no IPv6 address, so IPv6 sources are left out."""
    networks = ipv4(sources) or ['*']
    where = {'sourceAddressPrefix': '*'} if networks == ['*'] else {
        'sourceAddressPrefixes': networks}
    return {'name': name, 'properties': {
        'priority': priority, 'direction': 'Inbound', 'access': access, 'protocol': protocol,
        **where, 'sourcePortRange': '*', 'destinationAddressPrefix': '*',
        'destinationPortRange': ports}}


def open_port(port: int, sources: Sequence[str]) -> dict[str, Any]:
    """Return the rule that lets networks reach a TCP port; ``sources`` has an IPv4 network."""
    return rule(f'tcp-{port}', 100 + port % 3000, 'Tcp', str(port), sources)


def firewall(order: Order) -> dict[str, Any]:
    """Return the rules of a new machine; without the last, a network's machines reach it."""
    ssh = [open_port(SSH, order.sources)] if ipv4(order.sources) else []
    fleet = [
        rule(f'fleet-{protocol}', priority, protocol, '{}-{}'.format(*FREE_PORTS), order.sources)
        for priority, protocol in ((3201, 'Tcp'), (3202, 'Udp'))] if order.options.fleet else []
    return {'securityRules': [
        *ssh, *fleet, rule('vpn', 3200, 'Udp', str(order.request.vpn_port), ()),
        rule('nothing-else', 4096, '*', '*', (), access='Deny')]}


def request(
    place: Place, order: Order, prepared: Prepared, nic: str, tags: Mapping[str, str],
) -> dict[str, Any]:
    """
    Return the body that creates a machine.

    :param nic: resource id of the network interface.
    """
    options: Options = order.options
    # Azure takes the size of an unknown image's disk
    disk = max(options.disk_size, UBUNTU_DISK, prepared.disk) \
        if prepared.disk or 'disk_size' in order.spec.options else 0
    spot = {'priority': 'Spot', 'evictionPolicy': 'Delete', 'billingProfile': {
        'maxPrice': -1 if options.max_price is None else float(options.max_price)}}
    return {
        'location': place.region, 'tags': {**tags, **({TAG_DISK: str(disk)} if disk else {})},
        **({'identity': {'type': 'SystemAssigned'}} if prepared.guarded else {}),
        'properties': {
            'hardwareProfile': {'vmSize': place.kind},
            'storageProfile': {'imageReference': dict(prepared.image), 'osDisk': {
                'createOption': 'FromImage', 'deleteOption': 'Delete',
                **({'diskSizeGB': disk} if disk else {}),
                'managedDisk': {'storageAccountType':
                                'Premium_LRS' if prepared.premium else 'StandardSSD_LRS'}}},
            'osProfile': {
                'computerName': order.spec.name, 'adminUsername': options.user,
                'customData': base64.b64encode(order.user_data).decode(),
                'linuxConfiguration': {
                    'disablePasswordAuthentication': True,
                    'ssh': {'publicKeys': [{
                        'path': f'/home/{options.user}/.ssh/authorized_keys',
                        'keyData': order.request.authorized_key.strip()}]}}},
            'networkProfile': {'networkInterfaces': [
                {'id': nic, 'properties': {'primary': True, 'deleteOption': 'Delete'}}]},
            'diagnosticsProfile': {'bootDiagnostics': {'enabled': True}},
            **(spot if options.spot else {}),
        }}


def region_of(entry: Mapping[str, Any]) -> str:
    """Return the region of a resource."""
    return str(entry['location']).lower().replace(' ', '')


def vm_of(entry: Mapping[str, Any], statuses: Sequence[Mapping[str, Any]] = ()) -> Vm:
    """
    Convert a virtual machine.

    :param statuses: those of its instance view; () if the entry has them itself.
    """
    properties, tags = entry['properties'], dict(entry.get('tags') or {})
    statuses = statuses or properties.get('instanceView', {}).get('statuses') or ()
    words = {kind: rest for kind, _, rest in (
        str(status.get('code', '')).partition('/') for status in statuses)}
    making = str(properties.get('provisioningState', ''))
    state = _POWER.get(words.get('PowerState', ''), MachineState.PENDING)
    if making == 'Deleting':
        state = MachineState.DELETED
    elif making == 'Failed' and state is MachineState.PENDING:
        state = MachineState.STOPPED
    elif making == 'Updating' and words.get('PowerState') == 'deallocated':
        state = MachineState.PENDING  # asked to start
    image = properties.get('storageProfile', {}).get('imageReference', {})
    group = str(entry['id']).split('/')[4]
    private_ip, _, network = tags.get(TAG_PRIVATE, '').partition(' ')
    return Vm(
        # the machine's own name is that of its group
        group.lower(), region_of(entry), state, tags, billed=words.get('PowerState') == 'stopped',
        kind=str(properties.get('hardwareProfile', {}).get('vmSize', '')),
        spot=properties.get('priority') == 'Spot', address=tags.get(TAG_ADDRESS, ''),
        private_network=network and f'azure:{network}', private_ip=private_ip,
        created=when(properties.get('timeCreated')),
        image=str(image.get('id') or ':'.join(filter(None, (
            str(image.get(part, '')) for part in ('publisher', 'offer', 'sku', 'version'))))),
        reason='; '.join(str(status['message']) for status in statuses if status.get('message')))

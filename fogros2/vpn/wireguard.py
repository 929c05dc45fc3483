# SPDX-License-Identifier: Apache-2.0
"""
WireGuard, in the kernel where it has the module, else ``wireguard-go`` on a persistent TUN.

A machine whose own networks overlap the launch's (the robot's don't: that is how it was chosen)
keeps them: it gets a route to each peer instead of one to the network (``host_routes``).

Each host gets one short ``sh`` script per task, as each process costs milliseconds and a machine
may be far away. A script is put together from steps, each written beside its undo; ``down`` runs
the undos backwards.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
import ipaddress
from pathlib import Path
import re
import shlex

from fogros2.errors import ConfigurationError, VpnError
from fogros2.model import Command, Peer, VpnInterface
from fogros2.vpn import Vpn

#: Programs each host needs, and the Debian and Ubuntu packages they come in. ``wireguard-go`` is
#: for kernels without the module alone, ``nft`` for guarded interfaces.
PACKAGES = {
    'wg': 'wireguard-tools', 'ip': 'iproute2', 'nft': 'nftables', 'wireguard-go': 'wireguard-go'}
#: Seconds between packets that keep a NAT's mapping: routers forget one after 30 s or more.
KEEPALIVE = 25
#: RTPS 2.5, 9.6.2.3: ports of a domain begin at 7400 + 250 * domain and the next one's follow.
PORT_BASE = 7400
PORTS_PER_DOMAIN = 250
#: RTPS 2.5, 9.6.2.4: participants announce themselves to this group.
DISCOVERY_GROUP = '239.255.0.1'
MAX_NAME = 15
#: Packets that may wait for ``wireguard-go``; the kernel's default is 500. A raw VGA image has 720
#: at once, and a busy processor lets several images wait.
QUEUE = 3000

#: Shell text that makes of ``wg show ... endpoints`` questions to ``ip -batch``, one for each host
#: that is known.
_ASK = r"sed -n 's/^[^[:space:]]*[[:space:]]*\[*\([^][]*\)\]*:[0-9]*$/route get \1/p'"
#: Shell text that makes of the answers the addresses of this computer that packets leave from.
_FROM = r"ip -force -batch - 2>/dev/null | sed -n 's/.* src \([^ ]*\).*/\1/p'"
_KEY = re.compile('[A-Za-z0-9+/]{43}=')
_ENDPOINT = re.compile(r'([\w.-]+|\[[0-9a-fA-F:.%\w]+\]):\d+', re.ASCII)


@dataclasses.dataclass(frozen=True)
class _Step:
    """Shell text that does something, idempotent, and what undoes it ('' for nothing to do)."""

    do: str
    undo: str = ''


class WireGuard(Vpn):
    """
    The commands of a WireGuard interface; they need root and the programs of ``PACKAGES``.

    :param domain: ROS_DOMAIN_ID, whose DDS ports a guarded interface lets in.
    :param ports: ranges of UDP ports that it lets in besides, first and last.
    """

    def __init__(self, domain: int = 0, ports: Sequence[tuple[int, int]] = ()) -> None:
        if not 0 <= domain <= (65535 - PORT_BASE) // PORTS_PER_DOMAIN:
            raise ConfigurationError(f'ROS_DOMAIN_ID {domain} has no DDS ports', 'use 0 to 101')
        self.domain = domain
        self.ports = (dds_ports(domain), *ports)

    def keys(self, interface: VpnInterface) -> Command:
        """Return the command that prints the public key; the private one is root's alone."""
        key = shlex.quote(interface.key_file)
        folder = shlex.quote(interface.key_file.rpartition('/')[0] or '.')
        # written aside and moved, so that a key that is there is a whole one; -C follows no link
        return Command.script(
            f'umask 077; set -C\n'
            f'if [ ! -s {key} ]; then\n'
            f'  mkdir -p {folder}; wg genkey >{key}.$$; mv -f {key}.$$ {key}\n'
            f'fi\n'
            f'wg pubkey <{key}',
            sudo=True, what='make the VPN key')

    def up(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """
        Yield one script: filter, interface, keys and peers, address.

        The filter is there before the interface.
        """
        steps = self._steps(interface, peers)
        yield Command.script(
            '\n'.join(step.do for step in steps), sudo=True, what=_what('set', interface, 'up'))

    def peers(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield what makes these the peers, and leaves the sessions of those that stay."""
        yield Command.script(
            '\n'.join([_configure(interface, peers), *_routes(interface, peers),
                       _buffer(interface)]), sudo=True,
            what=_what('tell', interface, 'its peers'))

    def alive(self, interface: VpnInterface) -> Command:
        """
        Return a command of a few milliseconds, which on the robot needs no root.

        A TUN has a carrier as long as a program has it open; a WireGuard interface of the kernel
        always has. Without the interface, or where it is down, reading that fails.

        On the robot it also fails when packets to a peer leave from another address than they
        did: ``wireguard-go`` goes on sending from the former, 15 s long, and ``repair`` makes it
        look again. Networks that lead to no peer may come and go. A machine notes where its peers
        are, for ``repair``: behind its NAT the robot can't be dialled elsewhere, and would itself
        notice the lost session after 15 s only.
        """
        name = _name(interface)
        lines = [
            f'read -r carrier 2>/dev/null </sys/class/net/{name}/carrier',
            '[ "$carrier" = 1 ]']
        if interface.guarded:
            noted = _noted(interface)
            lines.append(f'[ ! -e {noted} ] || {{ read -r _ before; '
                         f'set -- $({_FROM}); [ "$*" = "$before" ]; }} <{noted}')
        else:
            lines.append(f'found=$(wg show {name} endpoints) && '
                         f'printf "%s\\n" "$found" >{_noted(interface)} || :')
        return Command.script(
            '\n'.join(lines), sudo=not interface.guarded, what=_what('look at', interface))

    def repair(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """
        Yield the script of ``up``, which leaves a TUN that is there in its place.

        Peers without an endpoint get the one that ``alive`` saw last.
        """
        steps = self._steps(interface, peers, recall=True)
        yield Command.script(
            '\n'.join(step.do for step in steps), sudo=True, what=_what('repair', interface))

    def status(self, interface: VpnInterface) -> Command:
        """Return a command that asks for counters alone: ``dump`` would print the private key."""
        name = _name(interface)
        return Command.script(
            f'wg show {name} latest-handshakes; wg show {name} transfer', sudo=True,
            what=_what('ask', interface, 'for its counters'))

    def parse_status(self, output: str) -> dict[str, dict[str, float]]:
        """
        Return handshake, received and sent per peer.

        :raises VpnError: the text isn't what ``status`` prints.
        """
        found: dict[str, dict[str, float]] = {}
        for line in output.splitlines():
            key, *values = line.split()
            try:
                numbers = [float(value) for value in values]
            except ValueError as error:
                raise VpnError(f"can't read WireGuard's counters: {line!r}") from error
            peer = found.setdefault(key, {'handshake': 0.0, 'received': 0.0, 'sent': 0.0})
            if len(numbers) == 1:
                peer['handshake'] = numbers[0]
            elif len(numbers) == 2:
                peer['received'], peer['sent'] = numbers
            else:
                raise VpnError(f"can't read WireGuard's counters: {line!r}")
        return found

    def down(self, interface: VpnInterface) -> Iterator[Command]:
        """Yield one script that undoes ``up`` backwards and goes on where a part fails."""
        undos = [step.undo for step in reversed(self._steps(interface, ())) if step.undo]
        lines = ['failed=0', *(f'{{ {undo}\n}} || failed=1' for undo in undos)]
        files = f'{shlex.quote(interface.key_file)} {_noted(interface)}'
        lines += [f'rm -f {files} || failed=1', 'exit $failed']
        yield Command.script('\n'.join(lines), sudo=True, what=_what('take', interface, 'down'))

    def _steps(
        self, interface: VpnInterface, peers: Sequence[Peer], *, recall: bool = False,
    ) -> list[_Step]:
        guard = [_guard(interface, self.ports)] if interface.guarded else []
        return [
            *guard, _link(interface), _Step(_configure(interface, peers, recall=recall)),
            _address(interface, peers), _Step(_buffer(interface))]


def dds_ports(domain: int) -> tuple[int, int]:
    """
    Return the first and last UDP port that DDS uses in a ROS domain.

    In it are multicast discovery (+0) and data (+1), and per participant i unicast discovery
    (+10 + 2 i) and data (+11 + 2 i), i up to 119.
    """
    begin = PORT_BASE + PORTS_PER_DOMAIN * domain
    return begin, begin + PORTS_PER_DOMAIN - 1


def _what(verb: str, interface: VpnInterface, rest: str = '') -> str:
    return ' '.join(part for part in (verb, 'the VPN interface', interface.name, rest) if part)


def _name(interface: VpnInterface) -> str:
    name = interface.name
    if not name.isalnum() or not name.isascii() or len(name) > MAX_NAME or name[0].isdigit():
        raise ConfigurationError(
            f"'{name}' can't name a VPN interface", f'at most {MAX_NAME} letters and digits')
    return name


def _guard(interface: VpnInterface, ports: Sequence[tuple[int, int]]) -> _Step:
    """
    Return the step that keeps a hijacked machine from everything but DDS and ping.

    One table, so that one delete is its undo. The table is replaced as a whole, in one
    transaction: no moment without it. Another table's accept doesn't reach over a drop here, nor
    an accept here over a drop there (a firewall of the user's own has to let the VPN in).
    """
    name = _name(interface)
    let_in = ', '.join(f'{first}-{last}' for first, last in ports)
    # an address check, as a peer may send to any address of this computer, a LAN's too
    rules = [
        f'table inet {name}',
        f'delete table inet {name}',
        f'table inet {name} {{',
        '  chain input {',
        '    type filter hook input priority filter; policy accept;',
        f'    iifname != "{name}" accept',
        f'    ip daddr != {{ {interface.address}, {DISCOVERY_GROUP} }} drop',
        '    ct state established,related accept',
        f'    udp dport {{ {let_in} }} accept',
        '    icmp type echo-request accept',
        '    drop',
        '  }',
        '  chain forward {',
        '    type filter hook forward priority filter; policy accept;',
        f'    iifname "{name}" drop',
        f'    oifname "{name}" drop',
        '  }',
        '}']
    # the first line makes the table where it is missing, so that the second can't fail
    return _Step(
        f'{_print(rules)} | nft -f -',
        f'! command -v nft >/dev/null || '
        f'{_print(rules[:2])} | nft -f -')


def _link(interface: VpnInterface) -> _Step:
    """
    Return the step that makes the interface.

    ``wireguard-go`` exits when its socket goes, and makes the TUN itself where there is none; made
    by ``ip tuntap`` it stays when that process dies, and so do the sockets of the nodes. Its
    network namespace tells it from other processes of its name, such as those in containers.

    A port that somebody has is found before: ``wireguard-go`` may bind it after all has been set,
    and tell nobody that it couldn't.
    """
    name = _name(interface)
    socket = f'/var/run/wireguard/{name}.sock'
    do = f"""\
[ -e /sys/class/net/{name} ] || ! ss -Hlun 'sport = :{interface.port}' | grep -q . || {{
  echo "UDP port {interface.port}: Address already in use" >&2
  exit 1
}}
if wg show {name} listen-port >/dev/null 2>&1; then :
elif said=$(ip link add dev {name} type wireguard 2>&1); then :
elif command -v wireguard-go >/dev/null; then
  [ -c /dev/net/tun ] || {{ mkdir -p /dev/net && mknod -m 666 /dev/net/tun c 10 200; }} || {{
    echo "no WireGuard in this kernel ($said), and no /dev/net/tun nor the right to make it" >&2
    exit 1
  }}
  [ -e /sys/class/net/{name} ] || ip tuntap add dev {name} mode tun
  rm -f {socket}
  said=$(setsid wireguard-go {name} 2>&1 >/dev/null) || {{ echo "$said" >&2; exit 1; }}
else
  echo "no WireGuard in this kernel ($said) and no wireguard-go" >&2; exit 1
fi"""
    undo = f"""\
for each in $(grep -lsxz {name} /proc/[0-9]*/cmdline); do
  each=${{each%/cmdline}}
  read -r program 2>/dev/null <$each/comm || continue
  [ "$program" = wireguard-go ] && [ $each/ns/net -ef /proc/self/ns/net ] || continue
  kill -9 ${{each#/proc/}} || :
done
rm -f {socket}
# somebody else, an agent say, may take it away at the same moment
ip link delete dev {name} 2>/dev/null || [ ! -e /sys/class/net/{name} ]"""
    return _Step(do, undo)


def _configure(
    interface: VpnInterface, peers: Sequence[Peer], *, recall: bool = False,
) -> str:
    """
    Return the text that feeds ``wg``: the key goes through the shell's own printf alone.

    ``syncconf`` replaces the peers as ``setconf`` does, but sessions of those that stay go on.

    :param recall: fill in endpoints that aren't known from what ``alive`` noted.
    """
    key = shlex.quote(interface.key_file)
    lines = [f'read -r key <{key}']
    if recall:
        # in the first configuration: a handshake that finds no endpoint is retried after 5 s
        lines.append(
            f'seen() {{ while read -r peer at; do case "$peer $at" in "$1 ("*) ;; "$1 "*) '
            f'echo "Endpoint = $at";; esac; done 2>/dev/null <{_noted(interface)} || :; }}')
    lines += ['{', "printf '[Interface]\\nPrivateKey = %s\\n' \"$key\""]
    config = [f'ListenPort = {interface.port}']
    for number, peer in enumerate(peers):
        _check(peer)
        allowed = f'{peer.address}/32'
        if number == 0:
            # an address leads to one peer: the robot on machines, the only machine on most robots
            allowed += f', {DISCOVERY_GROUP}/32'
        config += [
            '[Peer]', f'PublicKey = {peer.public_key}', f'AllowedIPs = {allowed}',
            f'PersistentKeepalive = {KEEPALIVE}']
        if peer.endpoint is not None:
            config.append(f'Endpoint = {peer.endpoint}')
        elif recall:
            lines.append(_print(config))
            lines.append(f'seen {shlex.quote(peer.public_key)}')
            config = []
    lines += [_print(config)] if config else []
    lines.append(f'}} | wg syncconf {_name(interface)} /dev/stdin')
    if interface.guarded:
        # for ``alive``, which isn't root
        lines += [f'ask=$(wg show {_name(interface)} endpoints | {_ASK})',
                  f'(umask 022; {{ echo "#" $(echo "$ask" | {_FROM}); echo "$ask"; }} '
                  f'>{_noted(interface)})']
    return '\n'.join(lines)


def _check(peer: Peer) -> None:
    """Keep what another host said about itself from saying more than its place in the VPN."""
    try:
        ipaddress.IPv4Address(peer.address)
    except ValueError as error:
        raise VpnError(f'{peer.name} has no VPN address: {error}') from error
    if not _KEY.fullmatch(peer.public_key):
        raise VpnError(f'{peer.name} has no WireGuard key, but {peer.public_key[:50]!r}')
    if peer.endpoint is not None and not _ENDPOINT.fullmatch(peer.endpoint):
        raise VpnError(f'{peer.name} has no endpoint host:port, but {peer.endpoint[:50]!r}')


def _noted(interface: VpnInterface) -> str:
    # not beside the key, whose folder may be the login user's: root wouldn't write where another
    # can lay a link
    return f'/run/{_name(interface)}.noted'


def _print(lines: Sequence[str]) -> str:
    return ' '.join(["printf '%s\\n'", *(shlex.quote(line) for line in lines)])


def _address(interface: VpnInterface, peers: Sequence[Peer]) -> _Step:
    name = _name(interface)
    prefix = interface.network.rpartition('/')[2]
    # without the network's route, one of the host's own that overlaps it goes on to hold
    alone = ' noprefixroute' if interface.host_routes else ''
    lines = [
        f'address replace {interface.address}/{prefix} dev {name}{alone}',
        f'link set dev {name} mtu {interface.mtu} multicast on txqueuelen {QUEUE} up']
    do = f'{_print(lines)} | ip -batch -'
    own = [_free(interface, interface.address)] if interface.host_routes else []
    return _Step('\n'.join([*own, do, *_routes(interface, peers)]))


def _buffer(interface: VpnInterface) -> str:
    """
    Return the text that enlarges the receive buffer of a ``wireguard-go``.

    Each configuration opens its sockets anew. Without the right to do so the VPN works as well,
    and loses more of large images.
    """
    name = _name(interface)
    source = Path(__file__).with_name('receive_buffer.py').read_text()
    return (f'[ ! -S /var/run/wireguard/{name}.sock ] || '
            f'python3 -I -c {shlex.quote(source)} {name} || :')


def _routes(interface: VpnInterface, peers: Sequence[Peer]) -> list[str]:
    """
    Return what leads to each peer where the network as a whole isn't led into the VPN.

    Such a route is the most specific there is, so it wins over any network of the host's own, and
    takes no more of that than these addresses. One that the host has for itself is refused.
    """
    if not interface.host_routes:
        return []
    lines = [f'route replace {peer.address}/32 dev {_name(interface)}' for peer in peers]
    return [*(_free(interface, peer.address) for peer in peers),
            f'{_print(lines)} | ip -batch -']


def _free(interface: VpnInterface, address: str) -> str:
    """Return the text that fails if the host leads an address of the VPN elsewhere or has it."""
    # the robot's interface of the same launch, where the machine is the robot itself, is no other
    launch = re.sub('m[0-9]+$', '', _name(interface))
    exact = address.replace('.', '[.]')
    return (f"taken=$(ip -4 route show table all match {address} | grep -E '^(local )?{exact} ' "
            f"| grep -vE ' dev {launch}(m[0-9]+)?( |$)' || :)\n"
            f'[ -z "$taken" ] || {{ echo "in use already: $taken" >&2; exit 1; }}')

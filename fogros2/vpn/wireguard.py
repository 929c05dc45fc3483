# SPDX-License-Identifier: Apache-2.0
"""
WireGuard: in the kernel if it has the module, else ``wireguard-go`` on a persistent TUN.

A machine may have networks that overlap the launch's subnet; the robot has none, because it chose
the subnet accordingly. Such a machine keeps its networks, and gets a route to each peer instead of
one to the subnet (``host_routes``).

Each host gets one short ``sh`` script per task, because each process costs milliseconds and a
machine may be far away. A script consists of steps, each written beside its undo; ``down`` runs
the undo parts in reverse order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
import ipaddress
import re
import shlex

from fogros2.errors import ConfigurationError, VpnError
from fogros2.model import Command, Peer, VpnInterface
from fogros2.vpn import addresses, MTU, STAYS, Vpn
from fogros2.vpn.addresses import DISCOVERY_GROUP

#: Programs that each host needs, and their Debian and Ubuntu packages. ``wireguard-go`` is only
#: for kernels without the module.
PACKAGES = {
    'wg': 'wireguard-tools', 'ip': 'iproute2', 'nft': 'nftables', 'wireguard-go': 'wireguard-go'}
#: Interval of keepalive packets in seconds: routers keep a NAT mapping for 30 s or more.
KEEPALIVE = 25
MAX_NAME = 15
#: Matches messages of DDS: their first bytes are 'RTPS' (RTPS 2.5, 9.4.4). The hooks of the filter
#: see whole datagrams: the kernel reassembles before ``input``, and fragments after ``output``.
RTPS = 'meta l4proto udp @th,64,32 0x52545053'
#: How long a computer of the LAN stays known without a message. Stock nodes announce themselves
#: each 30 s or more often.
LAN_TIMEOUT = '5m'
#: Packets that may queue for ``wireguard-go``; the kernel's default is 500. A raw VGA image has
#: 800 packets at once, and on a busy processor several images queue.
QUEUE = 3000

#: Shell text that turns ``wg show ... endpoints`` into requests to ``ip -batch``, one for each
#: known host.
_ASK = r"sed -n 's/^[^[:space:]]*[[:space:]]*\[*\([^][]*\)\]*:[0-9]*$/route get \1/p'"
#: Shell text that turns the answers into this computer's source addresses to these hosts.
_FROM = r"ip -force -batch - 2>/dev/null | sed -n 's/.* src \([^ ]*\).*/\1/p'"
#: A login user's PATH may lack the folders of ``nft``.
_PATH = 'PATH=$PATH:/usr/sbin:/sbin'
#: Shell text that sets ``top`` to the folder of control groups, version 2.
_GROUPS = (
    'top=/sys/fs/cgroup; [ -e $top/cgroup.procs ] || top=$top/unified; '
    '[ -e $top/cgroup.procs ] || { echo "version 2 is missing"; return 1; }')
_KEY = re.compile('[A-Za-z0-9+/]{43}=')
_ENDPOINT = re.compile(r'([\w.-]+|\[[0-9a-fA-F:.]+(%[\w.-]+)?\]):\d+', re.ASCII)


@dataclasses.dataclass(frozen=True)
class _Step:
    """Shell text of an idempotent step, and of its undo ('' for nothing to undo)."""

    do: str
    undo: str = ''


class WireGuard(Vpn):
    """
    Commands for a WireGuard interface; they need root and the programs of ``PACKAGES``.

    :param ports: ranges of UDP ports that an interface with a firewall admits, as (first, last).
    :param asked: IPv4 addresses outside the VPN to which the robot's nodes may send: those that
        the user configured, and those of joined machines.
    """

    def __init__(self, ports: Sequence[tuple[int, int]] = (), asked: Sequence[str] = ()) -> None:
        self.ports = tuple(ports)
        self.asked = tuple(asked)

    def keys(self, interface: VpnInterface) -> Command:
        """Return the command that prints the public key; only root can read the private key."""
        key = shlex.quote(interface.key_file)
        folder = shlex.quote(interface.key_file.rpartition('/')[0] or '.')
        # written aside and moved, so an existing key is complete; -C follows no symbolic link
        return Command.script(
            f'umask 077; set -C\n'
            f'if [ ! -s {key} ]; then\n'
            f'  mkdir -p {folder} && wg genkey >{key}.$$ || :\n'
            f'  [ -s {key}.$$ ] || {{ rm -f {key}.$$ || :\n'
            f'    reason="is the disk full?"; [ -w {folder} ] || reason="root may not write there,'
            ' so name a folder of a local disk in FOGROS2_STATE_HOME"\n'
            f'    echo {key}" can\'t be written: $reason" >&2; exit 1; }}\n'
            f'  mv -f {key}.$$ {key}\n'
            f'fi\n'
            f'wg pubkey <{key}',
            sudo=True, what='make the VPN key')

    def up(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """
        Yield one script that creates the filter, the interface, keys and peers, and the address.

        The filter exists before the interface.
        """
        yield self._script(interface, peers, _what('set', interface, 'up'))

    def peers(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield the commands that set the peers, and keep the sessions of remaining ones."""
        yield Command.script(
            '\n'.join([_configure(interface, peers), *_routes(interface, peers)]), sudo=True,
            what=_what('tell', interface, 'its peers'))

    def health_check(self, interface: VpnInterface) -> Command:
        """
        Return the health check: a few milliseconds, and no root on the robot.

        A TUN has a carrier while a program has it open; a WireGuard interface of the kernel always
        has one. Reading the carrier fails if the interface is missing or down. Network managers
        may remove addresses that they did not set: systemd-networkd does so at its restart.

        On the robot the check also fails when the source address of packets to a peer has changed:
        ``wireguard-go`` would use the old address for 15 s, and ``repair`` makes it look again.
        Networks that lead to no peer may come and go. A machine notes its peers' endpoints for
        ``repair``: without them it could not reach a robot behind NAT, which would notice the lost
        session only after 15 s. On a machine the check also fails without the filter, which other
        programs may delete (``nft flush ruleset``); the robot looks for its own by ``status``.
        """
        name, noted = _name(interface), _noted(interface)
        lines = [
            _PATH, f'read -r carrier 2>/dev/null </sys/class/net/{name}/carrier',
            '[ "$carrier" = 1 ]',
            f'ip -4 -o address show dev {name} | grep -qF " {interface.address}/"']
        if interface.firewall:
            lines.append(f'[ ! -e {noted} ] || {{ read -r _ before; '
                         f'set -- $({_FROM}); [ "$*" = "$before" ]; }} <{noted}')
        else:
            # every tenth second only: it takes longer than all else here
            lines += ['read -r up _ </proc/uptime',
                      f'[ $((${{up%.*}} % 10)) != 0 ] || {_look(name)}']
            lines.append(f'found=$(wg show {name} endpoints) && '
                         f'{{ [ "$found" = "$(cat {noted} 2>/dev/null)" ] || '
                         f'printf "%s\\n" "$found" >{noted}; }} || :')
            due = f'{more(interface)}.due'
            lines.append(f'[ ! -e {due} ] || {{ read -r due; read -r up _ </proc/uptime; '
                         '[ "${up%.*}" -lt "$due" ] || '
                         f'{_more(interface, "look")} >/dev/null; }} <{due} || :')
        return Command.script(
            '\n'.join(lines), sudo=not interface.firewall, what=_what('look at', interface))

    def repair(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """
        Yield the script of ``up``, which keeps an existing TUN.

        Peers without an endpoint get the one that the health check noted last.
        """
        yield self._script(interface, peers, _what('repair', interface), recall=True)

    def status(self, interface: VpnInterface) -> Command:
        """
        Return a command that prints only counters: ``dump`` would print the private key.

        The command fails without the filter, too.
        """
        name = _name(interface)
        return Command.script(
            f'{_PATH}\nwg show {name} latest-handshakes; wg show {name} transfer\n{_look(name)}',
            sudo=True, what=_what('ask', interface, 'for its counters'))

    def parse_status(self, output: str) -> dict[str, dict[str, float]]:
        """
        Parse handshake, received and sent bytes of each peer.

        :raises VpnError: the text is not the output of :meth:`status`.
        """
        counters: dict[str, dict[str, float]] = {}
        for line in output.splitlines():
            key, *values = line.split()
            try:
                numbers = [float(value) for value in values]
            except ValueError as error:
                raise VpnError(f"can't read WireGuard's counters: {line!r}") from error
            peer = counters.setdefault(key, {'handshake': 0.0, 'received': 0.0, 'sent': 0.0})
            if len(numbers) == 1:
                peer['handshake'] = numbers[0]
            elif len(numbers) == 2:
                peer['received'], peer['sent'] = numbers
            else:
                raise VpnError(f"can't read WireGuard's counters: {line!r}")
        return counters

    def down(self, interface: VpnInterface) -> Iterator[Command]:
        """Yield one script that undoes ``up`` in reverse order, and continues after errors."""
        undos = [step.undo for step in reversed(self._steps(interface, ())) if step.undo]
        key, files = shlex.quote(interface.key_file), _noted(interface)
        if not interface.firewall:
            undos.insert(0, f'[ ! -e {more(interface)} ] || {_more(interface, "clear")}')
            files += f' {more(interface)} {more(interface)}.* /run/{_name(interface)}.watch*'
        lines = [_PATH, 'failed=0', *(f'{{ {undo}\n}} || failed=1' for undo in undos)]
        # root may be unable to enter the key's folder, and then has made no key
        lines += [f'[ ! -e {key} ] || rm -f {key} || failed=1',
                  f'rm -f {files} || failed=1', 'exit $failed']
        yield Command.script('\n'.join(lines), sudo=True, what=_what('take', interface, 'down'))

    def leave(self, interface: VpnInterface) -> Iterator[Command]:
        """Yield the script of ``down``, unless further peers stay."""
        for command in self.down(interface):
            yield dataclasses.replace(command, argv=(*command.argv[:-1], (
                f'[ ! -e {more(interface)} ] || ! {_more(interface, "stay")} '
                f'|| {{ echo {STAYS}; exit 0; }}\n'
                f'{command.argv[-1]}')))

    def _script(
        self, interface: VpnInterface, peers: Sequence[Peer], what: str, *, recall: bool = False,
    ) -> Command:
        steps = self._steps(interface, peers, recall=recall)
        return Command.script(
            '\n'.join([_PATH, *(step.do for step in steps)]), sudo=True, what=what)

    def _steps(
        self, interface: VpnInterface, peers: Sequence[Peer], *, recall: bool = False,
    ) -> list[_Step]:
        confined = [_confine(interface, self.ports, self.asked)] if interface.process else []
        return [
            _filter(interface, self.ports), *confined, _link(interface),
            _Step(_configure(interface, peers, recall=recall)), _address(interface, peers)]


def _what(verb: str, interface: VpnInterface, rest: str = '') -> str:
    return ' '.join(part for part in (verb, 'the VPN interface', interface.name, rest) if part)


def _name(interface: VpnInterface) -> str:
    name = interface.name
    if not name.isalnum() or not name.isascii() or len(name) > MAX_NAME or name[0].isdigit():
        raise ConfigurationError(
            f"'{name}' can't name a VPN interface", f'at most {MAX_NAME} letters and digits')
    return name


def _look(name: str) -> str:
    """Return the text that fails if an interface's filter does not exist."""
    return (f'nft list table inet {name} >/dev/null 2>&1 || '
            f'{{ echo "the packet filter of {name} is missing" >&2; exit 1; }}')


def _filter(interface: VpnInterface, ports: Sequence[tuple[int, int]]) -> _Step:
    """
    Return the step that creates the host's filter.

    No host accepts packets for its VPN address from another interface, as Linux does, nor for its
    group, as Linux does if any process has joined the group there. On the robot, the filter admits
    only DDS and ping from a machine, which may be hijacked. A machine of a launch accepts DDS from
    the VPN and from itself only.

    It uses one table, so that one delete is its undo. One transaction replaces all rules, so there
    is no moment without them; known addresses of the LAN stay. An accept in another table does not
    override a drop here, nor an accept here a drop there (the user's own firewall has to admit the
    VPN).
    """
    name = _name(interface)
    outside = _outside(interface)
    group = addresses.multicast_group(interface.address)
    destinations = f'{{ {interface.address}, {DISCOVERY_GROUP}, {group} }}'
    rules = [
        f'table inet {name}',
        f'flush table inet {name}',
        f'table inet {name} {{',
        f'  set lan {{ type ipv4_addr; size 4096; flags dynamic; timeout {LAN_TIMEOUT}; }}'
        if interface.firewall else '',
        '  chain input {',
        '    type filter hook input priority filter; policy accept;',
        f'    {outside} ip daddr {{ {interface.address}, {group} }} drop']
    if interface.firewall:
        rules += [
            f'    iifname != "{name}" accept',
            # a peer may send to any address of this computer, a LAN's included
            f'    ip daddr != {destinations} drop',
            '    ct state established,related accept',
            f'    {_to(ports)} accept' if ports else '',
            '    icmp type echo-request accept',
            '    drop',
            '  }',
            '  chain forward {',
            '    type filter hook forward priority filter; policy accept;',
            f'    iifname "{name}" drop',
            f'    oifname "{name}" drop',
            '  }',
            '  chain groups {',
            '    type filter hook output priority filter - 1; policy accept;',
            # nodes send multicast on all interfaces; Linux keeps what has no hop left
            f'    oifname "{name}" accept',
            f'    ip daddr {group} ip ttl set 0 accept',
            f'    ip daddr {addresses.multicast_group(interface.network)} drop']
    elif not interface.process:
        rules.append(f'    {outside} {RTPS} drop')
    rules += ['  }', '}']
    # the first line creates the table if missing, so that the second cannot fail
    undo = [rules[0], f'delete table inet {name}']
    return _Step(
        f'{_print(rules)} | nft -f - || '
        '{ echo "nft: the packet filter takes no rules" >&2; exit 1; }',
        f'! command -v nft >/dev/null || '
        f'{_print(undo)} | nft -f -')


def _confine(
    interface: VpnInterface, ports: Sequence[tuple[int, int]], addressees: Sequence[str],
) -> _Step:
    """
    Return the step that filters the DDS of one process and its children, in a control group.

    A hijacked machine may announce any address and port as its own. The robot's processes send
    only to the VPN, and to DDS's ports of this computer, of joined machines, and of the computers
    of the LAN that sent DDS themselves, or that the user configured. The loopback has other
    services by UDP, such as MAVLink's, so only the domain's ports pass there. The processes of a
    machine accept DDS from the VPN and from the machine only. Multicast is an exception there: one
    packet is for all processes of the host, the user's own included.

    The parent of an agent, which has the same command line, is in the group, too: it starts
    another agent when that one dies.

    The group is a child of the group of the process, so that limits and systemd's units stay; but
    not of another launch's group, whose filter knows one VPN only. The step prints a line and does
    not fail where control groups (version 2) cannot be used, or the kernel lacks these rules.

    Other users can make control groups, with any name, in a group that is theirs. So the undo
    removes only the group whose path the step wrote into a file of root's. A group with groups
    below it, such as a container engine's, stays.
    """
    name = _name(interface)
    record = f'/run/{name}.group'
    group = addresses.multicast_group(interface.address)
    match = f'{RTPS} socket cgroupv2 level %s "%s"'
    if interface.firewall:
        rules = [
            # kernels may lack fib, too; after the filter, so that dropped packets do not count
            *(['chain known {',
               'type filter hook input priority filter + 1; policy accept;',
               # an address of the LAN is known if it sends DDS from where an answer would go
               f'{_outside(interface)} {_to(ports)} {RTPS} fib saddr . iif oif exists'
               ' update @lan { ip saddr }',
               '}'] if ports else []),
            'chain confined {',
            *([f'{_to(ports, "!= ")} drop',
               'oifname "lo" accept',
               f'ip daddr {{ {", ".join([DISCOVERY_GROUP, group, *addressees])} }} accept',
               'ip daddr @lan accept'] if ports else []),
            'drop',
            '}',
            'chain output {',
            'type filter hook output priority filter; policy accept;',
            f'oifname "{name}" accept',
            f'{match} goto confined']
    else:
        rules = ['chain input {', f'{_outside(interface)} ip daddr != 224.0.0.0/4 {match} drop']
    text = shlex.quote('\n'.join([f'table inet {name} {{', *rules, '}', '}', '']))
    process = interface.process
    members = f'pid={process}\n  parent='
    if not process.isdigit():
        members = (f'pid=$(cat {shlex.quote(process)})\n'
                   "  parent=$(sed -n 's/^PPid:[[:space:]]*//p' \"/proc/$pid/status\")\n"
                   '  cmp -s "/proc/$pid/cmdline" "/proc/$parent/cmdline" || parent=')
    ends = f"""\
empty_group() {{
  n=0
  # a group in its place that is another user's stays
  until [ ! -O "$1" ] || rmdir "$1" 2>/dev/null; do
    [ $((n += 1)) -lt 10 ] || return
    for each in $(cat "$1/cgroup.procs"); do
      echo "$each" >"${{1%/*}}/cgroup.procs" || :
    done 2>/dev/null
  done
}}
end_group() {{
  read -r own 2>/dev/null <{record} || return 0
  [ ! -O "$own" ] || [ -z "$(find "$own" -mindepth 1 -type d)" ] || return 0
  empty_group "$own" && rm -f {record}
}}"""
    # the name of the group enters the rules
    do = f"""\
{ends}
confine() {{
  {members}
  {_GROUPS}
  group=$(sed -n 's/^0:://p' "/proc/$pid/cgroup") || return
  read -r kept 2>/dev/null <{record} || kept=none
  case $top$group/ in
    "$kept"/*) group=${{kept#"$top"}};;
    *) end_group; group=${{group%/{name}}}
       while grep -qsxF "$top$group" "/run/${{group##*/}}.group"; do group=${{group%/*}}; done
       group=${{group%/}}/{name};;
  esac
  case $group in *[!-A-Za-z0-9/_.@:\\\\]* | */..*) echo "odd name: $group"; return 1;; esac
  [ "$kept" = "$top$group" ] || {{
    printf "%s\\n" "$top$group" >{record}
    mkdir -p "$top$group" || return
    [ -z "$parent" ] || echo "$parent" >"$top$group/cgroup.procs" || return
    echo "$pid" >"$top$group/cgroup.procs" || return
  }}
  path=${{top#/sys/fs/cgroup}}$group
  printf {text} "$(($(printf %s "$group" | tr -cd / | wc -c)))" "${{path#/}}" | nft -f -
}}
said=$(confine 2>&1) || echo "no control group for process {process}: $said" """
    return _Step(do, f'{ends}\nend_group')


def _outside(interface: VpnInterface) -> str:
    """Return the match of packets that came neither through the VPN nor from the host itself."""
    return f'iifname != {{ "lo", "{_name(interface)}" }}'


def _to(ports: Sequence[tuple[int, int]], how: str = '') -> str:
    """Return what matches UDP packets to ports."""
    ranges = ', '.join(f'{first}-{last}' for first, last in ports)
    return f'udp dport {how}{{ {ranges} }}'


def _link(interface: VpnInterface) -> _Step:
    """
    Return the step that creates the interface.

    ``wireguard-go`` exits when its socket is deleted, and creates a missing TUN itself. A TUN of
    ``ip tuntap`` outlives that process, and so do the sockets of the nodes. The network namespace
    distinguishes the process from others of its name, such as those in containers.

    The step checks for a port in use first: ``wireguard-go`` may bind the port only after the
    configuration, and then reports no error.
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
for each in /proc/[0-9]*; do
  read -r program 2>/dev/null <$each/comm && [ "$program" = wireguard-go ] \\
    && [ $each/ns/net -ef /proc/self/ns/net ] && grep -qsxz {name} $each/cmdline || continue
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
    Return the text that configures ``wg``; only the shell's builtin printf handles the key.

    ``syncconf`` replaces the peers like ``setconf``, but keeps the sessions of remaining peers.

    :param recall: add the endpoints that the health check noted to peers without one.
    """
    key = shlex.quote(interface.key_file)
    lines = [f'read -r key <{key}']
    if recall:
        # in the first configuration: a handshake without endpoint would be retried after 5 s
        lines.append(
            f'seen() {{ while read -r peer at; do case "$peer $at" in "$1 ("*) ;; "$1 "*) '
            f'echo "Endpoint = $at";; esac; done 2>/dev/null <{_noted(interface)} || :; }}')
    lines += ['{', "printf '[Interface]\\nPrivateKey = %s\\n' \"$key\""]
    config = [f'ListenPort = {interface.port}']
    for number, peer in enumerate(peers):
        _check(peer)
        allowed = f'{peer.address}/32, {addresses.multicast_group(peer.address)}/32'
        if number == 0:
            # an address can belong to one peer only: the robot, or the first machine
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
    if not interface.firewall:
        lines.append(f'[ ! -e {more(interface)} ] || {_more(interface, "peers")} || :')
    lines.append(f'}} | wg syncconf {_name(interface)} /dev/stdin')
    if interface.firewall:
        # for the health check, which runs without root
        lines += [f'ask=$(wg show {_name(interface)} endpoints | {_ASK})',
                  f'(umask 022; {{ echo "#" $(echo "$ask" | {_FROM}); echo "$ask"; }} '
                  f'>{_noted(interface)})']
    return '\n'.join(lines)


def _check(peer: Peer) -> None:
    """Check data that another host sent about itself, before it enters a script."""
    try:
        ipaddress.IPv4Address(peer.address)
    except ValueError as error:
        raise VpnError(f'the VPN address of {peer.name} is invalid: {error}') from error
    if not _KEY.fullmatch(peer.public_key):
        raise VpnError(f'the WireGuard key of {peer.name} is invalid: {peer.public_key[:50]!r}')
    if peer.endpoint is not None and not _ENDPOINT.fullmatch(peer.endpoint):
        raise VpnError(f'the endpoint of {peer.name} is not host:port: {peer.endpoint[:50]!r}')


def _noted(interface: VpnInterface) -> str:
    # not beside the key, whose folder may belong to the login user: root must not write where
    # another user can place a symbolic link
    return f'/run/{_name(interface)}.noted'


def more(interface: VpnInterface) -> str:
    """Return the path of the program for further peers of a machine's interface."""
    return f'/run/{_name(interface)}.more'


def _more(interface: VpnInterface, verb: str) -> str:
    return f'python3 -IS {more(interface)} {_name(interface)} {verb}'


def _print(lines: Sequence[str]) -> str:
    return ' '.join(["printf '%s\\n'", *(shlex.quote(line) for line in lines)])


def _address(interface: VpnInterface, peers: Sequence[Peer]) -> _Step:
    name = _name(interface)
    prefix = interface.network.rpartition('/')[2]
    # without the subnet's route, the host's own overlapping network stays reachable
    alone = ' noprefixroute' if interface.host_routes else ''
    lines = [
        f'address replace {interface.address}/{prefix} dev {name}{alone}',
        f'link set dev {name} mtu {MTU} multicast on txqueuelen {QUEUE} up']
    do = f'{_print(lines)} | ip -batch -'
    own = [_free(interface, interface.address)] if interface.host_routes else []
    return _Step('\n'.join([*own, do, *_routes(interface, peers)]))


def _routes(interface: VpnInterface, peers: Sequence[Peer]) -> list[str]:
    """
    Return the commands that route each peer, if the subnet as a whole is not routed.

    These routes are the most specific ones, so they win over the host's own networks, and take
    only these addresses from them. :func:`_free` refuses an address that the host itself uses.
    """
    if not interface.host_routes:
        return []
    lines = [f'route replace {peer.address}/32 dev {_name(interface)}' for peer in peers]
    return [*(_free(interface, peer.address) for peer in peers),
            f'{_print(lines)} | ip -batch -']


def _free(interface: VpnInterface, address: str) -> str:
    """Return the text that fails if the host already uses or routes an address of the VPN."""
    # the robot's interface of the same launch is allowed: the machine may be the robot itself
    launch = re.sub('m[0-9]+$', '', _name(interface))
    exact = address.replace('.', '[.]')
    return (f"taken=$(ip -4 route show table all match {address} | grep -E '^(local )?{exact} ' "
            f"| grep -vE ' dev {launch}(m[0-9]+)?( |$)' || :)\n"
            f'[ -z "$taken" ] || {{ echo "in use already: $taken" >&2; exit 1; }}')

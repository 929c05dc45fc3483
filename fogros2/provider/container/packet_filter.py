# SPDX-License-Identifier: Apache-2.0
"""
Filter the packets of a container machine to this computer: the machine may be hijacked.

Root on the machine can change its addresses, so the filter recognises the machine by its ports of
the bridge. The kernel never uses the index of a port again: a filter that outlives its machine
matches no other container. A mark carries the result to the hook that knows addresses and
connections. This hook clears the mark, and precedes the redirection of published ports.

The machine may answer this computer, ping it, use its DNS server, and reach other computers. If
this computer is a virtual machine at AWS, Azure or Google, the cloud's services for it (metadata,
its account's tokens) are not for container machines; DNS is.
"""

from __future__ import annotations

#: Shell text that sets the filter with the name ``$1``. Its input is a container's state (OCI
#: runtime specification), with the id of a process of the machine.
SET = """\
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
pid=$(grep -o '"pid": *[0-9]*' | grep -om1 '[0-9]*$')
ports=$(nsenter -t "$pid" -n ip -o link | sed -n 's/^[0-9]*: [^ ]*@if\\([0-9]*\\): .*/\\1,/p')
if [ -z "$ports" ] || [ "/proc/$pid/ns/net" -ef /proc/self/ns/net ]; then
    echo 'the machine has no network of its own' >&2
    exit 1
fi
nft -f - <<END || { echo 'the packet filter takes no rules for bridges' >&2; exit 1; }
table bridge $1
delete table bridge $1
table bridge $1 {
    chain prerouting {
        type filter hook prerouting priority -300;
        iif { $ports } meta mark set 0x666f6732
    }
}
table inet $1
delete table inet $1
table inet $1 {
    chain prerouting {
        type filter hook prerouting priority mangle;
        meta mark != 0x666f6732 accept
        meta mark set 0
        ip daddr { 169.254.169.0/24, 169.254.170.0/24, 168.63.129.16 } \\
            meta l4proto { tcp, udp } th dport != 53 drop
        ip6 daddr { fd00:ec2::/32, fd20:ce::254 } meta l4proto { tcp, udp } th dport != 53 drop
        fib daddr type unicast accept
        ct state established,related accept
        icmp type echo-request accept
        icmpv6 type { echo-request, nd-neighbor-solicit, nd-neighbor-advert } accept
        fib daddr type local meta l4proto { tcp, udp } th dport 53 accept
        drop
    }
}
END
"""


def publish(name: str, port: int, address: str) -> str:
    """
    Return shell text that leads a UDP port of this computer to a machine; ``unset`` ends it.

    The machine sees this computer as the sender: its network may have no way to others.
    """
    return f"""\
PATH=$PATH:/usr/sbin:/sbin
nft -f - <<END
table inet {name}
table inet {name} {{
    chain published {{ type nat hook prerouting priority dstnat; }}
    chain answered {{ type nat hook postrouting priority srcnat; }}
}}
flush chain inet {name} published
flush chain inet {name} answered
add rule inet {name} published fib daddr type local udp dport {port} dnat ip to {address}
add rule inet {name} answered ip daddr {address} udp dport {port} ct status dnat masquerade
END"""


def unset(name: str) -> str:
    """Return shell text that deletes a filter, if there is one."""
    return (f"PATH=$PATH:/usr/sbin:/sbin; for family in bridge inet; do printf "
            f"'table %s {name}\\ndelete table %s {name}\\n' $family $family; done | nft -f -")

# SPDX-License-Identifier: Apache-2.0
"""
The first process of a pod.

It creates the login user, answers the robot's probes for UDP, and is the pod's watchdog: it ends
the pod if no agent starts in time, or if an agent dies. An agent that a launch stops (for a
machine that is kept) deletes its folder; then the Job's deadline ends the pod.
"""

from __future__ import annotations

#: File with the preemption notice: the cluster is about to end the pod.
NOTICE = '/run/fogros2-notice'
#: The agent's command that ends the machine at once. SIGTERM, which the cluster sends, leaves the
#: nodes some time.
END_COMMAND = ('sh', '-c', 'kill -s USR1 1')
#: Exits with 0 after the preemption notice.
NOTICE_COMMAND = ('cat', NOTICE)
#: Seconds that a pod has to move its nodes when the cluster ends it.
GRACE = 30
#: Uid of the login user if the image does not have it; unused in Debian and Ubuntu.
UID = 1729

#: Answers each datagram that begins with its word, until an agent starts, which needs the port for
#: the VPN.
ECHO = """\
import os, socket, sys
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(('', int(sys.argv[1])))
s.settimeout(0.1)
word = sys.argv[2].encode()
while not os.listdir('/run/fogros2'):
    try:
        data, who = s.recvfrom(512)
        if data.startswith(word):
            s.sendto(data, who)
    except OSError:
        pass
"""

#: TCP port for the liveness probe of a pod's second container.
ALIVE_PORT = 7398
ALIVE = f"""\
import socket
server = socket.create_server(('', {ALIVE_PORT}))
while True:
    server.accept()[0].close()
"""

SCRIPT = r"""
user=$1 timeout=$2 port=$3 word=$4 echo=$5 alive=$6
agents=/run/fogros2 notice=/run/fogros2-notice grace=@GRACE@ uid=@UID@
# without a new process, because each pod of a node calls this each second
clock() { read -r now _ </proc/uptime; now=${now%.*}; }
ended() { trap '' TERM USR1; echo "$1"; kill -s TERM -1 2>/dev/null; exit "$2"; }
find_agent() {
    state=none
    for folder in "$agents"/*/; do
        [ -d "$folder" ] || continue
        state=orphaned
        if read -r pid <"$folder/agent.pid" && [ -d "/proc/$pid" ]; then
            state=agent
            return
        fi
    done 2>/dev/null
}
taken() {
    find_agent
    [ "$state" = agent ] || ended 'ended by the cluster' 0
    [ "$last" = never ] || return
    clock
    last=$((now + grace))
    echo "the cluster takes the pod away in at most $grace s" >"$notice"
}
last=never
trap taken TERM
trap 'ended "ended as told" 0' USR1 INT
umask 022
mkdir -p "$agents"
rm -f "$notice"
if [ "$user" != root ] && ! grep -q "^$user:" /etc/passwd; then
    shell=/bin/sh
    [ ! -x /bin/bash ] || shell=/bin/bash
    echo "$user:x:$uid:$uid::/home/$user:$shell" >>/etc/passwd
    echo "$user:x:$uid:" >>/etc/group
    mkdir -p "/home/$user"
    cp /etc/skel/.bashrc /etc/skel/.profile "/home/$user/" 2>/dev/null
    chown -R "$uid:$uid" "/home/$user"
    chmod 750 "/home/$user"
fi
if [ "$user" != root ] && [ -d /etc/sudoers.d ]; then
    (umask 277; echo "$user ALL=(ALL:ALL) NOPASSWD: ALL" >/etc/sudoers.d/fogros2)
fi
[ "$port" = 0 ] || python3 -ISc "$echo" "$port" "$word" &
[ -z "$alive" ] || python3 -ISc "$alive" &
clock
since=$now before=none
while :; do
    find_agent
    clock
    case $state in
    agent)
        since=$now before=agent ;;
    orphaned)
        [ "$since" != never ] || since=$now
        before=orphaned ;;
    none)
        # the launch has stopped the agent
        [ "$before" = none ] || since=never ;;
    esac
    if [ "$since" != never ] && [ $((now - since)) -ge "$timeout" ]; then
        ended "no agent runs in this pod for $timeout s" 3
    fi
    if [ "$last" != never ] && { [ "$now" -ge "$last" ] || [ "$state" != agent ]; }; then
        ended 'ended by the cluster' 0
    fi
    sleep 1 & wait $!
done
""".replace('@UID@', str(UID)).replace('@GRACE@', str(GRACE - 5)).lstrip()


def arguments(
    user: str, timeout: float, port: int, word: str, *, alive: bool = False,
) -> list[str]:
    """
    Return the pod's command.

    :param timeout: seconds for which the pod waits for an agent.
    :param port: UDP port for the robot's probes, 0 for none.
    :param word: first word of the probes; others are not answered.
    :param alive: whether another container of the pod probes this one.
    """
    return ['/bin/sh', '-c', SCRIPT, 'fogros2', user, str(max(1, round(timeout))), str(port),
            word, ECHO, ALIVE if alive else '']

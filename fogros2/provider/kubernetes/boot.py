# SPDX-License-Identifier: Apache-2.0
"""
What a pod runs as its first process.

It makes the login user, answers the robot's question whether UDP gets through, and ends the pod
when nobody guards it: when no agent has come in time, or one has died without leaving. An agent
that leaves as it was told (a machine that is kept) takes its folder with it; the Job's deadline
ends such a pod.
"""

from __future__ import annotations

#: Written when the cluster is about to take the pod away.
NOTICE = '/run/fogros2-notice'
#: The agent's command that ends the machine. SIGTERM is the cluster's word for it, and leaves the
#: nodes some time; this one doesn't.
END_COMMAND = ('sh', '-c', 'kill -s USR1 1')
#: Exits with 0 once the cluster has said that it takes the pod away.
NOTICE_COMMAND = ('cat', NOTICE)
#: Seconds that a pod is given to move its nodes when the cluster takes it away.
GRACE = 30
#: Uid of the login user where the image has none of its name; free in Debian's and Ubuntu's.
UID = 1729

#: Answers each datagram that begins with the word it was given, until an agent comes, which will
#: need the port for the VPN.
ECHO = """\
import os, socket, sys, time
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(('', int(sys.argv[1])))
s.settimeout(0.1)
word, last = sys.argv[2].encode(), time.monotonic() + float(sys.argv[3])
while time.monotonic() < last and not os.listdir('/run/fogros2'):
    try:
        data, who = s.recvfrom(512)
        if data.startswith(word):
            s.sendto(data, who)
    except OSError:
        pass
"""

#: TCP port at which a pod with a second container shows that its first one lives.
ALIVE_PORT = 7398
ALIVE = f"""\
import socket
door = socket.create_server(('', {ALIVE_PORT}))
while True:
    door.accept()[0].close()
"""

SCRIPT = r"""
user=$1 patience=$2 port=$3 word=$4 listen=$5 echo=$6 alive=$7
agents=/run/fogros2 notice=/run/fogros2-notice grace=@GRACE@ uid=@UID@
# without a process of its own: this is asked each second, in each pod of a node
clock() { read -r now _ </proc/uptime; now=${now%.*}; }
ended() { trap '' TERM USR1; echo "$1"; kill -s TERM -1 2>/dev/null; exit "$2"; }
guarded() {
    state=none
    for folder in "$agents"/*/; do
        [ -d "$folder" ] || continue
        state=orphaned
        if read -r pid <"$folder/agent.pid" && [ -d "/proc/$pid" ]; then
            state=guarded
            return
        fi
    done 2>/dev/null
}
taken() {
    guarded
    [ "$state" = guarded ] || ended 'ended by the cluster' 0
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
[ "$port" = 0 ] || python3 -ISc "$echo" "$port" "$word" "$listen" &
[ -z "$alive" ] || python3 -ISc "$alive" &
clock
since=$now before=none
while :; do
    guarded
    clock
    case $state in
    guarded)
        since=$now before=guarded ;;
    orphaned)
        [ "$since" != never ] || since=$now
        before=orphaned ;;
    none)
        # one that was here has left as it was told
        [ "$before" = none ] || since=never ;;
    esac
    if [ "$since" != never ] && [ $((now - since)) -ge "$patience" ]; then
        ended "no agent guards this pod for $patience s" 3
    fi
    if [ "$last" != never ] && { [ "$now" -ge "$last" ] || [ "$state" != guarded ]; }; then
        ended 'ended by the cluster' 0
    fi
    sleep 1 & wait $!
done
""".replace('@UID@', str(UID)).replace('@GRACE@', str(GRACE - 5)).lstrip()


def arguments(
    user: str, patience: float, port: int, word: str, listen: float, *, alive: bool = False,
) -> list[str]:
    """
    Return the pod's command.

    :param patience: seconds for which nobody need guard the pod.
    :param port: UDP port on which the robot's question is answered, 0 for none.
    :param word: what a question begins with; others get no answer.
    :param listen: seconds for which questions are answered at the most.
    :param alive: whether another container of the pod probes this one.
    """
    return ['/bin/sh', '-c', SCRIPT, 'fogros2', user, str(max(1, round(patience))), str(port),
            word, f'{listen:g}', ECHO, ALIVE if alive else '']

# SPDX-License-Identifier: Apache-2.0
"""Scripts for ``sh`` on a machine that run containers, see ``commands``."""

# Finds the engine, and calls it as root, because the login user may not be in docker's group.
ENGINE = """\
engine=; for each in podman docker; do
    ! command -v $each >/dev/null || { engine=$each; break; }
done
as_root=; [ "$(id -u)" = 0 ] || as_root='sudo -n'
"""
# Podman does not work without the runtime in its configuration.
FIND = ENGINE + """\
[ "$engine" != podman ] || $as_root podman ps -q >/dev/null 2>&1 || engine=
echo $engine
"""
# Prints the engine's name of the image. An image of ROS without the launch's middleware (published
# ones have only Fast DDS) gets a layer with it, once; not by 'build', which needs control groups.
# The layer keeps the image's command and user; by default, a commit uses those of its container.
IMAGE = ENGINE + """\
image=$1 rmw=$3 install=$4
there() { $as_root $engine image inspect "$1" >/dev/null 2>&1; }
if ! there "$image"; then
    image=$2
    if ! there "$image"; then
        pulled=$($as_root $engine pull -q "$image")
        image=$(echo "$pulled" | tail -n 1)
    fi
fi
case $($as_root $engine image inspect -f '{{.Architecture}}' "$image") in
    amd64) built=x86_64 ;; arm64) built=aarch64 ;; *) built= ;;
esac
# an emulator may run it, which is invisible inside a container
emulators=/proc/sys/fs/binfmt_misc
if [ -n "$built" ] && [ -e $emulators/status ] && [ "$built" != "$(uname -m)" ] \\
        && ! grep -qsx enabled $emulators/*"$built"*; then
    echo "Error: it is for $built processors, and the machine has $(uname -m)" >&2
    exit 1
fi
if [ -n "$rmw" ]; then
    id=$($as_root $engine image inspect -f '{{.Id}}' "$image")
    id=${id#sha256:}
    with=localhost/fogros2-$rmw:${id%"${id#????????????}"}
    distro=$($as_root $engine image inspect \\
        -f '{{range .Config.Env}}{{println .}}{{end}}' "$image")
    distro=$(echo "$distro" | sed -n 's/^ROS_DISTRO=//p')
    ros=/opt/ros/${distro:=jazzy}
    if there "$with"; then
        image=$with
    else
        looking=$($as_root $engine create --network none "$image" true)
        has() { $as_root $engine cp "$looking:$1" - >/dev/null 2>&1; }
        if has "$ros/setup.sh" && ! has "$ros/lib/lib$rmw.so"; then
            lacks=1
        else
            lacks=
        fi
        $as_root $engine rm -f -v "$looking" >/dev/null
        if [ -n "$lacks" ]; then
            adding=fogros2-adding-$$
            trap '$as_root $engine rm -f -v $adding >/dev/null 2>&1' EXIT
            # dash runs no EXIT trap for a signal, and a signal interrupts 'wait' alone
            trap 'exit 143' HUP INT TERM
            $as_root $engine run --name $adding --user 0:0 --network host --log-driver none \\
                "$image" sh -ec "$install" "ros-$distro-$(echo "$rmw" | tr _ -)" >&2 &
            wait $!
            command=$($as_root $engine image inspect -f '{{json .Config.Cmd}}' "$image")
            user=$($as_root $engine image inspect -f '{{.Config.User}}' "$image")
            [ "$command" != null ] || command='[]'
            $as_root $engine commit --change "CMD $command" --change "USER ${user:-0}" \\
                $adding "$with" >/dev/null
            image=$with
        fi
    fi
fi
echo "$image"
"""
# Docker takes a number of GPUs, podman the name of each by the vendor's description (CDI). Of
# docker, an image that names no capabilities gets neither video encoders nor graphics.
GPUS = """\
if [ -n "$gpus" ]; then
    if [ $engine = docker ]; then
        set -- --gpus "$gpus" -e NVIDIA_DRIVER_CAPABILITIES=all "$@"
    else
        case $gpus in
            *[!0-9]*) set -- --device "nvidia.com/gpu=$gpus" "$@" ;;
            *) while [ "$gpus" -gt 0 ]; do
                   gpus=$((gpus - 1)); set -- --device "nvidia.com/gpu=$gpus" "$@"
               done ;;
        esac
    fi
fi
"""
RUN = ENGINE + """\
name=$1 gpus=$2; shift 2
$as_root $engine rm -f -v "$name" >/dev/null 2>&1 || :
""" + GPUS + """\
$as_root $engine run -d --name "$name" "$@" >/dev/null
"""
# Stops the container on a signal, and exits with its exit status. This script restarts the
# container, not the engine, so that a stopped container stays stopped.
FOLLOW = ENGINE + """\
name=fogros2-@LAUNCH@-$1 restart=$2 since=; tries=0 asked=
trap 'asked=1; $as_root $engine stop -t 5 "$name" >/dev/null 2>&1' INT TERM
while :; do
    $as_root $engine logs -f $since "$name" & logs=$!
    $as_root $engine wait "$name" >/dev/null & waiting=$!
    wait $waiting || wait $waiting
    wait $logs
    # another process may have removed it
    status=$($as_root $engine inspect -f '{{.State.ExitCode}}' "$name") || status=137 restart=
    [ -z "$asked" ] || break
    case $restart in
        always|unless-stopped) ;;
        on-failure) [ "$status" != 0 ] || break ;;
        on-failure:*) [ "$status" != 0 ] && [ $tries -lt "${restart#*:}" ] || break ;;
        *) break ;;
    esac
    tries=$((tries + 1))
    echo "it ended with exit status $status and is started again" >&2
    sleep 1 & wait $!
    [ -z "$asked" ] || break
    since="--since $(date -u +%Y-%m-%dT%H:%M:%S.%NZ)"
    $as_root $engine start "$name" >/dev/null || break
done
$as_root $engine rm -f -v "$name" >/dev/null 2>&1
# stopped on request, by any signal
[ -z "$asked" ] || case $status in 130|137|143) status=0 ;; esac
exit "$status"
"""
# Represents a node in a container. Signals go to the node itself, which is not the container's
# first process (which ignores unhandled signals). Output passes unchanged, and the node's end ends
# this script. Values of variables are passed in a file, because all users can read command lines.
NODE = ENGINE + """\
name=$1 gpus=$2 workspace=$3 grace=$4 inside=$5; shift 5
asked= late=
passed_on() {
    asked=1
    state=$($as_root $engine inspect -f '{{.State.Pid}} {{.State.Status}}' "$name" 2>/dev/null)
    first=${state%% *}
    # its parent, in-container, is the first process or below an init or an entry point
    parent=$first
    while :; do
        node=$(cat "/proc/$parent/task/$parent/children" 2>/dev/null)
        for child in $node; do
            ! grep -qsF -e "$inside" "/proc/$child/cmdline" || { parent=$child; continue 2; }
        done
        break
    done
    if [ -n "$node" ]; then $as_root kill -s "$1" $node
    elif [ "$state" = '0 created' ] || [ "$state" = '0 configured' ] \\
            || grep -qs . "/proc/$first/cmdline"; then
        # it is starting: its first process reacts only to SIGKILL
        $as_root $engine kill "$name" >/dev/null 2>&1
        $as_root $engine rm -f -v "$name" >/dev/null 2>&1
    fi
    [ "$1" != TERM ] || [ -n "$late" ] || {
        (sleep "$grace"; $as_root $engine kill "$name") >/dev/null 2>&1 & late=$!; }
}
for each in HUP INT QUIT TERM USR1 USR2; do trap "passed_on $each" $each; done
umask 077
list=$(mktemp "${FOGROS2_AGENT_DIRECTORY:-/tmp}/variables-XXXXXX") || exit 125
newline='
'
# else the image's own would remain
: "${ROS_DOMAIN_ID:=0}"
for each in @DDS@; do eval ": \\"\\${$each=}\\""; done
for each in @VARIABLES@; do
    eval "value=\\${$each-} given=\\${$each+yes}"
    case $value in *"$newline"*)
        echo "$each has more than one line, and isn't there in the container" >&2
        given= ;;
    esac
    [ -z "$given" ] || printf '%s=%s\\n' "$each" "$value"
done >"$list"
[ ! -d "$workspace" ] || set -- -v "$workspace:$workspace:ro" "$@"
set -- -v "$inside:$inside:ro" "$@"
""" + GPUS + """\
$as_root $engine rm -f -v "$name" >/dev/null 2>&1
$as_root $engine create --pull never --name "$name" --log-driver none \\
    --user "$(id -u):$(id -g)" --env-file "$list" -e HOME=/tmp "$@" >/dev/null
status=$?
rm -f "$list"
[ $status -eq 0 ] || exit 125
status=130
if [ -z "$asked" ]; then
    $as_root $engine start -a "$name" & client=$!
    while wait $client; [ -d /proc/$client ]; do :; done
    status=$($as_root $engine inspect -f '{{.State.ExitCode}}' "$name" 2>/dev/null) || status=130
fi
$as_root $engine rm -f -v "$name" >/dev/null 2>&1
[ -z "$late" ] || kill $late 2>/dev/null
if [ "$status" -gt 128 ] && [ "$status" -lt 160 ]; then
    # exit like a node that a signal ended
    trap - $((status - 128))
    kill -s $((status - 128)) $$
fi
exit "$status"
"""
# Runs in the container; an entry point may have sourced ROS already.
INSIDE = """\
workspace=$1 package=$2 executable=$3 prefix=$4; shift 4
if [ -z "$AMENT_PREFIX_PATH" ]; then
    for each in /opt/ros/*/setup.sh; do [ ! -e "$each" ] || . "$each"; done
fi
[ ! -e "$workspace/install/local_setup.sh" ] || . "$workspace/install/local_setup.sh"
if [ -n "$package" ]; then
    program=; IFS=:
    for each in $AMENT_PREFIX_PATH; do
        each=$each/lib/$package/$executable
        [ -n "$program" ] || [ ! -x "$each" ] || program=$each
    done
    unset IFS
    [ -n "$program" ] || {
        echo "executable '$executable' of package '$package' not found in the image" >&2
        exit 127
    }
    set -- "$program" "$@"
fi
eval "set -- $prefix \\"\\$@\\""
"$@"
exit $?
"""
REMOVE = ENGINE + """\
[ -n "$engine" ] || exit 0
ids=$($as_root $engine ps -aq --filter "label=$1=$2")
[ -n "$ids" ] || exit 0
# running containers had their time to end
$as_root $engine kill $ids >/dev/null 2>&1 || :
$as_root $engine rm -f -v $ids >/dev/null
"""

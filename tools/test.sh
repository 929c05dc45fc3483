#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Runs the tests on the wheels of ROS 2, then on ROS 2 Jazzy where it is installed, and closes
# with one line of counts over both.
#
#   tools/test.sh [WORDS]             all tests without a cluster; words are passed on to pytest
#   tools/test.sh kubernetes [WORDS]  the tests with one
set -u
cd "$(dirname "$0")/.."
. tools/common.sh
mkdir -p .cache
# What programs leave that a test kills, and ROS 2's launch at each start, goes with this folder.
# pytest keeps its own where it always does.
export PYTEST_DEBUG_TEMPROOT="${TMPDIR:-/tmp}"
TMPDIR=$(mktemp -d -t fogt-XXXXXX) || fail 'No folder for temporary files: is there room in /tmp?'
# as open as /tmp: some tests act as another account
chmod 1777 "$TMPDIR"
export TMPDIR
trap 'rm -rf "$TMPDIR"' EXIT
trap 'exit 130' INT
trap 'exit 143' TERM
keep_ticket
part=test again= paths=
if [ "${1:-}" = kubernetes ]; then
    part=$1; shift
    [ $# != 0 ] || again=yes
    paths=test/integration/kubernetes
elif [ $# = 0 ]; then
    # Four at a time: much of what tests with machines take is waiting. Tests named by hand run in
    # turn, so that their output is seen as it comes.
    again=yes
    set -- --ignore=test/integration/kubernetes -n 4 --dist loadgroup --no-loadscope-reorder
else
    # pytest collects it nevertheless if it is named
    set -- --ignore=test/integration/kubernetes "$@"
fi
rm -f .cache/"$part"-*.xml .cache/again-"$part"-*.xml
status=0
# what the user has set for nodes of their own must not decide what a test sees
unset RMW_IMPLEMENTATION CYCLONEDDS_URI ROS_DOMAIN_ID ROS_AUTOMATIC_DISCOVERY_RANGE \
    ROS_STATIC_PEERS ROS_LOCALHOST_ONLY FOGROS2_STATE_HOME

ros=$(ros_setup)

# Of a whole run, what failed runs once more, alone, until a third test fails again. The closing
# lines name it.
suite() {
    name=$1 report=$2; shift 2
    say "Tests on $name"
    # shellcheck disable=SC2086  # none, or one path
    tools/run.sh "$@" $paths --junit-xml=.cache/"$report" && return
    if [ $? = 1 ] && [ -n "$again" ]; then
        say 'What failed, once more and alone'
        tools/run.sh "$@" -n 0 --maxfail=3 --junit-xml=.cache/again-"$report" \
            @.cache/failed-tests.txt && return
    fi
    status=1
}
suite "ROS 2's wheels" "$part-embedded.xml" embedded -- pytest "$@"
if [ -n "$ros" ]; then
    # Jazzy's own plugins are written for an older pytest, and nothing here uses them
    suite 'ROS 2 Jazzy' "$part-ros.xml" ros -- pytest \
        -p no:launch_testing -p no:launch_ros -p no:launch_pytest "$@"
else
    say "ROS 2 Jazzy isn't installed here: tested on its wheels alone"
fi
tools/run.sh embedded -- python tools/closing_line.py .cache/"$part"-*.xml || status=1
exit $status

#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Runs a command in one of the project's environments.
#
#   tools/run.sh embedded|ros|best -- COMMAND...
#
# 'best' is ROS 2 Jazzy where it is installed, else 'embedded': its wheels. As a user, the sudo
# ticket that setup.sh got is kept fresh until the command ends.
set -eu
folder=$(cd "$(dirname "$0")/.." && pwd)
back=$PWD
cd "$folder"
. tools/common.sh
which=$1
[ "$2" = -- ]
shift 2
ros=$(ros_setup)
if [ "$which" = best ]; then
    if [ -n "$ros" ]; then which=ros; else which=embedded; fi
fi
case $which in
    ros)
        [ -n "$ros" ] || fail "ROS 2 Jazzy isn't installed here."
        set +eu; . "$ros"; set -eu
        export VIRTUAL_ENV="$VENV_ROS"
        . tools/ros_environment.sh
        ;;
    embedded)
        unset PYTHONPATH AMENT_PREFIX_PATH ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION \
            COLCON_PREFIX_PATH CMAKE_PREFIX_PATH PYTHONHOME
        export VIRTUAL_ENV="$VENV"
        ;;
    *) fail "Unknown environment '$which'." ;;
esac
export PATH="$VIRTUAL_ENV/bin:$PATH"
# the bytecode of tests saves half of the time that their import takes
unset PYTHONDONTWRITEBYTECODE
cd "$back"
keep_ticket
exec "$@"

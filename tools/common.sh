# SPDX-License-Identifier: Apache-2.0
# What setup.sh, run.sh and test.sh share. POSIX sh, sourced with the project as the folder.

say() { printf '%s\n' "-- $*"; }
fail() { printf '%s\n' "** $1" >&2; shift; for line in "$@"; do printf '   %s\n' "$line" >&2; done; exit 1; }

VENV=${FOGROS2_VENV:-$PWD/.venv}
VENV_ROS=${FOGROS2_VENV_ROS:-$PWD/.venv-ros}

# Prints the set-up script of ROS 2 Jazzy, or nothing where it isn't installed.
ros_setup() {
    if [ "${ROS_DISTRO:-}" = jazzy ] && [ -n "${AMENT_PREFIX_PATH:-}" ]; then
        # sourced already: the prefix that has rclpy is the one to source, or the folder around it
        # where colcon gave each package a prefix
        old_ifs=$IFS; IFS=:
        for prefix in $AMENT_PREFIX_PATH; do
            [ -d "$prefix/share/rclpy" ] || continue
            for setup in "$prefix/setup.sh" "${prefix%/*}/setup.sh"; do
                [ -f "$setup" ] || continue
                IFS=$old_ifs; printf '%s\n' "$setup"; return
            done
        done
        IFS=$old_ifs
    fi
    if [ -f /opt/ros/jazzy/setup.sh ] && [ -d /opt/ros/jazzy/share/rclpy ]; then
        printf '%s\n' /opt/ros/jazzy/setup.sh
    fi
}

# Prints a word in quotes, as a shell reads it.
quoted() { printf "'%s'" "$(printf '%s' "$1" | sed "s/'/'\\\\''/g")"; }

# teach_activate VENV SETUP: makes `. VENV/bin/activate` set what `run.sh ros` sets, and deactivate
# undo it. SETUP is the set-up script of ROS 2, which is sourced where the terminal has not.
teach_activate() {
    script=$1/bin/activate
    ! grep -q ros_environment.sh "$script" || return 0
    cat >"$script.new" <<END
_fogros2_deactivate() {
    if [ -n "\${_OLD_FOGROS2_AMENT_PREFIX_PATH+set}" ]; then
        AMENT_PREFIX_PATH=\$_OLD_FOGROS2_AMENT_PREFIX_PATH PYTHONPATH=\$_OLD_FOGROS2_PYTHONPATH
        unset _OLD_FOGROS2_AMENT_PREFIX_PATH _OLD_FOGROS2_PYTHONPATH
    fi
}
$(sed 's/^deactivate () {$/&\n    _fogros2_deactivate/' "$script")
_OLD_FOGROS2_AMENT_PREFIX_PATH=\${AMENT_PREFIX_PATH:-} _OLD_FOGROS2_PYTHONPATH=\${PYTHONPATH:-}
if [ -z "\${AMENT_PREFIX_PATH:-}" ]; then
    . $(quoted "${2%sh}")"\${BASH_VERSION:+ba}\${ZSH_VERSION:+z}sh"
fi
. $(quoted "$PWD/tools/ros_environment.sh")
END
    mv "$script.new" "$script"
}

# make_ros2 VENV: writes the program ros2 of the environment. ROS's own has /usr/bin/python3 in its
# first line, which wouldn't see ours. The lines before Python's are a text for Python, and a
# command for sh: a first line can't name an interpreter whose path has a space.
make_ros2() {
    { cat - tools/ros2.py <<'END'
#!/bin/sh
'''exec' "$(dirname "$(readlink -f "$0")")/python" "$0" "$@"
' '''
END
    } >"$1/bin/ros2"
    chmod 755 "$1/bin/ros2"
}

# Runs a command as root: as it is, or through sudo, whose password was asked before.
as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n -- "$@"; fi; }

# Whether as_root would work without a question.
root_ready() { [ "$(id -u)" = 0 ] || { command -v sudo && sudo -n true; } >/dev/null 2>&1; }

# Looks into the sbin folders too, which are not on a user's path in Debian.
have() { PATH="$PATH:/usr/local/sbin:/usr/sbin:/sbin" command -v "$1" >/dev/null 2>&1; }

# Whether a program is there and needs no shared library, as an image that holds it alone requires.
have_static() { have "$1" && ! ldd "$(command -v "$1")" 2>/dev/null | grep -q '=>'; }

# Keeps the ticket that sudo gave alive until this process ends, whatever program it is by then.
keep_ticket() {
    if [ "$(id -u)" = 0 ] || ! root_ready; then return 0; fi
    # at most three hours, and a fraction of a second longer than the process; nobody's child, as
    # a program would not wait for one that it doesn't know
    ( ( end=180; me=$$
        while [ $end -gt 0 ] && sudo -n -v; do
            timeout 60 tail -s 0.2 --pid="$me" -f /dev/null && exit 0
            end=$((end - 1))
        done ) </dev/null >/dev/null 2>&1 & )
}

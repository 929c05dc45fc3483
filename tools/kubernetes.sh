#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Builds the Kubernetes that the tests run, and prints the folder where its programs are.
#
#   tools/kubernetes.sh            build if it isn't there; the last line is the folder
#   tools/kubernetes.sh --find     print the folder if all is there, else nothing
#   tools/kubernetes.sh --why-not  print why this computer can't build it, nothing if it can
#
# The source is Debian's own package (1.20.2, with everything it needs), the compiler Debian's.
# That takes six minutes on two idle cores and 8 GB of free disk for that time, once; later runs find
# the programs in the user's cache folder, under a checksum of how they were built. What the cluster runs beside them
# (etcd, containerd, runc, CNI plugins) comes as packages, installed here if they are missing.
set -eu
cd "$(dirname "$0")/.."
. tools/common.sh

programs='kube-apiserver kube-controller-manager kube-scheduler kubelet kube-proxy'
# what the programs depend on: change it here, and they are built again
recipe() {
    . /etc/os-release
    echo "kubernetes of $ID ${VERSION_ID:-} for $(dpkg --print-architecture), stripped: $programs"
}
cache=${XDG_CACHE_HOME:-$HOME/.cache}/fogros2/kubernetes
folder() { echo "$cache/$(recipe | sha256sum | cut -c 1-16)"; }

missing_packages() {
    while read -r program package; do
        have "$program" || [ -x "$program" ] || echo "$package"
    done <<LIST
etcd etcd-server
containerd containerd
runc runc
/usr/lib/cni/bridge containernetworking-plugins
debootstrap debootstrap
iptables iptables
conntrack conntrack
ip iproute2
unshare util-linux
LIST
    [ -d "$(folder)" ] || while read -r program package; do
        have "$program" || echo "$package"
    done <<LIST
go golang-go
dpkg-source dpkg-dev
make make
jq jq
rsync rsync
LIST
}

# --- whether it can be done at all --------------------------------------------------------------
why_not() {
    if ! root_ready; then
        echo "a cluster takes root, or sudo without a question"
    elif ! have apt-get || ! have dpkg; then
        echo "this computer has no apt, and Kubernetes is built from Debian's source package"
    elif [ -z "${XDG_CACHE_HOME:-}${HOME:-}" ]; then
        echo "there is no cache folder: neither HOME nor XDG_CACHE_HOME is set"
    elif ! as_root unshare --fork --pid --mount --net --ipc --uts true 2>/dev/null; then
        echo "root may make no namespaces here, as in a container without privileges"
    elif ! as_root sh -c 'for tree in /sys/fs/cgroup /sys/fs/cgroup/memory; do
            mkdir "$tree/fogros2-probe" 2>/dev/null && rmdir "$tree/fogros2-probe" && exit 0
            done; exit 1'; then
        echo "root may make no control groups here, as in a container without privileges"
    elif ! [ -c /dev/kmsg ]; then
        echo "there is no /dev/kmsg, which the kubelet reads, as in a container without privileges"
    elif [ -d "$(folder)" ]; then
        :
    elif [ "$(free_gb)" -lt 8 ]; then
        echo "building it takes 8 GB of disk, and $(free_gb) are free in $cache" \
             "(XDG_CACHE_HOME names another place)"
    elif ! known_source; then
        echo "$(. /etc/os-release; echo "${PRETTY_NAME:-this system}") has no source package" \
             "'kubernetes', or can't be asked for it (Debian 12 has one)"
    fi
}
free_gb() {
    mkdir -p "$cache"
    df -P -k "$cache" | awk 'NR == 2 { print int($4 / 1048576) }'
}

# --- apt, with source packages, in a configuration of our own -----------------------------------
# The system's own list stays as it is: its lines are taken over as deb-src.
apt_sources() {
    mkdir -p "$1/list.d" "$1/lists/partial" "$1/cache/archives/partial"
    for list in /etc/apt/sources.list /etc/apt/sources.list.d/*.list; do
        [ ! -f "$list" ] || sed -n 's/^deb[[:space:]]/deb-src /p' "$list" \
            >"$1/list.d/$(basename "$list" .list).list"
    done
    for list in /etc/apt/sources.list.d/*.sources; do
        [ ! -f "$list" ] || sed 's/^Types:.*/Types: deb-src/' "$list" \
            >"$1/list.d/$(basename "$list")"
    done
}
apt_with_sources() {
    where=$1; shift
    # as nobody but the caller: apt's own user may not reach a folder below a home
    apt-get -q -o Dir::Etc::sourcelist=/dev/null -o Dir::Etc::sourceparts="$where/list.d" \
        -o Dir::State::lists="$where/lists" -o Dir::Cache="$where/cache" \
        -o APT::Sandbox::User="$(id -un)" -o Debug::NoLocking=1 "$@"
}
known_source() {
    aside=$(mktemp -d)
    apt_sources "$aside"
    found=1
    if apt_with_sources "$aside" update >"$aside/log" 2>&1 </dev/null \
            && apt_with_sources "$aside" source --print-uris kubernetes >"$aside/uris" \
                2>>"$aside/log" </dev/null && grep -q 'kubernetes_1\.' "$aside/uris"; then
        found=0
    fi
    rm -rf "$aside"
    return $found
}

case ${1:-} in
    --why-not) why_not; exit 0 ;;
    --find) if [ -d "$(folder)" ] && [ -z "$(missing_packages)" ]; then folder; fi; exit 0 ;;
esac

# --- the build ----------------------------------------------------------------------------------
started=$(date +%s)
progress() { say "Kubernetes: $* ($(($(date +%s) - started)) s)" >&2; }
# quiet WHAT COMMAND...: its output goes to the log, the end of which is shown when it fails
quiet() {
    what=$1; shift
    progress "$what"
    "$@" >>"$log" 2>&1 </dev/null && return
    tail -n 20 "$log" >&2
    fail "Kubernetes: could not $what" "Its whole output: $log"
}

mkdir -p "$cache" .cache
keep_ticket
log=$PWD/.cache/kubernetes.log
target=$(folder)
if have flock; then
    exec 8>"$cache/build.lock"
    flock -n 8 || { progress 'wait for another build'; flock 8; }
fi
packages=$(missing_packages | tr '\n' ' ')
packages=${packages% }
if [ -d "$target" ] && [ -z "$packages" ]; then
    echo "$target"
    exit 0
fi
reason=$(why_not)
[ -z "$reason" ] || fail "Kubernetes can't be built here: $reason"
: >"$log"

install_packages() {
    # they are wanted as programs alone: no service of theirs may start
    services=
    if [ -d /run/systemd/system ]; then
        for service in etcd containerd; do
            case " $packages " in *" $service"*) services="$services $service.service" ;; esac
        done
        [ -z "$services" ] || as_root systemctl mask --runtime --quiet $services
    fi
    status=0
    { as_root apt-get update -q && as_root env DEBIAN_FRONTEND=noninteractive RUNLEVEL=1 \
        apt-get install -q -y -o DPkg::Lock::Timeout=600 \
        --no-install-recommends $packages; } || status=$?
    if [ -n "$services" ]; then
        as_root systemctl unmask --runtime --quiet $services || status=$?
        as_root systemctl disable --quiet $services || status=$?
    fi
    return $status
}
if [ -n "$packages" ]; then
    quiet "install $packages" install_packages
fi

if ! [ -d "$target" ]; then
    # what an earlier build left that was killed
    rm -rf "$cache"/build-*
    work=$(mktemp -d "$cache/build-XXXXXX")
    # Go makes the folders of its module cache read-only
    trap 'chmod -R u+w "$work" 2>/dev/null; rm -rf "$work"' EXIT
    trap 'exit 130' INT
    trap 'exit 143' TERM HUP
    apt_sources "$work/apt"
    quiet 'read the list of source packages' apt_with_sources "$work/apt" update
    mkdir "$work/source"
    (cd "$work/source" && quiet 'fetch its source' \
        apt_with_sources "$work/apt" source --download-only kubernetes)
    quiet 'unpack it' dpkg-source --no-check -x "$work"/source/*.dsc "$work/tree"
    # Go of that time wants its packages in one tree, found by a link within the tree itself
    mkdir -p "$work/tree/_go/src/k8s.io"
    ln -s "$work/tree" "$work/tree/_go/src/k8s.io/kubernetes"
    build() {
        # two jobs at most: the tests' computer is somebody's, who may be working on it
        cd "$work/tree/_go/src/k8s.io/kubernetes" && env -u GOFLAGS -u GOROOT \
            GOPATH="$work/tree/_go" GOCACHE="$work/go-cache" TMPDIR="$work" HOME="$work" \
            GOMAXPROCS=2 CGO_ENABLED=0 nice -n 10 make WHAT="cmd/$1"
    }
    for program in $programs; do
        quiet "build $program" build "$program"
    done
    mkdir -p "$work/result/bin"
    for program in $programs; do
        cp "$work/tree/_output/bin/$program" "$work/result/bin/"
    done
    { recipe; basename "$work"/source/*.dsc; sha256sum "$work"/source/*.dsc | cut -c 1-64
      go version; } >"$work/result/built"
    "$work/result/bin/kubelet" --version >>"$work/result/built"
    mv "$work/result" "$target"
    progress "built in $target"
fi
echo "$target"

# SPDX-License-Identifier: Apache-2.0
"""
Give machines disks and folders that outlive them.

The provider attaches a volume and keeps two machines apart. The script here makes a file system on
a new disk, mounts it and unmounts it.

In reading order: ``clouds`` (their disks), ``keepers`` (providers that keep volumes), ``listing``
and ``verbs`` (for ``ros2 fog``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import dataclasses
import itertools
import re
from typing import ClassVar, Optional, TYPE_CHECKING

from fogros2 import plugin_system
from fogros2.errors import (
    CommandError,
    ConfigurationError,
    DeadlineExceeded,
    ShellError,
    Unsupported,
)
from fogros2.feature import Feature, RunningMachine
from fogros2.model import Command, CreateRequest, MachineSpec
from fogros2.waiting import TO_DISK

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.provider import Attached, Provider
    from fogros2_features.volumes.keepers import VolumeKeeper

#: GB of a new volume, and the most.
SIZE, LARGEST = 50, 16000
#: Volumes of a machine: EC2 recommends 11 names of devices.
MOST = 10
_NAME = re.compile(r'[a-z]([a-z0-9-]{0,38}[a-z0-9])?')
#: Options of machines that name the place of their volumes.
_PLACE = ('region', 'zone', 'project_id', 'context', 'namespace', 'on', 'engine', 'host', 'port',
          'user')
_VALUE = re.compile(r'(/[A-Za-z0-9._/-]*?)/?(?::(\d{1,5}) ?GB)?')
#: Folders that belong to the system, with all below them; and those that hold others.
_SYSTEM = ('bin', 'boot', 'dev', 'etc', 'lib', 'lib32', 'lib64', 'libx32', 'proc', 'run', 'sbin',
           'sys', 'usr', 'snap', 'tmp')
_OUTER = re.compile(r'/(home|media|mnt|opt|root|srv|var)?|/home/[^/]+|/opt/ros(/.*)?|/var/[a-z]+')

# $1 name, $2 path, $3 login user, $4 the launch's interface, $5 folder; then paths of a device.
# A folder and its path have locks, which a process holds as long as the launch's VPN is there: it
# goes with the next launch at the latest if this one was killed. One machine has a disk.
_MOUNT = """\
path=$2 user=$3 link=$4 folder=$5 mark=/run/$4.volume-$1
shift 5
failed() { echo "$1" >&2; exit 1; }
make() {
    made=
    [ -d "$path" ] || { mkdir -p -- "$path"; made=yes; }
    exec 8<"$path"
    flock -n 8 && ! mountpoint -q -- "$path" || failed "$path has another volume"
    [ -z "$(ls -A -- "$path")" ] || failed "$path has files, which the volume would hide"
}
if [ $# -gt 0 ]; then
    n=0 device=
    while [ -z "$device" ]; do
        for each; do
            if [ -b "$each" ]; then device=$(readlink -f -- "$each"); break; fi
        done
        [ $n -lt 600 ] || failed 'the disk does not appear'
        [ -n "$device" ] || sleep 0.1
        n=$((n + 1))
    done
    : >"$mark"
    findmnt -n -o TARGET -S "$device" | while IFS= read -r other; do  # of a killed launch
        [ "$other" = "$path" ] || umount -- "$other" ||
            { sync -f "$other"; umount -l -- "$other"; }
    done
    if ! mountpoint -q -- "$path"; then
        make
        traces=$(wipefs -n -- "$device")
        if [ -z "$traces" ]; then  # as on a new disk, or where mkfs was ended
            cmp -s -n 4096 -- "$device" /dev/zero ||
                failed 'the disk has data, but no file system'
            mkfs.ext4 -q -m 0 "$device"
            echo new
        fi
        mount -- "$device" "$path"
    fi
    [ "$(findmnt -n -o SOURCE -M "$path")" = "$device" ] || failed "$path has another disk"
else
    case $folder in '~/'*) folder=$(getent passwd "$user" | cut -d : -f 6)/${folder#??} ;; esac
    [ -n "$folder" ] || mountpoint -q -- "$path" || failed 'the machine was made without it'
    [ -z "$folder" ] || runuser -u "$user" -- mkdir -p -- "$folder"
    exec 9<"${folder:-$path}"
    flock -w 10 9 || failed 'another launch uses it'
    [ -z "$folder" ] || make
    : >"$mark"
    [ -z "$folder" ] || mount --bind -- "$folder" "$path"
    setsid sh -c '
        n=0  # the agent may repair the VPN meanwhile
        while [ -e "$1" ] && [ $n -lt 10 ]; do
            [ -e "/sys/class/net/$2" ] && n=0 || n=$((n + 1))
            sleep 0.5
        done
        rm -f -- "$1"
        [ -z "$3" ] || ! mountpoint -q -- "$4" || umount -l -- "$4"
        [ -z "$5" ] || rmdir -- "$4"
    ' sh "$mark" "$link" "$folder" "$path" "${made-}" </dev/null >/dev/null 2>&1 &
fi
[ "$(stat -c %u -- "$path")" = "$(id -u "$user")" ] || chown -Rh -- "$user:" "$path"
"""
# $1 name, $2 path, $3 interface, $4 not empty: unmount it. All files are on the disk then.
# The mark goes last, because the process with the locks unmounts when it is gone.
_UNMOUNT = """\
[ -e "/run/$3.volume-$1" ] || exit 0  # another launch's
if [ -n "$4" ] && mountpoint -q -- "$2"; then
    umount -- "$2" || { sync -f "$2"; umount -l -- "$2"; }
fi
rm -f -- "/run/$3.volume-$1"
"""


class Volumes(Feature):
    """``volumes={'models': '/data'}``: a disk that comes back with the next machine."""

    # results are fetched from volumes, and containers mount their folders
    outermost: ClassVar[bool] = True

    @staticmethod
    def options(
        volumes: Optional[Mapping[str, SomeSubstitutionsType]] = None,
    ) -> dict[str, tuple[str, int]]:
        """
        Return the path and the size in GB of each volume.

        :param volumes: by name, the folder on the machine, such as '/data' or '/data:200GB'.
        """
        result = {name: _read(name, str(value)) for name, value in (volumes or {}).items()}
        if len(result) > MOST:
            raise ConfigurationError(f'{len(result)} volumes, and a machine has {MOST} at most',
                                     'keep several folders in one volume')
        for (one, (path, _)), (two, (other, _)) in itertools.permutations(result.items(), 2):
            if f'{other}/'.startswith(f'{path}/'):
                raise ConfigurationError(f"the volumes '{one}' and '{two}' have one path {other}",
                                         'give each a folder of its own')
        return result

    def check(self, spec: MachineSpec, own: Mapping[str, tuple[str, int]]) -> None:
        """Check that the provider has volumes, and that none hides the workspace."""
        provider = plugin_system.load('fogros2.provider', spec.provider)
        if own and not provider.capabilities.keeps_volumes:
            _keeper(provider())
        if own and spec.wanted is not None:
            raise Unsupported(
                f"'{spec.name}' may be at another cloud each time, and a volume stays at one",
                'name the cloud: AWSCloudInstance, AzureCloudInstance or GCPCloudInstance')
        for name, (path, _) in own.items():
            if any(f'{folder}/'.startswith(f'{path}/') for folder in spec.workspaces):
                raise ConfigurationError(f"the volume '{name}' at {path} would hide the workspace",
                                         'choose another folder')

    def check_beside(
        self, spec: MachineSpec, others: Sequence[MachineSpec],
        own: Mapping[str, tuple[str, int]],
    ) -> None:
        """Check that no other machine of the launch has one of the volumes."""
        for other in others:
            theirs = Volumes.options(**other.features.get('volumes', {}))
            shared = sorted({*own} & {*theirs})
            if shared and _place(spec) == _place(other):
                raise ConfigurationError(
                    f"'{spec.name}' and '{other.name}' have one volume '{shared[0]}', and one "
                    'machine has it at a time', 'give each machine a volume of its own')

    def request(
        self, request: CreateRequest, own: Mapping[str, tuple[str, int]],
    ) -> CreateRequest:
        """Have the machine created with the volumes."""
        return dataclasses.replace(request, with_volumes=own)

    @contextlib.contextmanager
    def machine(
        self, running: RunningMachine, own: Mapping[str, tuple[str, int]],
    ) -> Iterator[None]:
        """Mount the volumes, and unmount and detach them when the nodes have ended."""
        with contextlib.ExitStack() as undo:
            with running.step('volumes') as detail:
                for name, (path, size) in own.items():
                    keeper = _keeper(running.provider)
                    ways: list[Attached] = []
                    undo.callback(_detach, running, keeper, name, path, ways)
                    attached = keeper.attach(running.machine.id, name, size)
                    ways.append(attached)
                    assert running.machine.endpoint is not None
                    output = running.run(Command(
                        ('sh', '-ec', _MOUNT, 'sh', name, path, running.machine.endpoint.user,
                         running.interface.name, attached.folder, *attached.devices),
                        sudo=True, what=f"mount the volume '{name}'"), timeout=900.0)
                    detail.append(f'{name} at {path}{", new" if "new" in output else ""}')
            yield


def _place(spec: MachineSpec) -> Sequence[object]:
    return [spec.provider, *(spec.options.get(option) or '' for option in _PLACE)]


def _keeper(provider: Provider) -> VolumeKeeper:
    from fogros2_features.volumes.keepers import volume_keeper  # it loads what clouds share
    return volume_keeper(provider)


def _detach(
    running: RunningMachine, keeper: VolumeKeeper, name: str, path: str, ways: Sequence[Attached],
) -> None:
    if running.lost:
        return  # its provider detaches a disk when the machine ends
    for attached in ways:  # none, if an interrupt or an error ended 'attach'
        try:
            running.run(Command(
                ('sh', '-ec', _UNMOUNT, 'sh', name, path, running.interface.name,
                 attached.folder or ''.join(attached.devices)),
                sudo=True, what=f"unmount the volume '{name}'"), timeout=TO_DISK)
        except (CommandError, DeadlineExceeded) as error:
            raise ShellError(f"'{running.spec.name}' may not have written all files to the "
                             f"volume '{name}': {error}") from error
    if running.spec.on_exit != 'delete':  # the end of a machine detaches, too
        keeper.detach(running.machine.id, name)


def _read(name: str, value: str) -> tuple[str, int]:
    match = _VALUE.fullmatch(value)
    if not _NAME.fullmatch(name):
        raise ConfigurationError(f'{name!r} is no name of a volume',
                                 'up to 40 lower-case letters, digits and -')
    path, size = match.groups() if match else ('', None)
    parts = path.split('/')[1:]
    if not path or {'', '.', '..'} & {*parts}:
        raise ConfigurationError(
            f"the volume '{name}' has no folder and size, but {value!r}",
            "volumes={'models': '/data'}, or '/data:200GB' for its size when it is made")
    if parts[0] in _SYSTEM or _OUTER.fullmatch(path):
        raise ConfigurationError(f"the volume '{name}' would hide {path} of the system",
                                 "choose a folder of its own, such as '/data'")
    if size is not None and not 1 <= int(size) <= LARGEST:
        raise ConfigurationError(f"the volume '{name}' can't have {size} GB", f'1 to {LARGEST}')
    return path, int(size or SIZE)

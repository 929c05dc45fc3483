# SPDX-License-Identifier: Apache-2.0
"""
Builds ``ros-jazzy-fogros2_VERSION_all.deb``, laid out as bloom lays out a package of ROS 2 Jazzy.

    python3 packaging/deb.py [--output FOLDER]

Everything goes below ``/opt/ros/jazzy``: modules where Ubuntu 24.04's Python finds them once
``setup.bash`` is sourced, executables, launch files and index markers where ROS 2 looks. The names
of its dependencies come from ``package.xml``: packages of ROS by ROS's rule, the others by the
table below, as rosdep would say. ``dpkg-deb`` puts the package together; no network is needed.
"""

from __future__ import annotations

import argparse
import base64
from collections.abc import Iterator
import csv
import email
import gzip
import hashlib
import io
import os
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
import zipfile

ROOT = Path(__file__).resolve().parents[1]
PREFIX = Path('opt/ros/jazzy')
#: Of Ubuntu 24.04.
SITE_PACKAGES = PREFIX / 'lib/python3.12/site-packages'
#: Packages of this source tree, which are in the one that is built.
OWN = {'fogros2', *(path.parent.name for path in ROOT.glob('*/package.xml'))}
#: What rosdep's keys are in Ubuntu 24.04, with the version that it has, the oldest that is tried.
UBUNTU = {
    'iproute2': 'iproute2',
    'openssh-client': 'openssh-client',
    'python3-boto3': 'python3-boto3 (>= 1.34)',
    'python3-catkin-pkg-modules': 'python3-catkin-pkg-modules (>= 0.5)',
    'python3-cryptography': 'python3-cryptography (>= 41.0)',
    'python3-google-auth': 'python3-google-auth (>= 2.0)',
    'python3-numpy': 'python3-numpy (>= 1:1.26)',
    'python3-opencv': 'python3-opencv (>= 4.6)',
    'python3-packaging': 'python3-packaging (>= 24.0)',
    'python3-paramiko': 'python3-paramiko (>= 2.12)',
    'python3-requests': 'python3-requests (>= 2.31)',
    'python3-yaml': 'python3-yaml (>= 6.0)',
    'rsync': 'rsync',
    'wireguard': 'wireguard-tools',
}
#: What bloom adds to all packages: the folder's setup.bash.
WORKSPACE = 'ros-jazzy-ros-workspace'
#: What not every robot needs, and rosdep has no key for.
RECOMMENDS = ('nftables', 'podman', 'python3-kubernetes (>= 22.6)',
              'python3-zstandard (>= 0.20)', 'sudo', 'wireguard-go')
#: The helper by which a group of users makes VPN interfaces, what it imports, and its rights.
HELPER = ROOT / 'packaging/vpn_helper'
HELPER_FILES = {
    HELPER / 'vpn.py': ('usr/libexec/fogros2/vpn', 0o755),
    **{ROOT / f'fogros2/{name}.py': (f'usr/libexec/fogros2/fogros2/{name}.py', 0o644)
       for name in ('__init__', 'errors', 'model', 'untrusted', 'vpn/__init__', 'vpn/addresses',
                    'vpn/wireguard')},
    HELPER / 'sudoers': ('etc/sudoers.d/fogros2-vpn', 0o440),
    **{HELPER / f'fogros2-vpn-tidy.{kind}': (f'usr/lib/systemd/system/fogros2-vpn-tidy.{kind}',
                                            0o644) for kind in ('service', 'timer')}}
TIMER = 'fogros2-vpn-tidy.timer'

#: What apt shows below the first line, one line each.
DESCRIPTION = (
    'Machines (EC2 instances, pods of a Kubernetes cluster, SSH hosts, containers) are',
    'created as the launch begins, get the workspace, ROS 2 and a VPN, and are deleted as',
    'it ends. The examples and the streams of images and point clouds are here, too.')
#: Run before removal and upgrade. VPN interfaces lose what would take them away, and a Python of
#: root's has compiled modules, which dpkg knows nothing of, so that their folders would stay.
PRERM = f"""\
#!/bin/sh
set -e
[ ! -d /run/systemd/system ] || systemctl stop --quiet {TIMER} || :
""" + """\
if [ "$1" = remove ]; then
    # of `sudo apt`: the helper would take it for the owner of an interface
    unset SUDO_UID
    for each in /run/fogros2-vpn/fog*; do
        [ -d "$each" ] || continue
        printf '{"name": "%s"}' "${each##*/}" | /usr/libexec/fogros2/vpn down || :
    done
    rm -rf /run/fogros2-vpn
fi
dpkg -L ros-jazzy-fogros2 | sed -n 's/\\.py$//p' | while read -r module; do
    folder=${module%/*}/__pycache__
    [ -d "$folder" ] || continue
    rm -f -- "$folder/${module##*/}".*.pyc
    rmdir --ignore-fail-on-non-empty -- "$folder"
done
"""
#: A group without members: an administrator says who may, and may mask the timer.
POSTINST = f"""\
#!/bin/sh
set -e
getent group fogros2 >/dev/null || groupadd --system fogros2
if [ -d /run/systemd/system ]; then
    systemctl daemon-reload || :
    systemctl start --quiet {TIMER} || :
fi
"""
POSTRM = """\
#!/bin/sh
set -e
[ "$1" = purge ] || exit 0
! getent group fogros2 >/dev/null || groupdel fogros2
"""
SCRIPTS = {'postinst': POSTINST, 'prerm': PRERM, 'postrm': POSTRM}


def dependencies(manifests: list[Path]) -> list[str]:
    """
    Return what the package depends on, as Debian writes it, sorted.

    :raises LookupError: a key that is neither a package of ROS nor in the table.
    """
    keys = {element.text or '' for manifest in manifests
            for kind in ('depend', 'exec_depend')
            for element in ElementTree.parse(manifest).getroot().iter(kind)
            if element.get('condition') is None}
    return sorted({WORKSPACE, *(_debian(key) for key in keys - OWN)})


def _debian(key: str) -> str:
    if key in UBUNTU:
        return UBUNTU[key]
    if key.startswith('python3-'):
        raise LookupError(f'package.xml names {key}, for which packaging/deb.py has no version')
    return 'ros-jazzy-' + key.replace('_', '-')


def wheel(folder: Path) -> Path:
    """Build the wheel from a copy, as setuptools leaves folders behind, and return its path."""
    source = folder / 'source'
    names = subprocess.run(
        ['git', 'ls-files', '-z', '-co', '--exclude-standard'], cwd=ROOT, check=True,
        capture_output=True).stdout.decode().split('\0')
    for name in filter(None, names):
        target = source / name
        if (ROOT / name).is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target)
    subprocess.run(
        [sys.executable, '-m', 'pip', 'wheel', '--quiet', '--no-deps', '--no-build-isolation',
         '--wheel-dir', str(folder / 'wheel'), str(source)], check=True)
    (found,) = (folder / 'wheel').glob('fogros2-*.whl')
    return found


def unpack(built: Path, stage: Path) -> str:
    """Put a wheel's files where they belong below ``stage``; return its version."""
    version = ''
    with zipfile.ZipFile(built) as archive:
        for entry in archive.infolist():
            path = Path(entry.filename)
            if path.parts[0].endswith('.data'):
                if path.parts[1] != 'data':
                    raise LookupError(f'{entry.filename}: what is it?')
                target = stage / PREFIX / Path(*path.parts[2:])
            else:
                target = stage / SITE_PACKAGES / path
            if path.name == 'METADATA':
                version = email.message_from_bytes(archive.read(entry))['Version']
            if path.name == 'RECORD':
                record = target
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(archive.read(entry))
            # what ROS 2 runs
            executable = target.is_relative_to(stage / PREFIX / 'lib') and \
                not target.is_relative_to(stage / SITE_PACKAGES)
            target.chmod(0o755 if executable else 0o644)
    installed(record)
    return version


def installed(record: Path) -> None:
    """
    Turn a wheel's list of files into the list of an installed one, as pip does.

    ``.data/data`` becomes the place below the prefix, and INSTALLER says to pip that apt removes
    it. Without, the wheel that goes from the robot to a machine would lack nodes and launch files.
    See PyPA's "Recording installed projects".
    """
    name = b'debian\n'
    installer = record.with_name('INSTALLER')
    installer.write_bytes(name)
    installer.chmod(0o644)
    up = os.path.relpath(PREFIX, SITE_PACKAGES)
    rows = []
    for path, digest, size in csv.reader(io.StringIO(record.read_text())):
        top, _, rest = path.partition('/data/')
        rows.append((f'{up}/{rest}' if top.endswith('.data') else path, digest, size))
    digest = base64.urlsafe_b64encode(hashlib.sha256(name).digest()).rstrip(b'=').decode()
    rows.append((f'{record.parent.name}/INSTALLER', f'sha256={digest}', str(len(name))))
    out = io.StringIO()
    csv.writer(out, lineterminator='\n').writerows(rows)
    record.write_text(out.getvalue())


def maintainer() -> ElementTree.Element:
    """Return who looks after the package, as ``package.xml`` has it."""
    found = ElementTree.parse(ROOT / 'package.xml').getroot().find('maintainer')
    if found is None:
        raise LookupError('package.xml names no maintainer')
    return found


def documents(stage: Path) -> None:
    """Write what Debian's policy wants beside the files: licence and change log."""
    folder = stage / 'usr/share/doc/ros-jazzy-fogros2'
    folder.mkdir(parents=True)
    (folder / 'copyright').write_text(
        f'Copyright: {maintainer().text}\nLicense: Apache-2.0\n\nThe whole licence is in '
        '/usr/share/common-licenses/Apache-2.0 on Debian and Ubuntu.\n')
    (folder / 'changelog.gz').write_bytes(
        gzip.compress((ROOT / 'CHANGELOG.rst').read_bytes(), 9, mtime=0))
    for path in folder.iterdir():
        path.chmod(0o644)


def helper(stage: Path) -> None:
    """Write the helper of the VPN beside the rest, and what starts it."""
    for source, (name, mode) in HELPER_FILES.items():
        target = stage / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
        target.chmod(mode)
    wants = stage / 'usr/lib/systemd/system/timers.target.wants'
    wants.mkdir()
    (wants / TIMER).symlink_to(f'../{TIMER}')


def control(stage: Path, version: str) -> Iterator[str]:
    """Yield the lines of the control file."""
    manifests = [ROOT / 'package.xml', *(
        ROOT / name / 'package.xml' for name in sorted(OWN - {'fogros2'}))]
    root = ElementTree.parse(ROOT / 'package.xml').getroot()
    who = maintainer()
    size = sum(path.stat().st_size for path in stage.rglob('*') if path.is_file())
    yield 'Package: ros-jazzy-fogros2'
    yield f'Version: {version}'
    yield 'Architecture: all'
    yield 'Section: misc'
    yield 'Priority: optional'
    yield f'Maintainer: {who.text} <{who.get("email")}>'
    yield f'Installed-Size: {-(-size // 1024)}'
    yield f'Depends: {", ".join(["python3 (>= 3.12)", *dependencies(manifests)])}'
    others = (_debian(name) for name in sorted(OWN - {'fogros2'}))
    yield f'Provides: {", ".join(f"{name} (= {version})" for name in others)}'
    yield f'Recommends: {", ".join(RECOMMENDS)}'
    # apt's first line is no sentence
    yield f'Description: {(root.findtext("description") or "").strip().rstrip(".")}'
    yield from (f' {line}' for line in DESCRIPTION)


def build(output: Path) -> Path:
    """Build the package and return its path."""
    with tempfile.TemporaryDirectory(prefix='fogros2-deb-') as name:
        folder = Path(name)
        stage = folder / 'stage'
        version = unpack(wheel(folder), stage)
        documents(stage)
        helper(stage)
        files = sorted(
            path for path in stage.rglob('*') if path.is_file() and not path.is_symlink())
        debian = stage / 'DEBIAN'
        lines = list(control(stage, version))
        debian.mkdir()
        (debian / 'control').write_text('\n'.join(lines) + '\n')
        (debian / 'md5sums').write_text(''.join(
            f'{hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest()}  '
            f'{path.relative_to(stage)}\n' for path in files))
        (debian / 'conffiles').write_text('/etc/sudoers.d/fogros2-vpn\n')
        for name, text in SCRIPTS.items():
            (debian / name).write_text(text)
            (debian / name).chmod(0o755)
        for path in (stage, *stage.rglob('*')):
            if path.is_dir():
                path.chmod(0o755)
        output.mkdir(parents=True, exist_ok=True)
        target = output / f'ros-jazzy-fogros2_{version}_all.deb'
        subprocess.run(['dpkg-deb', '--build', '--root-owner-group', '-Zxz', str(stage),
                        str(target)], check=True, stdout=subprocess.DEVNULL)
    return target


def main() -> None:
    """Build, and say where the package is."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--output', type=Path, default=ROOT / '.cache/deb')
    print(build(parser.parse_args().output))


if __name__ == '__main__':
    main()

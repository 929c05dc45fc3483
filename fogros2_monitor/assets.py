# SPDX-License-Identifier: Apache-2.0
"""
Read the files of robot models that viewers request: meshes, textures, URDF.

A viewer names a file by ``package://PACKAGE/PATH``. The file must be in the share folder of a
package of the ament index. The links of ``colcon build --symlink-install`` may also lead to other
folders of the package's workspace. Nothing else is read, whatever a link says.
"""

from __future__ import annotations

import os
from pathlib import Path
import re
import stat
from urllib.parse import unquote

from ament_index_python.packages import get_package_prefix

from fogros2.errors import FogError

#: Endings of the files that viewers may read.
KINDS = {*'.dae .fbx .glb .gltf .jpeg .jpg .mtl .obj .png .stl .tif .tiff .urdf .webp'.split()}
#: Largest file in bytes, and longest URI in characters.
LARGEST, LONGEST = 32_000_000, 1024
_URI = re.compile(r'package://([A-Za-z][\w-]*)/(.+)', re.ASCII)
#: File that colcon writes into an install space.
_COLCON = '.colcon_install_layout'


def parse(uri: str) -> tuple[str, str]:
    """
    Return package and path of an asset.

    The path is percent-decoded once. It has only names: no '..', no empty name, no backslash and
    no control character.

    :raises FogError: the URI has another form, or the file is of another kind.
    """
    match = _URI.fullmatch(uri) if len(uri) <= LONGEST else None
    path = unquote(match[2]) if match else ''
    odd = {'', '.', '..'} & {*path.split('/')} or '\\' in path or not path.isprintable()
    if match is None or odd:
        raise FogError('an asset is package://PACKAGE/PATH')
    if os.path.splitext(path)[1].lower() not in KINDS:
        raise FogError(f"an asset ends with one of {' '.join(sorted(KINDS))}")
    return match[1], path


def locate(prefix: Path, package: str, path: str) -> Path:
    """
    Return the real path of an asset.

    :param prefix: where the package is installed.
    :raises FogError: the real path is elsewhere, or of another kind.
    """
    roots = [prefix / 'share' / package]
    # an install space has a folder for each package, or the packages side by side
    roots += [space.parent for space in (prefix, prefix.parent) if (space / _COLCON).is_file()]
    real = Path(os.path.realpath(roots[0] / path))
    if real.suffix.lower() not in KINDS or not any(
            real.is_relative_to(os.path.realpath(root)) for root in roots):
        raise FogError(f'{path} leads out of package {package} and its workspace')
    return real


def read(uri: str) -> bytes:
    """
    Return the content of an asset.

    :raises FogError: viewers cannot have it.
    """
    package, path = parse(uri)
    try:
        real = locate(Path(get_package_prefix(package)), package, path)
        # a pipe would block without O_NONBLOCK
        with open(os.open(real, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), 'rb') as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode) or status.st_size > LARGEST:
                raise FogError(f'{path} is no file of at most {LARGEST / 1e6:g} MB')
            return file.read(LARGEST)
    except (LookupError, OSError, ValueError) as error:
        raise FogError(f'there is no package {package} with {path}') from error

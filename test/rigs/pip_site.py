# SPDX-License-Identifier: Apache-2.0
"""Packages of a workspace as colcon installs them, distributions as pip does, and wheels."""

from __future__ import annotations

from pathlib import Path
import zipfile


def package(root: Path, name: str, code: str = '', *lines: str) -> None:
    """Write an installed Python package of a workspace; ``lines`` go into its manifest."""
    prefix = root / 'install' / name
    for file, text in (
            (f'share/ament_index/resource_index/packages/{name}', ''),
            (f'share/{name}/package.xml',
             f'<package><name>{name}</name>{"".join(lines)}</package>'),
            (f'lib/python3.12/site-packages/{name}/__init__.py', ''),
            (f'lib/python3.12/site-packages/{name}/node.py', code)):
        (prefix / file).parent.mkdir(parents=True, exist_ok=True)
        (prefix / file).write_text(text)


def distribution(site: Path, name: str, *files: str, installer: str = 'pip') -> None:
    """Write what an installer leaves of a distribution, and empty files."""
    folder = site / f'{name}-1.dist-info'
    folder.mkdir()
    (folder / 'METADATA').write_text(f'Metadata-Version: 2.1\nName: {name}\nVersion: 1\n')
    if installer:
        (folder / 'INSTALLER').write_text(f'{installer}\n')
    (folder / 'RECORD').write_text(''.join(
        f'{file},sha256=0,0\n' for file in (*files, f'{folder.name}/RECORD')))
    for file in files:
        (site / file).parent.mkdir(parents=True, exist_ok=True)
        (site / file).touch()


def wheel(
    folder: Path, name: str, version: str = '1', needs: str = '', **files: str,
) -> Path:
    """Write a wheel of some modules, by name without suffix, or of other files."""
    path = folder / f'{name}-{version}-py3-none-any.whl'
    info = f'{name}-{version}.dist-info'
    texts = {
        **{file if '.' in file else f'{file}.py': text for file, text in files.items()},
        f'{info}/METADATA': f'Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n'
                            f'{needs and f"Requires-Dist: {needs}"}\n',
        f'{info}/WHEEL': 'Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n'}
    with zipfile.ZipFile(path, 'w') as archive:
        for file, text in texts.items():
            archive.writestr(file, text)
        archive.writestr(f'{info}/RECORD', ''.join(
            f'{file},,\n' for file in (*texts, f'{info}/RECORD')))
    return path

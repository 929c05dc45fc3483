# SPDX-License-Identifier: Apache-2.0
"""rosdep's lists as files of a test's own, so that nothing is asked of the internet."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import platform
from typing import Optional

from fogros2.host.inspection import DISTRO

_SYSTEMS = '{debian: [bookworm, trixie], ubuntu: [noble]}'
#: One package of ROS 2 that rosdep knows by the distribution's index.
_RELEASED = f"""\
  release_platforms: {_SYSTEMS}
  repositories:
    slam_toolbox:
      release: {{packages: [slam_toolbox], tags: {{release: x}}, url: 'https://example.com/x.git',
                version: 2.8.2-1}}
  type: distribution
  version: 2
"""


def rosdep_source(
    folder: Path, rules: Mapping[str, str], there: Optional[str] = None,
) -> dict[str, str]:
    """
    Write lists for rosdep, and return the variables with which it reads them.

    :param rules: of each key, in YAML, for this computer's system.
    :param there: path by which rosdep finds the folder, if it is another.
    """
    at = there or str(folder)
    system = platform.freedesktop_os_release()['ID']
    (folder / 'sources').mkdir()
    (folder / 'sources' / '1.list').write_text(f'yaml file://{at}/rules.yaml\n')
    (folder / 'rules.yaml').write_text(
        ''.join(f'{key}: {{{system}: {rule}}}\n' for key, rule in rules.items()))
    (folder / 'index.yaml').write_text(
        f'%YAML 1.1\n---\ndistributions:\n  {DISTRO}: {{distribution: [distribution.yaml], '
        f"distribution_cache: 'file://{at}/cache.yaml', distribution_status: active, "
        'distribution_type: ros2, python_version: 3}\ntype: index\nversion: 4\n')
    (folder / 'distribution.yaml').write_text(f'%YAML 1.1\n---\n{_RELEASED}')
    (folder / 'cache.yaml').write_text(
        '%YAML 1.1\n---\ndistribution_file:\n' + _RELEASED.replace('  ', '- ', 1)
        + f'name: {DISTRO}\nrelease_package_xmls: {{}}\ntype: cache\nversion: 2\n')
    return {'ROSDEP_SOURCE_PATH': f'{at}/sources', 'ROSDISTRO_INDEX_URL': f'file://{at}/index.yaml',
            **({'ROS_HOME': str(folder / 'home')} if there is None else {})}

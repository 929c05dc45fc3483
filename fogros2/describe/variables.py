# SPDX-License-Identifier: Apache-2.0
"""Keep the robot's own variables here where a launch file copies its whole environment."""

from __future__ import annotations

from collections.abc import Mapping

from fogros2 import dds

#: Variables that describe the robot's own system; a launch file's changes of them stay here.
LOCAL_VARIABLES = frozenset({
    *dds.VARIABLES, 'AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'COLCON_PREFIX_PATH', 'HOME',
    'LD_LIBRARY_PATH', 'LOGNAME', 'OLDPWD', 'PATH', 'PWD', 'PYTHONPATH', 'ROS_HOME',
    'ROS_LOG_DIR', 'SHELL', 'SHLVL', 'TMPDIR', 'USER', '_',
})
#: Lists of folders, of which a machine gets those that a launch file adds.
FOLDERS = ('LD_LIBRARY_PATH', 'PATH', 'PYTHONPATH')
#: Share of the robot's variables from which a list is a copy of its environment.
COPY = 0.8
_reported: set[str] = set()


def added_folders(variables: Mapping[str, str], robot: Mapping[str, str]) -> dict[str, str]:
    """Return the folders that lists of a process have beyond the robot's, by variable."""
    added = {}
    for name in FOLDERS:
        known = ['', *robot.get(name, '').split(':')]
        if folders := [one for one in variables.get(name, '').split(':') if one not in known]:
            added[name] = ':'.join(folders)
    return added


def to_send(variables: Mapping[str, str], robot: Mapping[str, str]) -> dict[str, str]:
    """
    Return the variables that a machine gets; of a copy of the robot's, only what differs.

    The robot's environment has credentials, such as ``AWS_SECRET_ACCESS_KEY``, and
    ``env={**os.environ, ...}`` copies them. A warning names the variables that stay here, once.

    :param robot: the robot's variables.
    """
    same = [name for name, value in robot.items() if variables.get(name) == value]
    if not same or len(same) < COPY * len(robot):
        return dict(variables)
    sent = {name: value for name, value in variables.items()
            if robot.get(name) != value and name not in LOCAL_VARIABLES}
    new = sorted(variables.keys() - sent.keys() - _reported)
    if new:
        import launch.logging
        _reported.update(new)
        launch.logging.get_logger('fogros2').warning(
            "a launch file copies the robot's environment; these variables stay here: "
            f"{', '.join(new)}\nname those that a machine needs one by one")
    return sent

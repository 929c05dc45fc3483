# SPDX-License-Identifier: Apache-2.0
"""Build an image for pods that contains everything that a launch would install."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import os
from pathlib import Path
import shutil
from typing import Optional

from fogros2 import plan
from fogros2.errors import PrerequisiteError
from fogros2.host import bootstrap, installer, workspace
from fogros2.model import MachineSpec
from fogros2.provider.kubernetes import image

#: The package that a pod needs if its Kubernetes node has no kernel module for the VPN.
PACKAGE = 'wireguard-go'


def recipe(
    registry: str, *, base: str = '', folder: Optional[str] = None,
    environment: Optional[Mapping[str, str]] = None,
) -> image.Recipe:
    """
    Return the recipe of the image for launches from this terminal.

    :param base: base image; '': the default image of pods.
    :param folder: the workspace; None: the sourced workspace, '': none.
    :raises PrerequisiteError: no ROS 2 is sourced here, so its dependencies are unknown.
    """
    environment = os.environ if environment is None else environment
    chain = workspace.find_workspaces(environment)
    root = next(iter(chain), None) if folder is None else folder
    if root:
        root = os.path.abspath(os.path.expanduser(root))
        workspace.inspect(Path(root))
    ros2 = shutil.which('ros2', path=environment.get('PATH'))
    if ros2 is None:
        raise PrerequisiteError('ros2 is not on PATH', "source ROS 2's setup.bash")
    spec = MachineSpec('image', 'kubernetes', workspace=root or None,
                       underlays=workspace.underlays(root or None, chain))
    under = plan.underlay(environment, spec.workspaces, ros2)
    more = {'base': base} if base else {}
    return image.recipe(
        registry, dependencies=bootstrap.dependencies(spec, under),
        script=installer.image_script(
            (*bootstrap.apt_packages(under.rmw), PACKAGE),
            workspace.dependencies(*spec.workspaces)), **more)


def build(
    what: image.Recipe, folder: Path, *, engine: str, push: bool, say: Callable[[str], None],
) -> str:
    """
    Write the recipe to ``folder``, build the image and push it; return its reference.

    :raises FogError: a step failed; the error has the last output of the engine.
    """
    return image.build(
        what, folder, program=image.engine(engine), push=push, on_output=say)

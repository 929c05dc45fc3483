# SPDX-License-Identifier: Apache-2.0
"""Where packages and their executables are, and global parameters' values."""
from __future__ import annotations

import os
import shutil

from ament_index_python.packages import get_package_prefix, get_package_share_directory
from embedded_default.lacking import lacking
from launch import SomeSubstitutionsType
from launch.frontend.expose import expose_substitution
from launch.launch_context import LaunchContext
from launch.substitutions import (
    described,
    ParsedSubstitution,
    PathSubstitution,
    SubstitutionFailure,
)
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

__all__ = ['ExecutableInPackage', 'FindPackage', 'FindPackagePrefix', 'FindPackageShare']
__getattr__ = lacking(__name__, 'Parameter')


class FindPackage(ParsedSubstitution, PathSubstitution):
    """Base of those that find a package; PackageNotFoundError if there is no such."""

    _parameters: tuple[str, ...] = ('package',)

    def __init__(self, package: SomeSubstitutionsType) -> None:
        super().__init__(())
        self.package = normalize_to_list_of_substitutions(package)

    def find(self, package_name: str) -> str:
        raise NotImplementedError()

    def describe(self) -> str:
        return f'{type(self).__name__}(pkg={described(self.package)})'

    def perform(self, context: LaunchContext) -> str:
        return self.find(perform_substitutions(context, self.package))


@expose_substitution('find-pkg-prefix')
class FindPackagePrefix(FindPackage):

    def find(self, package_name: str) -> str:
        return str(get_package_prefix(package_name))


@expose_substitution('find-pkg-share')
class FindPackageShare(FindPackage):

    def find(self, package_name: str) -> str:
        return str(get_package_share_directory(package_name))


@expose_substitution('exec-in-pkg')
class ExecutableInPackage(FindPackagePrefix):

    _parameters = ('executable', 'package')

    def __init__(self, executable: SomeSubstitutionsType, package: SomeSubstitutionsType) -> None:
        super().__init__(package)
        self.executable = normalize_to_list_of_substitutions(executable)

    def describe(self) -> str:
        return f'ExecInPkg(pkg={described(self.package)}, exec={described(self.executable)})'

    def perform(self, context: LaunchContext) -> str:
        executable = perform_substitutions(context, self.executable)
        package = perform_substitutions(context, self.package)
        prefix = super().perform(context)
        libexec = os.path.join(prefix, 'lib', package)
        if not os.path.exists(libexec):
            raise SubstitutionFailure(
                f"package '{package}' found at '{prefix}', but libexec directory '{libexec}' "
                'does not exist')
        path = shutil.which(executable, path=libexec)
        if path is None:
            raise SubstitutionFailure(
                f"executable '{executable}' not found on the libexec directory '{libexec}' ")
        return path

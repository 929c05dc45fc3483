# SPDX-License-Identifier: Apache-2.0
"""Where packages and their executables are, and global parameters' values."""
from __future__ import annotations

import os
import shutil
from typing import Any, Dict, List, Sequence, Tuple, Type

from launch._aliases import alias_submodules, missing
from launch.frontend.expose import expose_substitution
from launch.launch_context import LaunchContext
from launch.some_substitutions_type import SomeSubstitutionsType
from launch.substitution import Substitution
from launch.substitutions import SubstitutionFailure
from launch.substitutions._values import normalized_default
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

__all__ = [
    'ExecutableInPackage', 'FindPackage', 'FindPackagePrefix', 'FindPackageShare', 'Parameter']

Parsed = Tuple[Type[Any], Dict[str, Any]]


def _described(substitutions: Sequence[Substitution]) -> str:
    return ' + '.join(sub.describe() for sub in substitutions)


class FindPackage(Substitution):
    """Base of those that find a package."""

    def __init__(self, package: SomeSubstitutionsType) -> None:
        super().__init__()
        self.__package = normalize_to_list_of_substitutions(package)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(name package)``."""
        if not data or len(data) != 1:
            raise AttributeError('find package substitutions expect 1 argument')
        return cls, {'package': data[0]}

    @property
    def package(self) -> List[Substitution]:
        """The package's name."""
        return self.__package

    def find(self, package_name: str) -> str:
        """
        Return the path that is looked for.

        :raises ament_index_python.packages.PackageNotFoundError: if there is no such package.
        """
        raise NotImplementedError()

    def describe(self) -> str:
        return f'{type(self).__name__}(pkg={_described(self.package)})'

    def perform(self, context: LaunchContext) -> str:
        return self.find(perform_substitutions(context, self.package))


@expose_substitution('find-pkg-prefix')
class FindPackagePrefix(FindPackage):
    """The directory that a package is installed below."""

    def find(self, package_name: str) -> str:
        from ament_index_python.packages import get_package_prefix
        return str(get_package_prefix(package_name))


@expose_substitution('find-pkg-share')
class FindPackageShare(FindPackage):
    """A package's share directory."""

    def find(self, package_name: str) -> str:
        from ament_index_python.packages import get_package_share_directory
        return str(get_package_share_directory(package_name))


@expose_substitution('exec-in-pkg')
class ExecutableInPackage(FindPackagePrefix):
    """The path of a package's executable."""

    def __init__(
        self, executable: SomeSubstitutionsType, package: SomeSubstitutionsType
    ) -> None:
        super().__init__(package)
        self.__executable = normalize_to_list_of_substitutions(executable)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(exec-in-pkg executable package)``."""
        if not data or len(data) != 2:
            raise AttributeError('exec-in-package substitution expects 2 arguments')
        return cls, {'executable': data[0], 'package': data[1]}

    @property
    def executable(self) -> List[Substitution]:
        """The executable's name."""
        return self.__executable

    def describe(self) -> str:
        return f'ExecInPkg(pkg={_described(self.package)}, exec={_described(self.executable)})'

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


@expose_substitution('param')
class Parameter(Substitution):
    """The value that SetParameter gave a parameter for all nodes, or the default."""

    def __init__(self, name: SomeSubstitutionsType, *, default: Any = None) -> None:
        super().__init__()
        self.__name = normalize_to_list_of_substitutions(name)
        self.__default = normalized_default(default)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(param name [default])``."""
        if len(data) < 1 or len(data) > 2:
            raise TypeError('param substitution expects 1 or 2 arguments')
        return cls, dict(zip(('name', 'default'), data))

    @property
    def name(self) -> List[Substitution]:
        """The parameter's name."""
        return self.__name

    def describe(self) -> str:
        return f'{type(self).__name__}(name={_described(self.name)})'

    def perform(self, context: LaunchContext) -> str:
        name = perform_substitutions(context, self.name)
        for parameter in context.launch_configurations.get('global_params', ()):
            if isinstance(parameter, tuple) and parameter[0] == name:
                return str(parameter[1])
        if self.__default is None:
            raise SubstitutionFailure(f"parameter '{name}' not found")
        return perform_substitutions(context, self.__default)


alias_submodules(__name__, __all__, {
    'find_package': ('FindPackage', 'FindPackagePrefix', 'FindPackageShare')})


def __getattr__(name: str) -> object:
    missing(__name__, name)

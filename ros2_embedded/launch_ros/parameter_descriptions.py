# SPDX-License-Identifier: Apache-2.0
"""Parameters of nodes as launch files describe them."""
from __future__ import annotations

from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

from embedded_default.lacking import lacking
from launch import LaunchContext, SomeSubstitutionsType
from launch.frontend.parse_substitution import parse_substitution
from launch.substitutions import SubstitutionFailure
from launch.utilities import normalize_to_list_of_substitutions as normalize
from launch.utilities import perform_substitutions
from launch.utilities.type_utils import normalize_typed_substitution, perform_typed_substitution

__getattr__ = lacking(__name__, 'Parameter')


class ParameterValue:
    """
    A value, or substitutions that become one.

    :param value_type: what they become, by default what YAML makes of the text.
    """

    def __init__(self, value: Any, *, value_type: Any = None) -> None:
        self.__value = normalize_typed_substitution(value, value_type)
        self.value_type = value_type

    @property
    def value(self) -> Any:
        """The value once evaluated, before that as it was given."""
        return self.__value

    def evaluate(self, context: LaunchContext) -> Any:
        """
        Return the value.

        :raises ValueError: if it isn't of the type.
        """
        self.__value = perform_typed_substitution(context, self.__value, self.value_type)
        return self.__value


class ParameterFile:
    """
    A YAML file of parameters.

    :param allow_substs: whether substitutions in it are performed; then a temporary file
        takes its place, which goes when this object does.
    """

    __evaluated: Path | None = None

    def __init__(
        self, param_file: SomeSubstitutionsType, *, allow_substs: bool = False
    ) -> None:
        self.__param_file = normalize(param_file)
        self.allow_substs = allow_substs

    @property
    def param_file(self) -> Any:
        """The path once evaluated, before that its substitutions."""
        return self.__evaluated or self.__param_file

    def evaluate(self, context: LaunchContext) -> Path:
        """
        Return the path.

        :raises SubstitutionFailure: if the file with its substitutions performed isn't YAML.
        """
        if self.__evaluated is not None:
            return self.__evaluated
        path = Path(perform_substitutions(context, self.__param_file))
        if self.allow_substs:
            import yaml
            text = perform_substitutions(context, parse_substitution(path.read_text('utf-8')))
            try:
                yaml.safe_load(text)
            except yaml.YAMLError as exc:
                raise SubstitutionFailure(
                    'The substituted parameter file is not a valid yaml file') from exc
            with NamedTemporaryFile(
                    mode='w', prefix='launch_params_', delete=False, encoding='utf-8') as file:
                path = Path(file.name)
                file.write(text)
        self.__evaluated = path
        return path

    def cleanup(self) -> None:
        """Remove the temporary file, if there is one."""
        if self.allow_substs and self.__evaluated is not None:
            self.__evaluated.unlink(missing_ok=True)
            self.__evaluated = None

    def __del__(self) -> None:
        self.cleanup()

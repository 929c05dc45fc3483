# SPDX-License-Identifier: Apache-2.0
"""The part of a node that holds its parameters."""

from collections.abc import Callable
import math
from typing import Any
import warnings

from rcl_interfaces import msg
from rclpy import exceptions
from rclpy.parameter import Parameter, PARAMETER_SEPARATOR_STRING
from rclpy.validate_parameter_name import validate_parameter_name

Callback = Callable[[list[Parameter]], Any]


def _refused(reason: str) -> Any:
    return msg.SetParametersResult(successful=False, reason=reason)


class NodeParameters:
    """Declares, reads and sets parameters; a part of :class:`.Node`."""

    PARAM_REL_TOL = 1e-6
    """Tolerance when floating point values are compared, relative."""

    def _init_parameters(self, allow_undeclared: bool) -> None:
        self._parameters: dict[str, Parameter] = {}
        self._descriptors: dict[str, Any] = {}
        self._parameter_overrides: dict[str, Parameter] = {}
        self._allow_undeclared_parameters = allow_undeclared
        self._pre_set_parameters_callbacks: list[Callback] = []
        self._on_set_parameters_callbacks: list[Callback] = []
        self._post_set_parameters_callbacks: list[Callback] = []

    def _publish_parameter_event(self, event: Any) -> None:
        raise AssertionError

    # --- declaring ---

    def declare_parameter(self, name: str, value: Any = None, descriptor: Any = None,
                          ignore_override: bool = False) -> Parameter:
        """
        Declare a parameter.

        :param value: its default value, or its type (:class:`.Parameter.Type`) without any.
        :param descriptor: ``rcl_interfaces.msg.ParameterDescriptor``.
        :param ignore_override: take the default value, whatever the command line says.
        :returns: the parameter with the value that it has now.
        :raises ParameterAlreadyDeclaredException: if it was declared before.
        :raises InvalidParameterException: if the name is invalid.
        :raises InvalidParameterTypeException: if the value isn't of the declared type.
        :raises InvalidParameterValueException: if a callback or the descriptor refuses it.
        """
        if value is None and descriptor is None:
            return self.declare_parameters('', [(name,)], ignore_override)[0]
        described = msg.ParameterDescriptor() if descriptor is None else descriptor
        return self.declare_parameters('', [(name, value, described)], ignore_override)[0]

    def declare_parameters(self, namespace: str, parameters: list[tuple[Any, ...]],
                           ignore_override: bool = False) -> list[Parameter]:
        """
        Declare parameters below a namespace: tuples of name, value or type, descriptor.

        See :meth:`declare_parameter`.
        """
        declared: list[Parameter] = []
        descriptors: dict[str, Any] = {}
        for index, item in enumerate(parameters):
            if not 1 <= len(item) <= 3:
                raise TypeError(f'Invalid parameter tuple length at index {index} in parameters '
                                f'list: {item}; expecting length between 1 and 3')
            name, given = item[0], item[1] if len(item) > 1 else None
            if not isinstance(name, str):
                raise TypeError(f'First element {name} at index {index} in parameters list '
                                'is not a str.')
            name = f'{namespace}.{name}' if namespace else name
            validate_parameter_name(name)
            descriptor = item[2] if len(item) > 2 else msg.ParameterDescriptor()
            if not isinstance(descriptor, msg.ParameterDescriptor):
                raise TypeError(f'Third element {descriptor} at index {index} in parameters '
                                'list is not a ParameterDescriptor.')
            if len(item) == 1:
                warnings.warn(
                    f"when declaring parameter named '{name}', declaring a parameter only "
                    'providing its name is deprecated. You have to either:\n'
                    '\t- Pass a name and a default value different to "PARAMETER NOT SET"'
                    ' (and optionally a descriptor).\n'
                    '\t- Pass a name and a parameter type.\n'
                    '\t- Pass a name and a descriptor with `dynamic_typing=True',
                    stacklevel=3)
                descriptor.dynamic_typing = True
            value = self._default(name, given, descriptor)
            if not ignore_override and name in self._parameter_overrides:
                value = self._parameter_overrides[name].value
            declared.append(Parameter(name, value=value))
            descriptors[name] = descriptor
        already = [one.name for one in declared if one.name in self._parameters]
        if already:
            raise exceptions.ParameterAlreadyDeclaredException(already)
        for one in declared:
            result = self._set([one], descriptors, keep_unset=True)
            if not result.successful:
                if result.reason.startswith('Wrong parameter type'):
                    raise exceptions.InvalidParameterTypeException(
                        one, Parameter.Type(descriptors[one.name].type).name)
                raise exceptions.InvalidParameterValueException(one.name, one.value, result.reason)
        return [self._parameters[one.name] for one in declared]

    @staticmethod
    def _default(name: str, given: Any, descriptor: Any) -> Any:
        """Note the declared type in the descriptor, and give the default value."""
        if isinstance(given, Parameter.Type):
            if given is Parameter.Type.NOT_SET:
                raise ValueError(
                    f'Cannot declare parameter {{{name}}} as statically typed of type NOT_SET')
            if descriptor.dynamic_typing:
                raise ValueError(
                    f'When declaring parameter {{{name}}} passing a descriptor with'
                    '`dynamic_typing=True` is not allowed when the parameter type is provided')
            descriptor.type = given.value
            return None
        if not descriptor.dynamic_typing:
            descriptor.type = given.type if isinstance(given, msg.ParameterValue) \
                else Parameter.Type.from_parameter_value(given).value
            if descriptor.type == Parameter.Type.NOT_SET.value:
                raise ValueError('Cannot declare a statically typed parameter with default value '
                                 'of type PARAMETER_NOT_SET')
        return given

    def undeclare_parameter(self, name: str) -> None:
        """
        Take a declaration back.

        :raises ParameterNotDeclaredException: if there is none.
        :raises ParameterImmutableException: if the parameter is read-only.
        """
        if name not in self._parameters:
            raise exceptions.ParameterNotDeclaredException(name)
        if self._descriptors[name].read_only:
            raise exceptions.ParameterImmutableException(name)
        del self._parameters[name]
        del self._descriptors[name]

    def has_parameter(self, name: str) -> bool:
        """Say whether a parameter is declared."""
        return name in self._parameters

    # --- reading ---

    def get_parameter_type(self, name: str) -> Any:
        """
        Give the number of a parameter's type (of ``rcl_interfaces.msg.ParameterType``).

        :raises ParameterNotDeclaredException: if it isn't declared, and has to be.
        """
        if name in self._parameters:
            return self._parameters[name].type_.value
        if self._allow_undeclared_parameters:
            return Parameter.Type.NOT_SET.value
        raise exceptions.ParameterNotDeclaredException(name)

    def get_parameters(self, names: list[str]) -> list[Parameter]:
        """Give parameters; see :meth:`get_parameter`."""
        if not all(isinstance(name, str) for name in names):
            raise TypeError('All names must be instances of type str')
        return [self.get_parameter(name) for name in names]

    def get_parameter(self, name: str) -> Parameter:
        """
        Give a parameter.

        :raises ParameterNotDeclaredException: if it isn't declared, and has to be.
        :raises ParameterUninitializedException: if it has a type, and no value yet.
        """
        if name in self._parameters:
            parameter = self._parameters[name]
            if parameter.type_ is Parameter.Type.NOT_SET \
                    and not self._descriptors[name].dynamic_typing:
                raise exceptions.ParameterUninitializedException(name)
            return parameter
        if self._allow_undeclared_parameters:
            return Parameter(name, Parameter.Type.NOT_SET, None)
        raise exceptions.ParameterNotDeclaredException(name)

    def get_parameter_or(self, name: str,
                         alternative_value: Parameter | None = None) -> Parameter:
        """Give a parameter, or the alternative if it isn't declared or has no value."""
        parameter = self._parameters.get(name)
        if parameter is None or parameter.type_ is Parameter.Type.NOT_SET:
            return alternative_value if alternative_value is not None \
                else Parameter(name, Parameter.Type.NOT_SET)
        return parameter

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Parameter]:
        """Give the parameters below a prefix, by their names without it."""
        prefix = prefix + PARAMETER_SEPARATOR_STRING if prefix else ''
        return {name[len(prefix):]: parameter for name, parameter in self._parameters.items()
                if name.startswith(prefix)}

    def list_parameters(self, prefixes: list[str], depth: int) -> Any:
        """
        List names and their prefixes (``rcl_interfaces.msg.ListParametersResult``).

        :param prefixes: only what is below one of these, or is one.
        :param depth: how many dots a name may have beyond; 0: any number.
        """
        if not isinstance(prefixes, list):
            raise TypeError('The prefixes argument must be a list')
        if not all(isinstance(prefix, str) for prefix in prefixes):
            raise TypeError('All prefixes must be instances of type str')
        if not isinstance(depth, int):
            raise TypeError('The depth must be instance of type int')
        if depth < 0:
            raise ValueError('The depth must be greater than or equal to zero')
        dot = PARAMETER_SEPARATOR_STRING

        def shallow(name: str) -> bool:
            return depth == 0 or name.count(dot) < depth

        result = msg.ListParametersResult()
        for name in self._parameters:
            if prefixes:
                wanted = any(name == prefix or name.startswith(prefix + dot)
                             and shallow(name[len(prefix) + 1:]) for prefix in prefixes)
            else:
                wanted = shallow(name)
            if wanted:
                result.names.append(name)
                above = name.rpartition(dot)[0]
                if above and above not in result.prefixes:
                    result.prefixes.append(above)
        return result

    # --- setting ---

    def set_parameters(self, parameter_list: list[Parameter]) -> list[Any]:
        """
        Set parameters one after the other.

        :returns: an ``rcl_interfaces.msg.SetParametersResult`` for each.
        :raises ParameterNotDeclaredException: if one isn't declared, and has to be; those
            before it have been set.
        """
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> Any:
        """
        Set all of the parameters or none.

        A value of type NOT_SET undeclares a parameter with dynamic type.

        :returns: ``rcl_interfaces.msg.SetParametersResult``.
        :raises ParameterNotDeclaredException: if one isn't declared, and has to be.
        """
        if self._pre_set_parameters_callbacks:
            parameter_list = [parameter for callback in self._pre_set_parameters_callbacks
                              for parameter in callback(parameter_list)]
            if not parameter_list:
                return _refused(
                    'parameter list cannot be empty, this might be due to '
                    'pre_set_parameters_callback modifying the original parameters list.')
        if not all(isinstance(parameter, Parameter) for parameter in parameter_list):
            raise TypeError(f"parameter must be instance of type '{Parameter!r}'")
        undeclared = [parameter.name for parameter in parameter_list
                      if parameter.name not in self._parameters]
        if undeclared and not self._allow_undeclared_parameters:
            raise exceptions.ParameterNotDeclaredException(undeclared)
        return self._set(parameter_list, None, keep_unset=False)

    def _set(self, parameters: list[Parameter], descriptors: dict[str, Any] | None,
             keep_unset: bool) -> Any:
        """
        Set parameters that may be undeclared yet.

        :param descriptors: new ones; None: the ones there are, and read-only holds.
        :param keep_unset: store what has no value instead of undeclaring it.
        """
        for parameter in parameters:
            known = self._descriptors if descriptors is None else descriptors
            if parameter.name in known:
                result = self._check(parameter, known[parameter.name], descriptors is None)
                if not result.successful:
                    return result
        for callback in self._on_set_parameters_callbacks:
            result = callback(parameters)
            if not result.successful:
                return result
        event = msg.ParameterEvent()
        for parameter in parameters:
            message = parameter.to_parameter_msg()
            if parameter.type_ is Parameter.Type.NOT_SET and not keep_unset:
                event.deleted_parameters.append(message)
                self._parameters.pop(parameter.name, None)
                self._descriptors.pop(parameter.name, None)
                continue
            if descriptors is not None:
                self._descriptors[parameter.name] = descriptors[parameter.name]
            elif parameter.name not in self._descriptors:
                self._descriptors[parameter.name] = msg.ParameterDescriptor(
                    name=parameter.name, dynamic_typing=True)
            before = self.get_parameter_or(parameter.name).type_
            (event.new_parameters if before is Parameter.Type.NOT_SET
             else event.changed_parameters).append(message)
            self._parameters[parameter.name] = parameter
        self._publish_parameter_event(event)
        for callback in self._post_set_parameters_callbacks:
            callback(parameters)
        return msg.SetParametersResult(successful=True)

    def _check(self, parameter: Parameter, descriptor: Any, check_read_only: bool) -> Any:
        """Say whether a descriptor allows a value."""
        descriptor.name = parameter.name
        unset = parameter.type_ is Parameter.Type.NOT_SET
        if check_read_only and descriptor.read_only:
            return _refused(f'Trying to set a read-only parameter: {parameter.name}.')
        if descriptor.dynamic_typing:
            descriptor.type = parameter.type_.value
        elif unset and parameter.name in self._parameters:
            return _refused('Static parameter cannot be undeclared')
        elif not unset and parameter.type_.value != descriptor.type:
            return _refused(f"Wrong parameter type, expected '{Parameter.Type(descriptor.type)}' "
                            f"got '{parameter.type_}'")
        if parameter.type_ is Parameter.Type.INTEGER and descriptor.integer_range:
            return self._check_range(parameter, descriptor.integer_range[0])
        if parameter.type_ is Parameter.Type.DOUBLE and descriptor.floating_point_range:
            return self._check_range(parameter, descriptor.floating_point_range[0])
        return msg.SetParametersResult(successful=True)

    def _check_range(self, parameter: Parameter, limits: Any) -> Any:
        low = min(limits.from_value, limits.to_value)
        high = max(limits.from_value, limits.to_value)
        value, step = parameter.value, limits.step
        exact = parameter.type_ is Parameter.Type.INTEGER

        def equal(one: float, other: float) -> bool:
            return one == other if exact else math.isclose(one, other, rel_tol=self.PARAM_REL_TOL)

        if equal(value, low) or equal(value, high):
            return msg.SetParametersResult(successful=True)
        about = f'in: {low}, Max: {high}, value: {value}'
        if not low < value < high:
            return _refused(f'Parameter {parameter.name} out of range{"." if exact else ""} '
                            f'M{about}')
        if step and not equal(low + round((value - low) / step) * step, value):
            close = 'a valid step' if exact else 'close enough to a valid step'
            return _refused(f'The parameter value for {parameter.name} is not {close}. Min: {low},'
                            f' max: {high}, value: {value}, step: {step}')
        return msg.SetParametersResult(successful=True)

    # --- descriptors ---

    def describe_parameter(self, name: str) -> Any:
        """
        Give a parameter's descriptor.

        :raises ParameterNotDeclaredException: if it isn't declared, and has to be.
        """
        if name in self._descriptors:
            return self._descriptors[name]
        if self._allow_undeclared_parameters:
            return msg.ParameterDescriptor()
        raise exceptions.ParameterNotDeclaredException(name)

    # --- callbacks ---

    def add_pre_set_parameters_callback(self, callback: Callback) -> None:
        """Let this replace the list of parameters before it is checked."""
        self._pre_set_parameters_callbacks.insert(0, callback)

    def add_on_set_parameters_callback(self, callback: Callback) -> None:
        """Ask this (for a SetParametersResult) before parameters are set."""
        self._on_set_parameters_callbacks.insert(0, callback)

    def add_post_set_parameters_callback(self, callback: Callback) -> None:
        """Tell this which parameters have been set."""
        self._post_set_parameters_callbacks.insert(0, callback)

    def remove_pre_set_parameters_callback(self, callback: Callback) -> None:
        """Take a callback back."""
        self._pre_set_parameters_callbacks.remove(callback)

    def remove_on_set_parameters_callback(self, callback: Callback) -> None:
        """Take a callback back."""
        self._on_set_parameters_callbacks.remove(callback)

    def remove_post_set_parameters_callback(self, callback: Callback) -> None:
        """Take a callback back."""
        self._post_set_parameters_callbacks.remove(callback)

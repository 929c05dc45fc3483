# SPDX-License-Identifier: Apache-2.0
"""What rclpy raises."""

from functools import partialmethod
from typing import Any


class RCLError(RuntimeError):
    """A call into the middleware failed."""


class RCLInvalidROSArgsError(RCLError):
    """The arguments after ``--ros-args`` can't be understood."""


class UnknownROSArgsError(RuntimeError):
    """There are arguments after ``--ros-args`` that nobody knows."""


class InvalidHandle(Exception):
    """Something is used after it was destroyed."""


class NodeNameNonExistentError(RCLError):
    """No node of that name was found."""


class UnsupportedEventTypeError(RCLError):
    """The middleware doesn't have that event."""


class NotInitializedException(Exception):
    """rclpy was used before ``rclpy.init()``."""

    def __init__(self, message: str | None = None) -> None:
        text = 'rclpy.init() has not been called.'
        super().__init__(f'{text} msg:{message}' if message else text)


class NoTypeSupportImportedException(Exception):
    """The given class is no interface."""

    def __init__(self) -> None:
        super().__init__('no type_support imported')


class NameValidationException(Exception):
    """A name is invalid; the message points at the place."""

    def __init__(self, name_type: str, name: str, error_msg: str, invalid_index: int) -> None:
        super().__init__(
            f"Invalid {name_type}: {error_msg}:\n  '{name}'\n   {' ' * invalid_index}^")


class InvalidNamespaceException(NameValidationException):
    """A namespace is invalid."""

    __init__ = partialmethod(NameValidationException.__init__, 'namespace')


class InvalidNodeNameException(NameValidationException):
    """A node's name is invalid."""

    __init__ = partialmethod(NameValidationException.__init__, 'node name')


class InvalidTopicNameException(NameValidationException):
    """A topic's name is invalid."""

    __init__ = partialmethod(NameValidationException.__init__, 'topic name')


class InvalidServiceNameException(NameValidationException):
    """A service's name is invalid."""

    __init__ = partialmethod(NameValidationException.__init__, 'service name')


class ParameterException(Exception):
    """The base of what goes wrong with parameters."""

    def __init__(self, error_msg: str, parameters: str | list[str]) -> None:
        super().__init__(f'{error_msg}: {parameters}')


class ParameterNotDeclaredException(ParameterException):
    """A parameter was used that nobody declared."""

    __init__ = partialmethod(
        ParameterException.__init__, 'Invalid access to undeclared parameter(s)')


class ParameterAlreadyDeclaredException(ParameterException):
    """A parameter was declared twice."""

    __init__ = partialmethod(ParameterException.__init__, 'Parameter(s) already declared')


class InvalidParameterException(ParameterException):
    """A parameter's name is invalid."""

    __init__ = partialmethod(ParameterException.__init__, 'Invalid parameter name')


class InvalidParameterTypeException(ParameterException):
    """A parameter's type is not the declared one."""

    def __init__(self, desired_parameter: Any, expected_type: Any) -> None:
        super().__init__(
            f"Trying to set parameter '{desired_parameter.name}' to '{desired_parameter.value}' "
            f"of type '{desired_parameter.type_.name}', expecting type '{expected_type}'",
            desired_parameter.name)


class InvalidParameterValueException(ParameterException):
    """A callback or a descriptor refused a parameter's value."""

    def __init__(self, parameter: str, value: Any, reason: str) -> None:
        super().__init__(
            f'Invalid parameter value ({value}) for parameter. Reason: {reason}', parameter)


class ParameterImmutableException(ParameterException):
    """A read-only parameter was to be changed."""

    __init__ = partialmethod(
        ParameterException.__init__, 'Attempted to modify read-only parameter')


class ParameterUninitializedException(ParameterException):
    """A parameter has been declared, and has no value yet."""

    def __init__(self, parameter_name: str) -> None:
        super().__init__(f"The parameter '{parameter_name}' is not initialized", parameter_name)


class ROSInterruptException(Exception):
    """Waiting ended because of ``rclpy.shutdown()``."""

    def __init__(self) -> None:
        super().__init__('rclpy.shutdown() has been called')

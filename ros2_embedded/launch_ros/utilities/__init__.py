# SPDX-License-Identifier: Apache-2.0
"""Helpers that launch_ros shares with those who extend it."""
from .names import *  # noqa: F403
from .parameters import evaluate_parameter_dict as evaluate_parameters_dict  # noqa: F401
from .parameters import evaluate_parameters as evaluate_parameters
from .parameters import normalize_parameter_dict as normalize_parameters_dict  # noqa: F401
from .parameters import normalize_parameters as normalize_parameters
from .parameters import to_parameters_list as to_parameters_list

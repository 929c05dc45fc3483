# SPDX-License-Identifier: Apache-2.0
"""Helpers that launch_ros shares with those who extend it."""
from .names import make_namespace_absolute as make_namespace_absolute
from .names import normalize_remap_rule as normalize_remap_rule
from .names import normalize_remap_rules as normalize_remap_rules
from .names import prefix_namespace as prefix_namespace
from .parameters import evaluate_parameters as evaluate_parameters
from .parameters import normalize_parameters as normalize_parameters
from .parameters import to_parameters_list as to_parameters_list

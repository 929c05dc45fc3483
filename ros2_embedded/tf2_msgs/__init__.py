# SPDX-License-Identifier: Apache-2.0
from rosidl_embedded import lacking  # noqa: F401 - refuses the actions by name

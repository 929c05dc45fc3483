# SPDX-License-Identifier: Apache-2.0
"""What commands and verbs call."""

# SPDX-License-Identifier: Apache-2.0
"""The logic of the verbs, without parsing and printing."""

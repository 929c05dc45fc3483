# SPDX-License-Identifier: Apache-2.0
"""What the verbs do, without parsing or printing."""

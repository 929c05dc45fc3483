# SPDX-License-Identifier: Apache-2.0
"""The launch extension; the names meant for launch files are those of :mod:`fogros2`."""

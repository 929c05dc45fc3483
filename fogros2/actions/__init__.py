# SPDX-License-Identifier: Apache-2.0
"""Extend launch with machines; launch files import the public names from :mod:`fogros2`."""

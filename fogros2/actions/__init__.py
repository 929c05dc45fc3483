# SPDX-License-Identifier: Apache-2.0
"""
The actions of launch files; these import the public names from :mod:`fogros2`.

In reading order: ``fog_machine`` describes a machine, ``nodes`` and ``cloud_group`` run nodes on
machines, ``launch_description`` knows all machines of a launch, ``override`` runs machines
elsewhere, and ``frontend`` reads XML and YAML.
"""

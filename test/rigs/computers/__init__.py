# SPDX-License-Identifier: Apache-2.0
"""
Computers for simulated clouds: containers that boot, in a network that leads nowhere.

In reading order: ``netns`` and ``network``, ``cloud_config`` (user data), ``guest`` (an instance's
first process), ``computer``, ``cloud`` (the lives of instances), ``server`` (the process behind a
box), ``box`` (what a test holds). ``rigs.ec2`` and ``rigs.gce`` are APIs in front of them.
"""

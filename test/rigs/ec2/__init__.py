# SPDX-License-Identifier: Apache-2.0
"""
EC2 in a box, for tests of what uses EC2: see :class:`Ec2Box`.

``box`` is what a test holds; ``server`` the process behind it, which has Moto (``api``, ``rules``,
``market``, ``hooks``) in front of ``rigs.computers`` (``cloud``, ``metadata``). ``iam``
has the policy that ``doc/aws.md`` gives to robots.
"""

from rigs.ec2.box import Call, Ec2Box, Instance

__all__ = ['Call', 'Ec2Box', 'Instance']

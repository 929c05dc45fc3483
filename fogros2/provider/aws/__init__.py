# SPDX-License-Identifier: Apache-2.0
"""
EC2 instances, by boto3.

In reading order: ``login``, ``options``, ``failures`` (AWS's refusals), ``clients`` (calls),
``instances``, ``network``, ``disks``, ``prices``, ``images``, ``cloud`` (the adapter),
``provider``.
"""

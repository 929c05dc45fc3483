# SPDX-License-Identifier: Apache-2.0
"""
Prices of machines, and machines of the cloud with the cheapest offer.

In reading order: ``offers`` (requirements, and types with prices that meet them), ``market``
(types and prices of one cloud, kept on disk), ``clouds`` (the offers of all clouds), ``provider``
and ``machine`` (a machine of any cloud), ``choices`` (of launch files), ``verbs``.
"""

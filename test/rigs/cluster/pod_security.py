# SPDX-License-Identifier: Apache-2.0
"""
What may keep a pod from having NET_ADMIN.

Kubernetes 1.20 has PodSecurityPolicy in its API server: a namespace's service account may use the
policy ``ALL``, or only one that allows no capability.
"""

from __future__ import annotations

from typing import Any

from rigs.cluster.client import Client

#: Names of policies, and of cluster roles that let them be used.
ALL, NO_CAPABILITIES = 'all', 'no-capabilities'


def make_policies(client: Client) -> None:
    """Make the policies, without which no pod would be admitted."""
    anyone: dict[str, Any] = {'rule': 'RunAsAny'}
    rules = {'volumes': ['*'], 'runAsUser': anyone, 'seLinux': anyone, 'fsGroup': anyone,
             'supplementalGroups': anyone}
    rights = '/apis/rbac.authorization.k8s.io/v1'
    for name, more in ((ALL, {'privileged': True, 'allowedCapabilities': ['*']}),
                       (NO_CAPABILITIES, {})):
        client.create('/apis/policy/v1beta1/podsecuritypolicies',
                      'policy/v1beta1 PodSecurityPolicy', name, spec={**rules, **more})
        client.create(f'{rights}/clusterroles', 'rbac.authorization.k8s.io/v1 ClusterRole', name,
                      rules=[{'apiGroups': ['policy'], 'resources': ['podsecuritypolicies'],
                              'verbs': ['use'], 'resourceNames': [name]}])

# SPDX-License-Identifier: Apache-2.0
"""
A real Kubernetes cluster of one node on this computer, for tests of pods as machines.

``tools/kubernetes.sh`` builds its programs from Debian's source package; ``images`` makes what its
pods run; ``cluster`` runs it. All its processes, mounts, bridges and firewall rules are in
namespaces of their own and end with them, see ``node``; ``services`` says what it consists of.
"""

from rigs.cluster.client import Client, Refused
from rigs.cluster.cluster import Cluster, cluster, running_cluster
from rigs.cluster.images import APPLICATION, BARE, DEFAULT, READY
from rigs.cluster.node_process import ClusterError

__all__ = ['APPLICATION', 'BARE', 'Client', 'Cluster', 'ClusterError', 'DEFAULT', 'READY',
           'Refused', 'cluster', 'running_cluster']

# SPDX-License-Identifier: Apache-2.0
"""
What a single-node cluster consists of: command lines and configuration files, by value.

Flags are those of Kubernetes 1.20 and containerd 1.6. All paths are those of the node's own mount
namespace (see ``node``): its folder is ``/run/fog`` there, and nothing of the computer's own
``/run``, ``/var/lib`` and ``/var/log`` is seen.
"""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import json
from typing import Any

HERE = '/run/fog'
CONTAINERD_SOCKET = '/run/containerd/containerd.sock'
NODE = 'fog-node'
API_PORT = 6443
#: Feature gate that 1.20 still needs for ttlSecondsAfterFinished.
_GATES = '--feature-gates=TTLAfterFinished=true'


@dataclasses.dataclass(frozen=True)
class Layout:
    """
    Addresses of one cluster.

    :param node: the node's, which the computer reaches by a cable of its own.
    :param host: the computer's end of that cable.
    :param prefix: length of their network's prefix.
    :param pods: range of the pods, CIDR; only the node knows it.
    :param services: range of services, CIDR; only the node knows it.
    """

    node: str
    host: str
    prefix: int
    pods: str = '10.244.0.0/24'
    services: str = '10.96.0.0/16'

    @property
    def server(self) -> str:
        """Return the API server's URL."""
        return f'https://{self.node}:{API_PORT}'


#: Of a node that nobody reaches.
NOWHERE = Layout('127.0.0.1', '127.0.0.1', 32)


def files(layout: Layout, sandbox_image: str, cgroup: str) -> dict[str, str]:
    """
    Return the configuration files of all services: name below the folder, contents.

    :param cgroup: name of the control group that pods run in.
    """
    return {
        'containerd.toml': containerd(sandbox_image),
        'cni/10-bridge.conflist': _json(network(layout)),
        'kubelet.json': _json(kubelet(cgroup)),
        'audit.json': _json(audit()),
        'resolv.conf': '',
    }


def commands(layout: Layout) -> dict[str, list[str]]:
    """Return the command line of each service, in the order they are started."""
    kubernetes = {
        'kube-apiserver': [
            '--etcd-servers=http://127.0.0.1:2379',
            f'--advertise-address={layout.node}', '--bind-address=0.0.0.0',
            '--kubelet-preferred-address-types=InternalIP',
            f'--secure-port={API_PORT}', f'--service-cluster-ip-range={layout.services}',
            f'--tls-cert-file={HERE}/tls.crt', f'--tls-private-key-file={HERE}/tls.key',
            f'--kubelet-certificate-authority={HERE}/tls.crt',
            f'--kubelet-client-certificate={HERE}/tls.crt',
            f'--kubelet-client-key={HERE}/tls.key',
            '--service-account-issuer=https://kubernetes.default.svc',
            f'--service-account-signing-key-file={HERE}/tls.key',
            f'--service-account-key-file={HERE}/tls.key',
            f'--token-auth-file={HERE}/tokens.csv', '--anonymous-auth=false',
            '--authorization-mode=Node,RBAC',
            '--enable-admission-plugins=NodeRestriction',
            '--allow-privileged=true', _GATES, '--profiling=false',
            f'--audit-policy-file={HERE}/audit.json', f'--audit-log-path={HERE}/log/audit.json',
        ],
        'kube-controller-manager': [
            f'--kubeconfig={HERE}/cluster.conf', '--leader-elect=false', '--port=0',
            f'--service-account-private-key-file={HERE}/tls.key',
            f'--root-ca-file={HERE}/tls.crt', f'--flex-volume-plugin-dir={HERE}/plugins',
            '--kube-api-qps=100', '--kube-api-burst=200', '--node-monitor-period=500ms', _GATES,
        ],
        'kube-scheduler': [
            f'--kubeconfig={HERE}/cluster.conf', '--leader-elect=false', '--port=0',
            '--kube-api-qps=100', '--kube-api-burst=200',
        ],
        'kubelet': [
            f'--config={HERE}/kubelet.json', f'--kubeconfig={HERE}/node.conf',
            '--container-runtime=remote',
            f'--container-runtime-endpoint=unix://{CONTAINERD_SOCKET}',
            f'--node-ip={layout.node}', f'--hostname-override={NODE}',
            f'--volume-plugin-dir={HERE}/plugins', f'--cert-dir={HERE}/kubelet-certificates',
        ],
        'kube-proxy': [
            f'--kubeconfig={HERE}/cluster.conf', f'--hostname-override={NODE}',
            f'--bind-address={layout.node}', f'--cluster-cidr={layout.pods}',
            # only the first network namespace may write these
            '--conntrack-max-per-core=0', '--conntrack-tcp-timeout-established=0',
            '--conntrack-tcp-timeout-close-wait=0', '--oom-score-adj=0',
            # one service gets its rules at once; of many, each would have all written anew
            '--iptables-min-sync-period=500ms',
        ],
    }
    return {
        'containerd': ['containerd', '--config', f'{HERE}/containerd.toml'],
        'etcd': [
            'etcd', '--data-dir=/run/etcd', '--listen-client-urls=http://127.0.0.1:2379',
            '--advertise-client-urls=http://127.0.0.1:2379',
            '--listen-peer-urls=http://127.0.0.1:2380', '--log-level=warn', '--logger=zap'],
        **{name: [f'{HERE}/bin/{name}', '--v=1', *flags]
           for name, flags in kubernetes.items()},
    }


def containerd(sandbox_image: str) -> str:
    """Return containerd's configuration."""
    return f"""\
version = 2
root = "{HERE}/containerd"
state = "/run/containerd"
oom_score = 0
disabled_plugins = [
  "io.containerd.snapshotter.v1.aufs", "io.containerd.snapshotter.v1.btrfs",
  "io.containerd.snapshotter.v1.devmapper", "io.containerd.snapshotter.v1.zfs"]
[grpc]
  address = "{CONTAINERD_SOCKET}"
[plugins."io.containerd.internal.v1.opt"]
  path = "{HERE}/opt"
[plugins."io.containerd.grpc.v1.cri"]
  sandbox_image = "{sandbox_image}"
  # lowering it takes CAP_SYS_RESOURCE
  restrict_oom_score_adj = true
  stream_server_address = "127.0.0.1"
  [plugins."io.containerd.grpc.v1.cri".containerd]
    snapshotter = "overlayfs"
  [plugins."io.containerd.grpc.v1.cri".cni]
    bin_dir = "/usr/lib/cni"
    conf_dir = "{HERE}/cni"
"""


def network(layout: Layout) -> dict[str, Any]:
    """
    Return the pods' network: a bridge.

    That what leaves it gets the node's address is one rule of the node's: the plugin would add
    several for each pod, at more processor time than the rest of a pod's network takes.
    """
    return {
        'cniVersion': '0.4.0', 'name': 'pods', 'plugins': [
            {'type': 'bridge', 'bridge': 'pods', 'isDefaultGateway': True, 'hairpinMode': True,
             'ipam': {'type': 'host-local', 'ranges': [[{'subnet': layout.pods}]]}}]}


def kubelet(cgroup: str) -> dict[str, Any]:
    """Return the kubelet's configuration."""
    never = dict.fromkeys((
        'memory.available', 'nodefs.available', 'nodefs.inodesFree', 'imagefs.available'), '0%')
    return {
        'kind': 'KubeletConfiguration', 'apiVersion': 'kubelet.config.k8s.io/v1beta1',
        'authentication': {
            'anonymous': {'enabled': False}, 'webhook': {'enabled': False},
            'x509': {'clientCAFile': f'{HERE}/tls.crt'}},
        'authorization': {'mode': 'AlwaysAllow'},
        'tlsCertFile': f'{HERE}/tls.crt', 'tlsPrivateKeyFile': f'{HERE}/tls.key',
        'cgroupDriver': 'cgroupfs', 'cgroupRoot': f'/{cgroup}', 'enforceNodeAllocatable': [],
        'oomScoreAdj': 0, 'failSwapOn': False, 'makeIPTablesUtilChains': False,
        'resolvConf': f'{HERE}/resolv.conf', 'clusterDomain': '', 'readOnlyPort': 0,
        # the computer's disk may be as full as it likes, and images come from a file
        'evictionHard': never, 'imageGCHighThresholdPercent': 100,
        'serializeImagePulls': False, 'registryPullQPS': 0, 'eventRecordQPS': 0,
        'kubeAPIQPS': 100, 'kubeAPIBurst': 200, 'volumeStatsAggPeriod': '-1s',
        # pods may run as soon as all is ready, not some seconds later
        'nodeStatusUpdateFrequency': '1s',
    }


def audit() -> dict[str, Any]:
    """Return the API server's audit policy: one line for each request of a user."""
    return {
        'apiVersion': 'audit.k8s.io/v1', 'kind': 'Policy', 'omitStages': ['ResponseStarted'],
        'rules': [
            {'level': 'None', 'userGroups': ['system:nodes']},
            {'level': 'None', 'users': ['system:apiserver', 'cluster']},
            {'level': 'Metadata'}]}


def kubeconfig(
    server: str, authority: str, user: str, token: str, namespace: str = 'default',
) -> str:
    """
    Return a kubeconfig file as JSON, which is YAML as well.

    :param authority: certificate that signed the server's, PEM in base64.
    """
    name = 'fogros2-test'
    return _json({
        'apiVersion': 'v1', 'kind': 'Config', 'current-context': name,
        'clusters': [{'name': name, 'cluster': {
            'server': server, 'certificate-authority-data': authority}}],
        'users': [{'name': user, 'user': {'token': token}}],
        'contexts': [{'name': name, 'context': {
            'cluster': name, 'user': user, 'namespace': namespace}}],
    })


def tokens(users: Mapping[str, tuple[str, tuple[str, ...]]]) -> str:
    """Return the API server's list of users: name -> token, groups."""
    return ''.join(
        f'{token},{user},{number}' + (f',"{",".join(groups)}"\n' if groups else '\n')
        for number, (user, (token, groups)) in enumerate(users.items()))


def _json(data: object) -> str:
    return json.dumps(data, indent=1) + '\n'

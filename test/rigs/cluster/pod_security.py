# SPDX-License-Identifier: Apache-2.0
"""
What may keep a pod from having NET_ADMIN.

Kubernetes 1.20 has PodSecurityPolicy in its API server: a namespace's service account may use the
policy ``ALL``, or only one that allows no capability. From 1.25 on there is Pod Security admission
instead; its level "baseline" is played here by an admission webhook, in the words of the newer
ones, as how we take the refusal is what is tested.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
import contextlib
import http.server
import json
from pathlib import Path
import ssl
import tempfile
import threading
from typing import Any

from rigs.cluster.certificates import Authority
from rigs.cluster.client import Client

#: What baseline lets a container add (Kubernetes: Pod Security Standards).
ALLOWED = {'AUDIT_WRITE', 'CHOWN', 'DAC_OVERRIDE', 'FOWNER', 'FSETID', 'KILL', 'MKNOD',
           'NET_BIND_SERVICE', 'SETFCAP', 'SETGID', 'SETPCAP', 'SETUID', 'SYS_CHROOT'}
LABEL = 'pod-security.kubernetes.io/enforce'
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


def verdict(pod: dict[str, Any]) -> str:
    """Return why a pod is refused, '' if it isn't."""
    for container in pod['spec']['containers']:
        added = container.get('securityContext', {}).get('capabilities', {}).get('add', [])
        if set(added) - ALLOWED:
            names = ', '.join(f'"{name}"' for name in added)
            return ('violates PodSecurity "baseline:latest": non-default capabilities (container '
                    f'"{container["name"]}" must not include {names} in '
                    'securityContext.capabilities.add)')
    return ''


class _Handler(http.server.BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        """Answer an AdmissionReview."""
        review = json.loads(self.rfile.read(int(self.headers['Content-Length'])))
        why = verdict(review['request']['object'])
        answer = {'apiVersion': 'admission.k8s.io/v1', 'kind': 'AdmissionReview', 'response': {
            'uid': review['request']['uid'], 'allowed': not why,
            'status': {'code': 403, 'message': why}}}
        body = json.dumps(answer).encode()
        self.send_response(200)
        self.send_header('Content-Type', 'application/json')
        self.send_header('Content-Length', str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@contextlib.contextmanager
def pod_security(host: str, client: Client) -> Iterator[None]:
    """
    Enforce the level in namespaces that carry its label, for the time of the block.

    :param host: this computer's address, as the node sees it.
    """
    authority = Authority('pod security')
    pair = authority.issue('pod-security', [host])
    server = http.server.ThreadingHTTPServer((host, 0), _Handler)
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'pair.pem')
        path.write_bytes(pair.certificate + pair.key)
        tls.load_cert_chain(path)
    server.socket = tls.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    path_of = '/apis/admissionregistration.k8s.io/v1/validatingwebhookconfigurations'
    try:
        client.create(
            path_of, 'admissionregistration.k8s.io/v1 ValidatingWebhookConfiguration',
            'pod-security', webhooks=[{
                'name': 'pod-security.fogros2.test', 'sideEffects': 'None',
                'admissionReviewVersions': ['v1'], 'failurePolicy': 'Fail',
                'namespaceSelector': {'matchLabels': {LABEL: 'baseline'}},
                'rules': [{'operations': ['CREATE'], 'apiGroups': [''], 'apiVersions': ['v1'],
                           'resources': ['pods']}],
                'clientConfig': {
                    'url': f'https://{host}:{server.server_port}/',
                    'caBundle': base64.b64encode(authority.certificate).decode()}}])
        yield
    finally:
        client.ask('DELETE', f'{path_of}/pod-security')
        server.shutdown()
        server.server_close()
        thread.join(60.0)

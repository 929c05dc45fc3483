# SPDX-License-Identifier: Apache-2.0
"""
Microsoft's command line ``az`` beside the simulated Azure, in a network namespace of its own.

``az`` takes an endpoint for a cloud with https only, and it signs in before anything else. So the
service is behind TLS here, with the authority's own certificate, and with the parts of Azure that
``az`` asks besides Resource Manager: the list of endpoints, OpenID Connect, and subscriptions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import contextlib
import datetime
import json
import os
from pathlib import Path
import ssl
import subprocess
from typing import Any
from urllib.parse import parse_qs

from rigs import isolated
from rigs.azure.service import Service, SUBSCRIPTION, TOKEN

#: The service principal that signs in, and its secret.
CLIENT, SECRET = 'c0ffee00-0000-4000-8000-000000000001', 'secret-of-the-service-principal'
#: An authority of this kind is asked itself whether it exists, not Microsoft's.
AUTHORITY = 'adfs'
_PORT = 8443


class Front:
    """The WSGI application: what ``az`` asks before it asks Resource Manager."""

    def __init__(self, service: Service) -> None:
        self.service = service

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        """Answer a request."""
        url = f'https://{environ["HTTP_HOST"]}'
        authority = f'{url}/{AUTHORITY}'
        form = {}
        if environ['PATH_INFO'] == f'/{AUTHORITY}/oauth2/token':
            size = int(environ.get('CONTENT_LENGTH') or 0)
            form = parse_qs(environ['wsgi.input'].read(size).decode())
        status, answer = '200 OK', {
            '/metadata/endpoints': {
                'galleryEndpoint': url, 'graphEndpoint': url, 'portalEndpoint': url,
                'authentication': {'loginEndpoint': authority, 'audiences': [url]}},
            f'/{AUTHORITY}/.well-known/openid-configuration': {
                'issuer': authority, 'token_endpoint': f'{authority}/oauth2/token',
                'authorization_endpoint': f'{authority}/oauth2/authorize'},
            f'/{AUTHORITY}/oauth2/token': {
                'access_token': TOKEN, 'token_type': 'Bearer', 'expires_in': 3600},
            '/subscriptions': {'value': [{
                'id': f'/subscriptions/{SUBSCRIPTION}', 'subscriptionId': SUBSCRIPTION,
                'displayName': 'Robots', 'state': 'Enabled'}]},
        }.get(environ['PATH_INFO'])
        if answer is None:
            return self.service(environ, start_response)
        if form and (form.get('client_id'), form.get('client_secret')) != ([CLIENT], [SECRET]):
            status, answer = '401 Unauthorized', {'error': 'invalid_client'}
        if environ['PATH_INFO'] == '/subscriptions' \
                and environ.get('HTTP_AUTHORIZATION') != f'Bearer {TOKEN}':
            status, answer = '401 Unauthorized', {
                'error': {'code': 'AuthenticationFailed', 'message': 'Authentication failed.'}}
        data = json.dumps(answer).encode()
        start_response(status, [('Content-Type', 'application/json'),
                                ('Content-Length', str(len(data)))])
        return [data]


class Az:
    """``az`` with the box as its cloud."""

    def __init__(self, prefix: list[str], folder: Path) -> None:
        self._prefix = prefix
        self._environment = {
            'PATH': os.environ['PATH'], 'HOME': str(folder), 'LANG': 'C.UTF-8',
            'AZURE_CONFIG_DIR': str(folder / 'az'), 'AZURE_CORE_COLLECT_TELEMETRY': '0',
            'AZURE_CORE_NO_COLOR': '1', 'AZURE_CORE_ONLY_SHOW_ERRORS': '1',
            'REQUESTS_CA_BUNDLE': str(folder / 'certificate.pem')}

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a command and return what it printed."""
        return subprocess.run([*self._prefix, 'az', *words, '--output', 'json'],
                              env=self._environment, text=True, capture_output=True, timeout=400.0)

    def ask(self, *words: str) -> Any:
        """
        Run a command and return its answer's JSON, None if there is none.

        :raises AssertionError: it fails.
        """
        done = self.run(*words)
        assert done.returncode == 0, f'az {" ".join(words)}: {done.stderr}'
        return json.loads(done.stdout) if done.stdout.strip() else None

    def log_in(self) -> None:
        """Make the box the cloud of ``az``, and sign in as a service principal."""
        url = f'https://localhost:{_PORT}'
        self.run('cloud', 'register', '--name', 'Box', '--profile', '2020-09-01-hybrid',
                 '--endpoint-resource-manager', url, '--endpoint-active-directory',
                 f'{url}/{AUTHORITY}', '--endpoint-active-directory-resource-id', url)
        self.run('cloud', 'set', '--name', 'Box')
        found = self.ask('login', '--service-principal', '--username', CLIENT, '--password',
                         SECRET, '--tenant', SUBSCRIPTION)
        assert [one['id'] for one in found] == [SUBSCRIPTION]


@contextlib.contextmanager
def serve(service: Service, folder: Path) -> Iterator[Az]:
    """
    Serve a simulated Azure for ``az``, which is signed in.

    :param folder: gets the certificate and the settings of ``az``.
    """
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(certificate(folder), folder / 'key.pem')
    with isolated.serve(Front(service), 'az', port=_PORT, tls=tls) as prefix:
        az = Az(prefix, folder)
        az.log_in()
        yield az


def certificate(folder: Path) -> Path:
    """Write a certificate for localhost that is its own authority, and its key."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.datetime.now(
        datetime.timezone.utc)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, 'localhost')])
    made = x509.CertificateBuilder(
        name, name, key.public_key(), x509.random_serial_number(),
        now - datetime.timedelta(hours=1), now + datetime.timedelta(days=1)).add_extension(
        x509.SubjectAlternativeName([x509.DNSName('localhost')]), critical=False).add_extension(
        x509.BasicConstraints(ca=True, path_length=None), critical=True).sign(
        key, hashes.SHA256())
    (folder / 'key.pem').write_bytes(key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption()))
    path = folder / 'certificate.pem'
    path.write_bytes(made.public_bytes(serialization.Encoding.PEM))
    return path

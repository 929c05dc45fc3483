# SPDX-License-Identifier: Apache-2.0
"""
Read the kubeconfig by the official client, which also gets and renews the credentials.

Only this module loads the client, and only when it is needed.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from fogros2 import store
from fogros2.errors import PrerequisiteError

#: Token, certificate and namespace of a pod that may use the API.
_IN_CLUSTER = Path('/var/run/secrets/kubernetes.io/serviceaccount')


def kubeconfig_files() -> list[Path]:
    """Return the existing files that the kubeconfig consists of."""
    names = os.environ.get('KUBECONFIG') or '~/.kube/config'
    paths = [Path(name).expanduser() for name in names.split(os.pathsep) if name]
    return [path for path in paths if path.is_file()]


def configured() -> bool:
    """Return whether a kubeconfig is named or exists, or this pod may use the API."""
    return bool(os.environ.get('KUBECONFIG') or kubeconfig_files()) or (
        _IN_CLUSTER / 'token').is_file()


def load(context: str) -> tuple[str, str, Any]:
    """
    Load a context; return its name, its namespace and a client of the SDK.

    :raises PrerequisiteError: no kubeconfig, no such context, or no valid credentials.
    """
    try:
        import kubernetes.client
        import kubernetes.config
    except ImportError as error:
        raise PrerequisiteError(
            f"Kubernetes' client for Python is missing: {error}",
            'python3 -m pip install kubernetes') from error
    import yaml
    config: Any = kubernetes.config
    if not kubeconfig_files():
        if not configured():
            raise PrerequisiteError(
                'there is no kubeconfig on this computer',
                "set KUBECONFIG, or get one: 'aws eks update-kubeconfig', "
                "'gcloud container clusters get-credentials', 'az aks get-credentials'")
        if not (_IN_CLUSTER / 'token').is_file():
            raise PrerequisiteError(
                f"KUBECONFIG names the kubeconfig '{os.environ['KUBECONFIG']}', and there is no "
                'such file', 'correct the path, or unset the variable')
        config.load_incluster_config()
        namespace = (_IN_CLUSTER / 'namespace').read_text().strip()
        client = kubernetes.client.ApiClient()
        _verify_as_kubectl(client)
        return '', namespace, client
    files = os.environ.get('KUBECONFIG') or str(Path('~/.kube/config').expanduser())
    try:
        contexts, active = config.list_kube_config_contexts(files)
        names = [str(each['name']) for each in contexts]
        name = context or str((active or {}).get('name', ''))
        if name not in names:
            raise PrerequisiteError(
                f"the kubeconfig has no context '{name}'", f"there are: {', '.join(names)}")
        entry = next(each for each in contexts if each['name'] == name)
        settings = type.__call__(kubernetes.client.Configuration)
        # The client writes the kubeconfig's certificates and keys to files: not in /tmp.
        config.load_kube_config(files, context=name, client_configuration=settings,
                                temp_file_path=str(store.process_folder()))
        # One connection for each of many machines that start at once.
        settings.connection_pool_maxsize = 64
        client = kubernetes.client.ApiClient(settings)
        _verify_as_kubectl(client)
        _check_plugin(str(entry['context'].get('user', '')), settings)
    except (config.ConfigException, yaml.YAMLError, OSError, ValueError, TypeError, KeyError,
            AttributeError) as error:
        raise PrerequisiteError(f"the kubeconfig {files} can't be used: {words(error)}",
                                '`kubectl config view` shows it') from error
    return name, str(entry['context'].get('namespace') or 'default'), client


def _verify_as_kubectl(client: Any) -> None:
    """
    Let a client accept certificates without key identifiers, such as those of EKS.

    Python 3.13 refuses them by ``VERIFY_X509_STRICT``, and kubectl does not. Everything else is
    verified as before.
    """
    import ssl

    from urllib3.util.ssl_ import create_urllib3_context
    tls = create_urllib3_context()
    if not client.configuration.verify_ssl or not tls.verify_flags & ssl.VERIFY_X509_STRICT:
        return
    tls.verify_flags &= ~ssl.VERIFY_X509_STRICT
    # Connections would load the files again, into the context that all of them share.
    pool = client.rest_client.pool_manager.connection_pool_kw
    authority, data, certificate, key = (
        pool.pop(name, None) for name in ('ca_certs', 'ca_cert_data', 'cert_file', 'key_file'))
    if authority or data:
        tls.load_verify_locations(authority, cadata=data)
    else:
        tls.load_default_certs()
    if certificate:
        tls.load_cert_chain(certificate, key)
    pool['ssl_context'] = tls


def _check_plugin(user: str, settings: Any) -> None:
    """
    Check that the kubeconfig's credential plugin returned credentials.

    Without credentials, the client continues anonymously, and the API refuses every request.

    :raises PrerequisiteError: the plugin returned no credentials.
    """
    if settings.auth_settings() or settings.cert_file:
        return
    import yaml
    texts = (yaml.safe_load(path.read_text()) or {} for path in kubeconfig_files())
    users = [each for text in texts for each in text.get('users') or ()]
    for each in users:
        plugin = (each.get('user') or {}).get('exec') if each.get('name') == user else None
        if plugin:
            raise PrerequisiteError(
                f"'{plugin.get('command')}', the login program of the kubeconfig for '{user}', "
                'returned no credentials', ' '.join(str(plugin.get('installHint') or '').split())
                or 'is it installed, and are you logged in? `kubectl get pods` asks the same')


def words(error: BaseException) -> str:
    """Return the innermost reason of a chain of the client's errors, as one line."""
    reason: object = getattr(error, 'reason', None) or error
    text = ' '.join(str(reason).split())
    # urllib3 puts the representation of its object before the reason.
    return text.rpartition('>: ')[2] or text or type(error).__name__

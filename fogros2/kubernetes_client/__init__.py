# SPDX-License-Identifier: Apache-2.0
"""
The client of a Kubernetes API server, for the shell and the provider of pods.

``configuration`` reads the kubeconfig, ``answers`` parses responses and errors, ``api`` sends
requests and watches objects.
"""

from fogros2.kubernetes_client.answers import ApiError, items, path, selector, Unreachable
from fogros2.kubernetes_client.api import Api, connect, DOUBT, existing
from fogros2.kubernetes_client.configuration import configured

__all__ = ['Api', 'ApiError', 'configured', 'connect', 'DOUBT', 'existing', 'items', 'path',
           'selector', 'Unreachable']

# SPDX-License-Identifier: Apache-2.0
"""
Convert Azure's refusals to FogErrors: one table from error codes to hints.

The codes are those of "Resolve common Azure deployment errors" and of "Error codes for VM
allocation failures" in Azure's documentation.
"""

from __future__ import annotations

from collections.abc import Mapping
import re
from typing import Any

from fogros2.errors import FogError, PrerequisiteError
from fogros2.provider.vm.failures import CodedError, Failure, one_line

_MORE = 'ask for more at Quotas in the Azure portal, or take another vm_size= or region'
_LOG_IN = 'az login, or new values of AZURE_CLIENT_ID and AZURE_CLIENT_SECRET'
_FAILURES = {
    **dict.fromkeys(('InvalidAuthenticationToken', 'ExpiredAuthenticationToken',
                     'InvalidAuthenticationTokenTenant', 'AuthenticationFailed',
                     'Unauthorized'), Failure(
        'Azure does not take these credentials', _LOG_IN, PrerequisiteError)),
    **dict.fromkeys(('SubscriptionNotFound', 'InvalidSubscriptionId'), Failure(
        'these credentials have no such subscription', 'az account list shows them; '
        'AZURE_SUBSCRIPTION_ID names one', PrerequisiteError)),
    **dict.fromkeys(('ReadOnlyDisabledSubscription', 'SubscriptionNotRegistered'), Failure(
        '', 'is the subscription active, and paid for?', PrerequisiteError)),
    'MissingSubscriptionRegistration': Failure(
        '', 'az provider register --namespace with the name above, once', PrerequisiteError),
    'RequestDisallowedByPolicy': Failure('', 'ask who has assigned the policy', denied=True),
    **dict.fromkeys(('AuthorizationFailed', 'LinkedAuthorizationFailed'), Failure(denied=True)),
    'SkuNotAvailable': Failure(
        '', 'try later, or give more sizes and regions: vm_sizes=, regions=', full='zone'),
    **dict.fromkeys(('AllocationFailed', 'ZonalAllocationFailed', 'SpotNotAvailable',
                     'OverconstrainedAllocationRequest',
                     'OverconstrainedZonalAllocationRequest'), Failure(
        'Azure has no free machine of this size here at the moment',
        'try later, or give more sizes and regions: vm_sizes=, regions=', full='zone')),
    'SpotPriceGreaterThanProvidedMaxPrice': Failure(
        'the spot price is above max_price= at the moment',
        'ros2 fog price --spot shows it; spot=False takes a machine on demand', full='zone'),
    **dict.fromkeys(('QuotaExceeded', 'PublicIPCountLimitReached', 'RegionalCoresQuotaExceeded',
                     'VirtualNetworkCountLimitReached', 'NetworkSecurityGroupCountLimitReached'),
                    Failure("the subscription's quota is used up", _MORE, full='region')),
    **dict.fromkeys(('ResourceNotFound', 'ResourceGroupNotFound', 'NotFound',
                     'ParentResourceNotFound'), Failure(gone=True)),
    **dict.fromkeys(('PlatformImageNotFound', 'ImageNotFound', 'GalleryImageNotFound'), Failure(
        'there is no such image in this region', 'leave image= out for Ubuntu 24.04')),
    'LocationNotAvailableForResourceType': Failure(
        '', 'another region=: ros2 fog regions shows them'),
    'ResourceGroupBeingDeleted': Failure(
        'Azure is still deleting the machine of this request', 'start the launch again',
        gone=True),
    'ScopeLocked': Failure('', 'remove the lock: az lock list'),
    **dict.fromkeys(('TooManyRequests', 'OperationNotAllowed'), Failure(
        '', 'try again in a minute')),
}


class AzureError(CodedError):
    """Azure refused; ``code`` is its error code."""

    TITLE = 'Azure'
    FAILURES = _FAILURES


def refusal(status: int, body: Any, what: str) -> FogError:
    """
    Return the error for a refusal.

    :param body: the answer's JSON, with the error of ARM or of a long-running operation.
    """
    error = body.get('error', body) if isinstance(body, Mapping) else {}
    if not isinstance(error, Mapping):
        error = {'message': error or ''}
    code, message = str(error.get('code', '')), one_line(error.get('message', ''))
    for part in error.get('details') or ():
        # the outer code of a failed operation says only that it failed
        if part.get('code') in _FAILURES and code not in _FAILURES:
            code, message = part['code'], one_line(part.get('message', ''))
    if code == 'OperationNotAllowed' and 'quota' in message.lower():
        code = 'QuotaExceeded'
    if AzureError.known(code).denied and code != 'RequestDisallowedByPolicy':
        action = re.search(r"perform action '([\w./]+)'", message)
        missing = action[1] if action else 'this'
        return AzureError(f'{what} failed: these credentials have no role that allows {missing}',
                          'doc/azure.md has the roles that FogROS2 needs', code=code)
    code = code or ('NotFound' if status == 404 else '')
    return AzureError.of(code, message or f'Azure answered with status {status}', what, status)

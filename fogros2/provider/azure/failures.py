# SPDX-License-Identifier: Apache-2.0
"""
Convert Azure's refusals to FogErrors: one table from error codes to hints.

The codes are those of "Resolve common Azure deployment errors" and of "Error codes for VM
allocation failures" in Azure's documentation.
"""

from __future__ import annotations

from collections.abc import Mapping
import re
from typing import Any, NamedTuple

from fogros2.errors import FogError, PrerequisiteError, ProviderError
from fogros2.provider.vm.cloud import CloudError

#: No capacity for this size here.
NO_ROOM = frozenset({
    'AllocationFailed', 'ZonalAllocationFailed', 'OverconstrainedAllocationRequest',
    'OverconstrainedZonalAllocationRequest', 'SkuNotAvailable', 'SpotNotAvailable',
    'BadRequestMaxPriceTooLow'})
#: The subscription's quota in this region is used up; another size or region may have some.
NO_QUOTA = frozenset({
    'QuotaExceeded', 'PublicIPCountLimitReached', 'VirtualNetworkCountLimitReached',
    'NetworkSecurityGroupCountLimitReached', 'RegionalCoresQuotaExceeded'})
GONE = frozenset({
    'ResourceNotFound', 'ResourceGroupNotFound', 'NotFound', 'ParentResourceNotFound',
    'ResourceGroupBeingDeleted'})
DENIED = frozenset({
    'AuthorizationFailed', 'LinkedAuthorizationFailed', 'RequestDisallowedByPolicy'})
_MORE = 'ask for more at Quotas in the Azure portal, or take another vm_size= or region'
_LOG_IN = 'az login, or new values of AZURE_CLIENT_ID and AZURE_CLIENT_SECRET'


class Failure(NamedTuple):
    """The meaning of a code: a reason ('' keeps Azure's own), a remedy, the kind of error."""

    reason: str
    hint: str
    kind: type[FogError] = ProviderError


_FAILURES = {
    **dict.fromkeys(('InvalidAuthenticationToken', 'ExpiredAuthenticationToken',
                     'InvalidAuthenticationTokenTenant', 'AuthenticationFailed'), Failure(
        'Azure does not take these credentials', _LOG_IN, PrerequisiteError)),
    **dict.fromkeys(('SubscriptionNotFound', 'InvalidSubscriptionId'), Failure(
        'these credentials have no such subscription', 'az account list shows them; '
        'AZURE_SUBSCRIPTION_ID names one', PrerequisiteError)),
    **dict.fromkeys(('ReadOnlyDisabledSubscription', 'SubscriptionNotRegistered'), Failure(
        '', 'is the subscription active, and paid for?', PrerequisiteError)),
    'MissingSubscriptionRegistration': Failure(
        '', 'az provider register --namespace with the name above, once', PrerequisiteError),
    'RequestDisallowedByPolicy': Failure('', 'ask who has assigned the policy'),
    'SkuNotAvailable': Failure(
        '', 'try later, or give more sizes and regions: vm_sizes=, regions='),
    **dict.fromkeys(NO_ROOM - {'SkuNotAvailable', 'BadRequestMaxPriceTooLow'}, Failure(
        'Azure has no free machine of this size here at the moment',
        'try later, or give more sizes and regions: vm_sizes=, regions=')),
    'BadRequestMaxPriceTooLow': Failure(
        'the spot price is above max_price= at the moment',
        'ros2 fog price --spot shows it; spot=False takes a machine on demand'),
    **dict.fromkeys(NO_QUOTA, Failure("the subscription's quota is used up", _MORE)),
    **dict.fromkeys(('PlatformImageNotFound', 'ImageNotFound', 'GalleryImageNotFound'), Failure(
        'there is no such image in this region', 'leave image= out for Ubuntu 24.04')),
    'LocationNotAvailableForResourceType': Failure(
        '', 'another region=: ros2 fog regions shows them'),
    'ResourceGroupBeingDeleted': Failure(
        'Azure is still deleting the machine of this request', 'start the launch again'),
    'ScopeLocked': Failure('', 'remove the lock: az lock list'),
    **dict.fromkeys(('TooManyRequests', 'OperationNotAllowed'), Failure(
        '', 'try again in a minute')),
}


class AzureError(CloudError):
    """Azure refused; ``code`` is its error code."""

    def __init__(self, message: str, hint: str = '', *, code: str = '') -> None:
        super().__init__(message, hint, gone=code in GONE, denied=code in DENIED,
                         full='zone' if code in NO_ROOM else 'region' if code in NO_QUOTA else '')
        self.code = code


def refusal(status: int, body: Any, what: str) -> FogError:
    """
    Return the error for a refusal.

    :param body: the answer's JSON, with the error of ARM or of a long-running operation.
    """
    error = body.get('error', body) if isinstance(body, Mapping) else {}
    code, said = str(error.get('code', '')), ' '.join(str(error.get('message', '')).split())
    for part in error.get('details') or ():
        # the outer code of a failed operation says only that it failed
        if part.get('code') in _FAILURES and code not in _FAILURES:
            code, said = part['code'], ' '.join(str(part.get('message', '')).split())
    if code == 'OperationNotAllowed' and 'quota' in said.lower():
        code = 'QuotaExceeded'
    known = _FAILURES.get(code) or Failure('', '')
    reason = known.reason or said[:300] or code or f'Azure answered with status {status}'
    message = f'{what} failed: {reason}' + (f' [{code}]' if code not in reason else '')
    found: FogError
    if code in DENIED and code != 'RequestDisallowedByPolicy':
        action = re.search(r"perform action '([\w./]+)'", said)
        missing = action[1] if action else 'this'
        found = AzureError(f'{what} failed: these credentials have no role that allows {missing}',
                           'doc/azure.md has the roles that FogROS2 needs', code=code)
    elif known.kind is not ProviderError:
        found = known.kind(message, known.hint)
    else:
        found = AzureError(message, known.hint, code=code or ('NotFound' if status == 404 else ''))
    # after a fault of Azure, the request may have had its effect
    found.refused = status < 500 or code in NO_ROOM | NO_QUOTA
    return found

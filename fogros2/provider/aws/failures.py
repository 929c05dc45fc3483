# SPDX-License-Identifier: Apache-2.0
"""
Convert AWS's refusals to FogErrors: one table from error codes to hints.

The codes are those of the EC2 API reference ("Error codes for the Amazon EC2 API") and of the
common errors of all AWS services.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import re
from typing import Any

from fogros2.errors import ConfigurationError, FogError, PrerequisiteError, ProviderError
from fogros2.provider.vm.failures import CodedError, Failure, LENGTH, not_the_cloud, Silent


class Expired(PrerequisiteError):
    """AWS refused credentials that have expired; the user may have renewed them since."""


_LOG_IN = 'aws sso login, or new keys: aws configure'
_QUOTA = 'ask for more at Service Quotas (EC2, in this region), or take another type or region'
_FAILURES = {
    # who is asking
    'AuthFailure': Failure(
        'AWS does not take these credentials in this region',
        'check them with: aws sts get-caller-identity; is the region enabled in the account?',
        PrerequisiteError),
    **dict.fromkeys(('InvalidClientTokenId', 'UnrecognizedClientException'), Failure(
        'AWS does not know this access key', 'check it with: aws configure list',
        PrerequisiteError)),
    'SignatureDoesNotMatch': Failure(
        '', "is the secret access key right, and this computer's clock?", PrerequisiteError),
    **dict.fromkeys(('ExpiredToken', 'ExpiredTokenException'), Failure(
        'the credentials have expired', _LOG_IN, Expired)),
    'RequestExpired': Failure(
        "the request's time is not AWS's, or the credentials have expired",
        "set this computer's clock: timedatectl set-ntp true", Expired),
    'RequestTimeTooSkewed': Failure(
        "this computer's clock is wrong", 'timedatectl set-ntp true', PrerequisiteError),
    'OptInRequired': Failure(
        '', 'subscribe to the image at AWS Marketplace, or enable the region in the AWS console',
        PrerequisiteError),
    'PendingVerification': Failure(
        'AWS is still verifying this account for this region', 'it takes up to four hours',
        PrerequisiteError),
    'Blocked': Failure('AWS has blocked this account', 'ask AWS Support', PrerequisiteError),
    # what was asked for
    'IdempotentInstanceTerminated': Failure(
        'the machine that was made under this token has ended', 'start the launch again'),
    'InvalidInstanceType': Failure(
        'the region has no such instance type', 'ros2 fog price shows what it has'),
    'Unsupported': Failure(
        '', 'the type may not be offered in this zone: ros2 fog price, or another region=',
        full='zone'),
    'InvalidAMIID.NotFound': Failure(
        'there is no such image in this region',
        'an AMI belongs to one region; leave ami_image= out for Ubuntu 24.04', gone=True),
    'InvalidAMIID.Malformed': Failure(
        'that is no id of an image', 'ami_image= takes ami-...', gone=True),
    'InvalidAMIID.Unavailable': Failure(
        'the image is not ready, or was deleted', 'ros2 fog image list', gone=True),
    **dict.fromkeys(('VPCIdNotSpecified', 'DefaultVpcDoesNotExist'), Failure(
        'the account has no default VPC in this region',
        'aws ec2 create-default-vpc, or name a subnet=')),
    'InvalidSubnetID.NotFound': Failure('there is no such subnet in this region',
                                        'check subnet= and region=', ConfigurationError),
    'InvalidGroup.NotFound': Failure('there is no such security group in this VPC', gone=True),
    'IdempotentParameterMismatch': Failure(
        'another machine was asked for under the same token', 'start the launch again'),
    # how much of it
    'InsufficientInstanceCapacity': Failure(
        'AWS has no free machine of this type here at the moment',
        'try later, or give more types and places: instance_types=, regions=', full='zone'),
    **dict.fromkeys(('InsufficientHostCapacity', 'InsufficientCapacity', 'UnfulfillableCapacity',
                     'InsufficientFreeAddressesInSubnet'), Failure(full='zone')),
    'VcpuLimitExceeded': Failure(
        "the account's quota of vCPUs is used up", _QUOTA, full='region'),
    'InstanceLimitExceeded': Failure(
        "the account's quota of instances is used up", _QUOTA, full='region'),
    **dict.fromkeys(('MaxSpotInstanceCountExceeded', 'SpotInstanceCountExceeded'), Failure(
        "the account's quota of spot instances is used up", _QUOTA, full='region')),
    'SpotMaxPriceTooLow': Failure(
        'the spot price is above max_price= at the moment',
        'ros2 fog price --spot shows it; spot=False takes a machine on demand', full='zone'),
    'VolumeLimitExceeded': Failure("the account's quota of disks is used up", _QUOTA),
    'SecurityGroupLimitExceeded': Failure(
        "the account's quota of security groups is used up", 'ros2 fog gc, or ask for more'),
    'RulesPerSecurityGroupLimitExceeded': Failure('', 'fewer addresses in ssh_from='),
    'IncorrectInstanceState': Failure('', 'ros2 fog list shows its state'),
    'DependencyViolation': Failure('something uses it still', 'ros2 fog delete again in a minute'),
    # AWS itself
    **dict.fromkeys(('RequestLimitExceeded', 'Throttling', 'ThrottlingException',
                     'RequestThrottled', 'EC2ThrottledException', 'TooManyRequestsException'),
                    Failure('AWS asks for fewer requests', 'try again in a minute',
                            temporary=True)),
    **dict.fromkeys(('InternalError', 'InternalFailure'), Failure(
        '', 'try again; https://health.aws.amazon.com has what is known')),
    **dict.fromkeys(('ServiceUnavailable', 'Unavailable'), Failure('', 'try again in a minute')),
    'ParameterNotFound': Failure(
        'AWS names no such image in this region', 'name one with ami_image='),
    # the policy of the credentials, or of their organisation
    **dict.fromkeys(('UnauthorizedOperation', 'AccessDenied', 'AccessDeniedException',
                     'UnauthorizedException'), Failure(denied=True)),
    **dict.fromkeys(('InvalidInstanceID.NotFound', 'InvalidInstanceID.Malformed',
                     'InvalidKeyPair.NotFound', 'InvalidSnapshot.NotFound',
                     'InvalidVolume.NotFound'),
                    Failure(gone=True)),
}
#: Errors of botocore without an answer: reason ({} is botocore's own), and hint.
_UNSENT = {
    'NoCredentialsError': ('there are no AWS credentials on this computer',
                           'aws configure, or set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY'),
    'PartialCredentialsError': ('the AWS credentials are incomplete: {}', 'aws configure'),
    'ProfileNotFound': ('{}', 'aws configure list-profiles shows them; AWS_PROFILE'),
    **dict.fromkeys(('SSOError', 'TokenRetrievalError'), (
        'the AWS login is over: {}', 'aws sso login')),
    **dict.fromkeys(('CredentialRetrievalError', 'MetadataRetrievalError'), (
        "the AWS credentials can't be had: {}", 'aws sts get-caller-identity')),
    **dict.fromkeys(('NoRegionError', 'InvalidRegionError'), (
        '{}', "region='eu-central-1', or aws configure")),
    **dict.fromkeys(('ConfigParseError', 'ConfigNotFound'), ('{}', 'check ~/.aws/config')),
}
_ACTION = re.compile(r'not authorized to perform:? ([A-Za-z0-9-]+:[A-Za-z0-9*]+)')
#: A policy in which the user can add nothing, such as one of the organisation.
_OTHER_POLICY = re.compile('explicit deny|because no (?!identity-based)')


class AwsError(CodedError):
    """AWS refused; ``code`` is its error code."""

    TITLE = 'AWS'
    FAILURES = _FAILURES


@contextlib.contextmanager
def translated(what: str, region: str = '') -> Iterator[None]:
    """
    Convert the errors of boto3 in the block to FogErrors.

    :param what: action of the block, such as 'creating the security group'.
    :raises PrerequisiteError: no credentials, bad ones, no route to AWS, a wrong clock.
    :raises AwsError: AWS refused.
    """
    from botocore import exceptions
    from botocore.parsers import ResponseParserError

    where = f'{what} in {region}' if region else what
    try:
        yield
    except exceptions.ClientError as error:
        raise refused(error.response, error.operation_name, where) from error
    except ResponseParserError as error:
        raise not_the_cloud('AWS', where) from error
    except exceptions.BotoCoreError as error:
        raise _unsent(error, where) from error


def refused(response: Any, operation: str, where: str) -> FogError:
    """Return the error for a refusal; ``response`` as botocore has it."""
    details = response.get('Error') or {}
    code, message = str(details.get('Code', '')), _plain(str(details.get('Message', '')))
    status = (response.get('ResponseMetadata') or {}).get('HTTPStatusCode', 400)
    if AwsError.known(code).denied:
        if _OTHER_POLICY.search(message):
            return AwsError(f'{where} failed: {message}',
                            'ask who manages this policy, or the organisation of the account',
                            code=code)
        action = denied_action(message, operation)
        return AwsError(f'{where} failed: the policy of these credentials does not allow {action}',
                        f'add {action} to it: doc/aws.md has the whole policy', code=code)
    short = message if len(message) <= LENGTH else f'{message[:LENGTH]}...'
    error = AwsError.of(code, short, where, status)
    if code.startswith('Invalid') and message and AwsError.known(code).reason:
        error.args = (f'{error.args[0]} ({message[:160].rstrip(".")})',)
    if 'Free Tier' in message:
        error.hint = ("upgrade the account to AWS's paid plan, or name a type of the free plan: "
                      "ec2_instance_type='m7i-flex.large'")
    return error


def _plain(text: str) -> str:
    """Return a message in one line; the answer of a proxy is a whole page."""
    if text.lstrip().startswith('<'):
        text = re.sub(r'<[^>]*>', ' ', text)
    # few users may decode the rest
    return ' '.join(text.partition('Encoded authorization failure')[0].split())


def denied_action(message: str, operation: str) -> str:
    """
    Return the action that a policy lacks, such as 'ec2:RunInstances'.

    A call may need other actions too (tags at creation, a role), which AWS names.
    """
    named = _ACTION.search(message)
    if named:
        return named[1]
    service = {'GetCallerIdentity': 'sts', 'GetParameter': 'ssm',
               'GetProducts': 'pricing'}.get(operation, 'ec2')
    return f'{service}:{operation}'


def _unsent(error: BaseException, where: str) -> FogError:
    """Return the error for a request without an answer."""
    from botocore import exceptions as known

    message = ' '.join(str(error).split())
    for kind in type(error).__mro__:
        if kind.__name__ in _UNSENT:
            reason, hint = _UNSENT[kind.__name__]
            return PrerequisiteError(f'{where} failed: {reason.format(message)}', hint)
    if isinstance(error, (known.HTTPClientError, known.ConnectionError)):
        return Silent(
            f'{where} failed: AWS does not answer: {message}',
            'does region= exist, and is there a way to the Internet (a proxy, AWS_ENDPOINT_URL)?',
            unsent=isinstance(error, known.ConnectionError))
    return ProviderError(f'{where} failed: {message}')

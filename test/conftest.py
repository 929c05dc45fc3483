# SPDX-License-Identifier: Apache-2.0
"""What all tests share: state of their own, and the reasons why this computer can't run some."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import datetime
from decimal import Decimal
import gc
import itertools
import logging
import os
from pathlib import Path
import re
import shutil
import signal
import socket
import subprocess
import sys
from typing import Any
import urllib.request

import pytest

# ONNX Runtime tells Microsoft of its use, from its import on
os.environ['ORT_DISABLE_TELEMETRY'] = '1'
# threads that multiply small matrices mostly wait for each other, each on a processor
os.environ['OPENBLAS_NUM_THREADS'] = '1'

#: What ``colcon test`` runs by default: what makes no machine.
QUICK = ['test/unit', 'test/contract', 'test/launch']
#: Folder of what tests leave for the next ones, if it is there.
CACHE = Path(__file__).parents[1] / '.cache'
#: Regions that the AWS of the tests has.
MOTO_REGIONS = ('eu-central-1', 'us-east-1')


def pytest_configure(config: pytest.Config) -> None:
    """
    Take signals as a terminal would hand them over, and run the quick part for colcon.

    What a shell without job control starts in the background ignores SIGINT and SIGQUIT, and so
    would all that the tests start and then interrupt; nohup does the same to SIGHUP.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGQUIT, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    # colcon names the package so; ``colcon test --pytest-args test`` runs all
    if config.getoption('junitprefix', None) == 'fogros2' \
            and config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        config.args[:] = [str(config.rootpath / name) for name in QUICK]


@pytest.hookimpl(hookwrapper=True)
def pytest_collection() -> Iterator[None]:
    """Look for no garbage among modules and tests, which stay: that takes a fifth of the time."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write down what failed, for ``tools/test.sh``; the names without xdist's groups."""
    if not hasattr(session.config, 'workerinput'):
        remove_shared_memory()
    reporter = session.config.pluginmanager.get_plugin('terminalreporter')
    if reporter is not None and CACHE.is_dir():
        (CACHE / 'failed-tests.txt').write_text(''.join(dict.fromkeys(
            re.sub(r'@[^]@]*$', '', report.nodeid) + '\n'
            for kind in ('failed', 'error') for report in reporter.stats.get(kind, ()))))


def remove_shared_memory(folder: Path = Path('/dev/shm')) -> None:
    """Remove what is left of Fast DDS's shared memory of this user's nodes that were killed."""
    used: set[str] = set()
    for maps in Path('/proc').glob('[0-9]*/maps'):
        with contextlib.suppress(OSError):
            used.update(re.findall(
                r'/(fastrtps_\w+)$', maps.read_text(errors='replace'), re.MULTILINE))
    for path in folder.glob('*fastrtps_*'):
        name = re.sub(r'^sem\.|_mutex$|_el$', '', path.name)
        with contextlib.suppress(OSError):
            if name not in used and path.stat().st_uid == os.getuid():
                path.unlink()


@pytest.hookimpl(tryfirst=True)  # xdist reads the marks in its own hook of this name
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """
    Keep together, where several processes share the tests, what shares something costly.

    That is the cluster of the pods and the simulated clouds; of all else, the fixtures of a
    module. These take longest, so they come first, and tests without a machine come last: no
    process begins with something long when the others are done.
    """
    costly = ('kubernetes', 'aws', 'azure', 'gcp')

    def group(item: pytest.Item) -> str:
        params = getattr(item, 'callspec', None)
        cloud = params.params.get('cloud') if params else None
        folder = item.path.parent.name
        return str(cloud or (folder if folder == 'kubernetes' else item.path))

    for item in items:
        item.add_marker(pytest.mark.xdist_group(group(item)))
    items.sort(key=lambda item: (group(item) not in costly,
                                 'integration' not in item.path.parts))


def forget_process_loggers() -> None:
    """Let go of the loggers of a test's processes: pytest goes through all, three times a test."""
    loggers = logging.Logger.manager.loggerDict
    for name in [name for name in loggers if re.search(r'-\d+(-stdout|-stderr)?$', name)]:
        del loggers[name]


@pytest.fixture(scope='session')
def own_folders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield one new folder after the other; pytest takes longer for each, as it counts them."""
    top = tmp_path_factory.mktemp('own', numbered=False)
    return (top / str(number) for number in itertools.count())


@pytest.fixture(autouse=True)
def state_home(
    request: pytest.FixtureRequest, own_folders: Iterator[Path], monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Path]:
    """Give each test a state folder of its own, so that none sees the user's machines."""
    folder = next(own_folders)
    if 'integration' in request.path.parts:
        monkeypatch.setenv('ROS_LOG_DIR', str(folder / 'log'))
    else:
        # gc deletes the interfaces of dead launches
        monkeypatch.setattr('fogros2.vpn.owner.INTERFACES', Path('/nonexistent'))
    path, config = folder / 'state', folder / 'config'
    for made in (folder, path, config):
        made.mkdir(0o700)
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(path))
    monkeypatch.setenv('XDG_CONFIG_HOME', str(config))
    yield path
    if 'launch.logging' in sys.modules:  # its log file is in the folder
        sys.modules['launch.logging'].reset()
        forget_process_loggers()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope='session')
def upstream() -> Path:
    """Return a folder with checkouts of FogROS2's repositories, which tests run unedited."""
    named = os.environ.get('FOGROS2_UPSTREAM', '')
    if not Path(named, 'FogROS2', 'fogros2_examples').is_dir() or not named:
        pytest.skip('needs FOGROS2_UPSTREAM: a folder with checkouts of FogROS2 (branch humble) '
                    'and fogros2-examples')
    return Path(named)


@pytest.fixture
def jammy(tmp_path: Path) -> dict[str, str]:
    """Return the environment on a simulated Ubuntu 22.04, the release that FogROS2 asks for."""
    modules = tmp_path / 'jammy'
    modules.mkdir()
    (modules / 'lsb_release.py').write_text(
        "def get_os_release():\n    return {'RELEASE': '22.04'}\n")
    before = os.environ.get('PYTHONPATH')
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, (str(modules), before)))}


@pytest.fixture
def name_of_no_text() -> Iterator[None]:
    """Give this process a name that is no UTF-8, as a longer name has whose end was cut off."""
    name = Path('/proc/self/comm')
    before = name.read_bytes()
    name.write_bytes(b'caf\xc3')
    yield
    name.write_bytes(before)


@pytest.fixture
def free_udp_port() -> int:
    """Return a UDP port that was free a moment ago."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(('127.0.0.1', 0))
        port: int = probe.getsockname()[1]
    return port


@pytest.fixture(scope='session')
def root() -> None:
    """Skip where commands can't run as root: neither root nor sudo without a question."""
    if os.geteuid() == 0:
        return
    if shutil.which('sudo') is None or subprocess.run(
            ['sudo', '-n', 'true'], capture_output=True).returncode != 0:
        pytest.skip('needs root, or sudo without a password')


@pytest.fixture(scope='session')
def root_at_login() -> None:
    """Skip where who logs in by SSH has no root: sudo's ticket belongs to the terminal."""
    if os.geteuid() != 0 and (shutil.which('sudo') is None or subprocess.run(
            ['sudo', '-n', 'true'], capture_output=True, start_new_session=True).returncode):
        pytest.skip('a login or terminal of its own needs sudo without a password')


@pytest.fixture(scope='session')
def tun(root: None) -> None:
    """Skip where no TUN device can be opened."""
    if not os.path.exists('/dev/net/tun'):
        pytest.skip('needs /dev/net/tun')


@pytest.fixture(scope='session')
def moto_server() -> Iterator[str]:
    """Serve Moto's AWS on the loopback; returns its URL."""
    server_module = pytest.importorskip(
        'moto.server', reason="Moto's server is not installed: pip install 'moto[server]'")
    logging.getLogger('werkzeug').setLevel(logging.ERROR)
    server = server_module.ThreadedMotoServer(ip_address='127.0.0.1', port=0, verbose=False)
    server.start()
    yield 'http://{}:{}'.format(*server.get_host_and_port())
    server.stop()


@pytest.fixture
def loopback_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse every look-up of another host in this process: clouds' libraries ask their own."""
    look_up = socket.getaddrinfo

    def here_alone(host: Any, *others: Any, **words: Any) -> Any:
        if host not in ('127.0.0.1', 'localhost'):
            raise socket.gaierror(socket.EAI_NONAME, f'the tests reach no {host}')
        return look_up(host, *others, **words)

    monkeypatch.setattr(socket, 'getaddrinfo', here_alone)


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poll clouds without the pauses that real ones need."""
    from fogros2 import waiting
    from fogros2.provider.vm import account

    def wait_until(probe: Any, **options: Any) -> Any:
        return waiting.wait_until(probe, **{**options, 'first': 0.0, 'interval': 0.02})

    for module in [found for name, found in sys.modules.items()
                   if name.startswith('fogros2.provider.') and hasattr(found, 'wait_until')]:
        monkeypatch.setattr(module, 'wait_until', wait_until)
    monkeypatch.setattr(account, 'PAUSE', 0.02)
    monkeypatch.setattr(account, 'LONGEST', 0.2)


@pytest.fixture
def gce(
    hasty: None, loopback_only: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> Iterator[Any]:
    """Lead Google's clients to an empty Compute Engine in a box, without computers."""
    pytest.importorskip('google.auth', reason='needs google-auth')
    pytest.importorskip('googleapiclient', reason="needs Google's description of the API")
    from rigs.gce import loopback
    with loopback.serve(tmp_path) as found:
        for name in ('GOOGLE_CLOUD_PROJECT', 'CLOUDSDK_CORE_PROJECT', 'CLOUDSDK_COMPUTE_REGION',
                     'CLOUDSDK_COMPUTE_ZONE', 'FOGROS2_GCP_REGIONS'):
            monkeypatch.delenv(name, raising=False)
        for name, value in {**found.variables, 'FOGROS2_ROBOT_ADDRESS': '198.51.100.7'}.items():
            monkeypatch.setenv(name, value)
        yield found


@pytest.fixture(scope='session')
def boto_models() -> Iterator[None]:
    """Let all sessions of boto3 share the services' models: reading EC2's takes 0.2 s."""
    loaders = pytest.importorskip('botocore.loaders', reason='needs boto3')
    read, models = loaders.JSONFileLoader.load_file, {}

    def load_file(loader: Any, path: str) -> Any:
        if path not in models:
            models[path] = read(loader, path)
        return models[path]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loaders.JSONFileLoader, 'load_file', load_file)
        yield


@pytest.fixture
def moto_aws(
    moto_server: str, boto_models: None, hasty: None, monkeypatch: pytest.MonkeyPatch,
) -> str:
    """Lead boto3 to an empty AWS of Moto's that has the public images; returns its URL."""
    from moto.core import DEFAULT_ACCOUNT_ID  # type: ignore[attr-defined]
    from moto.ec2.models import ec2_backends, instance_types
    from moto.ec2.models.amis import AmiBackend
    from moto.ec2.models.availability_zones_and_regions import RegionsAndZonesBackend
    from moto.ec2.models.elastic_block_store import EBSBackend
    from moto.ssm.models import Parameter, ssm_backends

    from fogros2.provider.aws import images

    # a thousand of other people's images, loaded anew for each test and region
    monkeypatch.setenv('MOTO_EC2_LOAD_DEFAULT_AMIS', 'false')
    urllib.request.urlopen(urllib.request.Request(
        f'{moto_server}/moto-api/reset', method='POST'), timeout=10.0).close()
    for name, value in {
            'AWS_ENDPOINT_URL': moto_server, 'AWS_ACCESS_KEY_ID': 'test',
            'AWS_SECRET_ACCESS_KEY': 'test', 'AWS_DEFAULT_REGION': 'eu-central-1',
            'AWS_EC2_METADATA_DISABLED': 'true', 'AWS_CONFIG_FILE': os.devnull,
            'AWS_SHARED_CREDENTIALS_FILE': os.devnull,
            'FOGROS2_ROBOT_ADDRESS': '198.51.100.7',
            'FOGROS2_AWS_REGIONS': ' '.join(MOTO_REGIONS)}.items():
        monkeypatch.setenv(name, value)
    for name in ('AWS_PROFILE', 'AWS_SESSION_TOKEN', 'AWS_REGION'):
        monkeypatch.delenv(name, raising=False)
    # Moto answers with eight hundred types, and makes an RSA key for the disks of each region
    kinds = ('t3.medium', 't3.large', 't3.xlarge', 'm6g.large', 'g5.xlarge')
    monkeypatch.setattr(instance_types.InstanceTypeBackend, 'instance_types', [
        instance_types.InstanceType(kind) for kind in kinds])
    offered = instance_types.INSTANCE_TYPE_OFFERINGS['availability-zone']
    for region in MOTO_REGIONS:
        monkeypatch.setitem(offered, region, [
            one for one in offered[region] if one['InstanceType'] in kinds])
    monkeypatch.setattr(EBSBackend, '_create_default_encryption_key', lambda self: 'arn:aws:kms')
    monkeypatch.setattr(RegionsAndZonesBackend, 'regions', [
        region for region in RegionsAndZonesBackend.regions if region.name in MOTO_REGIONS])
    create_image = AmiBackend.create_image

    def create_with_snapshots(
        self: Any, instance_id: str, name: str, description: str, tag_specifications: list[Any],
    ) -> Any:
        """Tag an image's snapshot as well, which Moto doesn't know of."""
        kinds = {kind: [tag for spec in tag_specifications if spec['ResourceType'] == kind
                        for tag in spec['Tags']] for kind in ('image', 'snapshot')}
        image = create_image(self, instance_id, name, description, [
            {'ResourceType': 'image', 'Tags': kinds['image']}])
        image.ebs_snapshot.add_tags({tag['Key']: tag['Value'] for tag in kinds['snapshot']})
        return image

    monkeypatch.setattr(AmiBackend, 'create_image', create_with_snapshots)
    # Moto has no price list, and boto3 would ask it again and again
    monkeypatch.setattr('fogros2.provider.aws.prices.Ec2Prices.prices', lambda *args: {
        name: Decimal(price) for name, price in (
            ('t3.large', '0.0832'), ('t3.medium', '0.0416'), ('t3.xlarge', '0.1664'))})
    for region in MOTO_REGIONS:
        for arch in images.UBUNTU:
            for path in (images.UBUNTU[arch], images.DEEP_LEARNING[arch]):
                # by its insides: Moto drops what an image is registered with, and takes no
                # parameter whose name is AWS's own
                image = ec2_backends[DEFAULT_ACCOUNT_ID][region].register_image(path, path)
                image.architecture, image.virtualization_type = arch, 'hvm'
                ssm_backends[DEFAULT_ACCOUNT_ID][region]._parameters[path] = [Parameter(  # type: ignore[abstract]
                    DEFAULT_ACCOUNT_ID, path, image.id, 'String', None, None, None,
                    datetime.datetime.now(), 1, 'text')]
    return moto_server


@pytest.fixture
def azure_service(
    hasty: None, loopback_only: None, monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Any]:
    """Serve a simulated Azure on the loopback, and lead the provider there; yields it."""
    from fogros2.provider.azure import cloud
    from fogros2.provider.azure.account import Account
    from rigs import serving
    from rigs.azure import service

    # what a process asks once is another in each test
    monkeypatch.setattr(cloud, '_USUAL', Account())
    azure = service.Service()
    with serving.serve(azure) as url:
        for name, value in service.environment(url).items():
            monkeypatch.setenv(name, value)
        monkeypatch.setenv('FOGROS2_ROBOT_ADDRESS', '198.51.100.7')
        yield azure

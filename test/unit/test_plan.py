# SPDX-License-Identifier: Apache-2.0
"""Tests of fogros2.plan: values in, values out."""

import contextlib
import dataclasses
from decimal import Decimal
from pathlib import Path

import pytest

from fogros2 import plan
from fogros2.errors import ConfigurationError, DdsError, VpnError, WorkspaceError
from fogros2.host.programs import check_program
from fogros2.model import Machine, MachineSpec, MachineState, Peer

NETWORK = '198.18.7.0/24'


def test_rmw_is_that_of_ros_unless_user_has_one():
    assert plan.choose_rmw({}, ['rmw_fastrtps_cpp']) == 'rmw_fastrtps_cpp'
    known = ['rmw_cyclonedds_cpp', 'rmw_x']
    assert plan.choose_rmw({'RMW_IMPLEMENTATION': 'rmw_x'}, known) == 'rmw_x'


def test_rmw_without_a_plugin_is_refused_by_name():
    with pytest.raises(DdsError, match='rmw_connextdds.*rmw_cyclonedds_cpp'):
        plan.choose_rmw({'RMW_IMPLEMENTATION': 'rmw_connextdds'}, ['rmw_cyclonedds_cpp'])


def test_addresses_are_robot_first_then_machines_in_order():
    assert plan.robot_interface('a1b2c3', NETWORK, 4, '/k', 7).address == '198.18.7.1'
    assert plan.machine_interface('a1b2c3', NETWORK, 0, 4, '/k').address == '198.18.7.2'
    assert plan.machine_interface('a1b2c3', NETWORK, 9, 4, '/k').address == '198.18.7.11'


def test_interface_names_are_short_and_unique():
    robot = plan.robot_interface('a1b2c3', NETWORK, 4, '/k', 7)
    machine = plan.machine_interface('a1b2c3', NETWORK, 221, 4, '/k')
    assert robot.name != machine.name
    assert len(machine.name) <= 15
    assert robot.firewall and not machine.firewall


def test_full_subnet_is_reported():
    with pytest.raises(ConfigurationError, match='no free address'):
        plan.machine_interface('a1b2c3', NETWORK, 222, 4, '/k')


ROBOT = Peer('robot', 'R', '198.18.7.1', '198.51.100.9:1')
PLANNER = plan.Route(Peer('planner', 'P', '198.18.7.2', '198.51.100.1:1'))
SLAM = plan.Route(Peer('slam', 'S', '198.18.7.3', '198.51.100.2:1'))


def test_a_machine_dials_its_siblings_but_not_the_robot():
    peers = plan.machine_peers(ROBOT, SLAM, [PLANNER])
    assert peers == [Peer('robot', 'R', '198.18.7.1', None), PLANNER.peer]


def test_a_machine_that_nobody_can_dial_dials_the_robot():
    hidden = plan.Route(Peer('pod', 'D', '198.18.7.4'), robot_endpoint='198.51.100.9:4')
    assert plan.machine_peers(ROBOT, hidden, [PLANNER]) == [
        Peer('robot', 'R', '198.18.7.1', '198.51.100.9:4'), PLANNER.peer]
    # and the others wait for it
    assert plan.machine_peers(ROBOT, PLANNER, [hidden])[1].endpoint is None


def test_machines_of_one_private_network_dial_each_other_there():
    def inside(route, network, host):
        return dataclasses.replace(route, private_network=network, private_endpoint=host)

    one, two = inside(PLANNER, 'c', '10.0.0.1:5'), inside(SLAM, 'c', '10.0.0.2:5')
    assert plan.machine_peers(ROBOT, one, [two])[1] == Peer(
        'slam', 'S', '198.18.7.3', '10.0.0.2:5')
    elsewhere = inside(SLAM, 'd', '10.0.0.2:5')
    assert plan.machine_peers(ROBOT, one, [elsewhere])[1] == SLAM.peer
    assert plan.machine_peers(ROBOT, PLANNER, [SLAM])[1] == SLAM.peer


@pytest.mark.parametrize(('known', 'peer', 'inner', 'robot'), [
    ({'vpn_host': '198.51.100.1'}, '198.51.100.1:7', None, None),
    ({'vpn_host': '2001:db8::1'}, '[2001:db8::1]:7', None, None),
    ({'vpn_host': 'node.example', 'vpn_port': 30007}, 'node.example:30007', None, None),
    ({'robot_host': '198.51.100.9'}, None, None, '198.51.100.9:9'),
    ({'vpn_host': 'n', 'vpn_port': 3, 'private_network': 'c', 'private_ip': '10.0.0.1'},
     'n:3', '10.0.0.1:7', None)])
def test_route_comes_from_provider_report(known, peer, inner, robot):
    machine = Machine('id', 'pod', 'fake', MachineState.RUNNING, **known)
    route = plan.route(machine, Peer('pod', 'D', '198.18.7.4'), 7, 9)
    assert (route.peer.endpoint, route.private_endpoint, route.robot_endpoint) == (
        peer, inner, robot)


def test_a_machine_without_any_way_is_refused():
    machine = Machine('id', 'pod', 'fake', MachineState.RUNNING)
    with pytest.raises(VpnError, match="neither the robot nor 'pod'.*UDP"):
        plan.route(machine, Peer('pod', 'D', '198.18.7.4'), 7, 9)


def test_a_price_reads_as_money():
    assert plan.price(Decimal('0.0416')) == '$0.0416 an hour'
    assert plan.price(Decimal(3)) == '$3.0000 an hour'


def test_underlay_has_ros_and_the_workspace_only():
    environment = {
        'AMENT_PREFIX_PATH': '/home/me/ws/install/a:/opt/ros/jazzy',
        'PYTHONPATH': '/home/me/ws/install/a/lib/python3:/home/me/own:/opt/ros/jazzy/lib/python3',
        'LD_LIBRARY_PATH': '/opt/ros/jazzy/lib:/usr/local/cuda/lib',
        'PATH': '/home/me/bin:/opt/ros/jazzy/bin:/usr/bin',
        'ROS_DISTRO': 'jazzy', 'RCUTILS_LOGGING_USE_STDOUT': '1', 'AWS_SECRET_ACCESS_KEY': 'x',
    }
    under = plan.underlay(environment, ['/home/me/ws'], '/opt/ros/jazzy/bin/ros2', prefix='/usr')
    assert under.prefixes == ('/opt/ros/jazzy',)
    assert under.environment == {
        'AMENT_PREFIX_PATH': '/home/me/ws/install/a:/opt/ros/jazzy',
        'PYTHONPATH': '/home/me/ws/install/a/lib/python3:/opt/ros/jazzy/lib/python3',
        'LD_LIBRARY_PATH': '/opt/ros/jazzy/lib',
        'PATH': f'/opt/ros/jazzy/bin:{plan.SYSTEM_PATH}',
        'ROS_DISTRO': 'jazzy', 'RCUTILS_LOGGING_USE_STDOUT': '1',
    }


def test_a_virtual_environment_is_part_of_the_underlay():
    under = plan.underlay({'PATH': '/usr/bin'}, (), '/p/.venv/bin/ros2', prefix='/p/.venv')
    assert under.prefixes == ('/p/.venv',)
    assert under.environment['PATH'].startswith('/p/.venv/bin:')


@pytest.fixture
def prefix(tmp_path):
    index = tmp_path / 'share/ament_index/resource_index/packages'
    index.mkdir(parents=True)
    (index / 'arm_planning').touch()
    (tmp_path / 'lib/arm_planning').mkdir(parents=True)
    (tmp_path / 'lib/arm_planning/planner').touch(0o755)
    (tmp_path / 'lib/arm_planning/script.py').touch(0o644)
    (tmp_path / 'lib/arm_planning/folder').mkdir()
    return str(tmp_path)


def test_a_program_in_the_index_is_found(prefix):
    check_program('arm_planning', 'planner', ['/nowhere', prefix])


@pytest.fixture
def unsourced(tmp_path):
    """Return a workspace with a package that is built, and one that isn't."""
    for name in ('rob_tools', 'unbuilt'):
        manifest = tmp_path / 'src' / name / 'package.xml'
        manifest.parent.mkdir(parents=True)
        manifest.write_text(f'<package><name>{name}</name></package>')
    prefix = tmp_path / 'install' / 'rob_tools'
    for path in ('share/ament_index/resource_index/packages/rob_tools', 'lib/rob_tools/params'):
        (prefix / path).parent.mkdir(parents=True)
        (prefix / path).touch(0o755)
    return tmp_path


def test_a_named_workspace_need_not_be_sourced(unsourced):
    check_program('rob_tools', 'params', [], str(unsourced))
    with pytest.raises(WorkspaceError, match="there is no package 'rob_tools'"):
        check_program('rob_tools', 'params', [])


def test_unbuilt_package_is_reported(unsourced):
    with pytest.raises(WorkspaceError) as error:
        check_program('unbuilt', 'params', [], str(unsourced))
    assert str(error.value) == (f"package 'unbuilt' in {unsourced}/src/unbuilt is not built "
                                f'(run colcon build in {unsourced})')


def test_a_weak_guess_does_not_hide_the_hint(tmp_path):
    index = tmp_path / 'share/ament_index/resource_index/packages'
    index.mkdir(parents=True)
    for name in ('tracetools', *(f'package_{number}' for number in range(9))):
        (index / name).touch()
    with pytest.raises(WorkspaceError) as error:
        check_program('rob_tools', 'params', [str(tmp_path)])
    assert 'tracetools' not in str(error.value) and 'ros_workspace=' in str(error.value)


@pytest.mark.parametrize('package, executable, words', [
    ('arm_planing', 'planner', "did you mean 'arm_planning'"),
    ('arm_planning', 'plannr', "did you mean 'planner'"),
    ('arm_planning', 'script.py', "/script.py' is not executable .chmod [+]x "),
    ('arm_planning', 'folder', 'there are: planner[)]'),
    ('zzz', 'planner', 'there are: arm_planning'),
])
def test_a_program_that_is_not_there_is_refused_with_the_nearest(
        prefix, package, executable, words):
    with pytest.raises(WorkspaceError, match=words):
        check_program(package, executable, [prefix])


def test_a_middleware_has_to_be_there_and_to_be_one_for_all(tmp_path: Path) -> None:
    index = tmp_path / 'share/ament_index/resource_index/rmw_typesupport'
    index.mkdir(parents=True)
    (index / 'rmw_fastrtps_cpp').touch()
    here, wheels = [str(tmp_path), '/nowhere'], str(tmp_path / 'wheels')
    info = 'lib/python3.12/site-packages/ros_rclpy-7.1.6.dist-info'
    (tmp_path / 'wheels' / info).mkdir(parents=True)
    like = MachineSpec('m', 'ssh', environment={'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp'})
    plan.check_rmw('rmw_fastrtps_cpp', here, [like, MachineSpec('n', 'ssh')])
    plan.check_rmw(plan.DEFAULT_RMW, ['/nowhere'], [MachineSpec('n', 'ssh')])
    for rmw, prefixes, spec, words in (
            ('rmw_cyclonedds_cpp', here, like, 'rmw_cyclonedds_cpp is not installed'),
            ('rmw_cyclonedds_cpp', [wheels], like, 'the wheels of ROS 2, which have rmw_fast'),
            ('rmw_cyclonedds_cpp', ['/nowhere'], like, 'would not hear each other'),
            ('rmw_cyclonedds_cpp', ['/nowhere'], MachineSpec('m', 'ssh', bootstrap='pip'),
             'would get ROS 2 by pip')):
        with pytest.raises(DdsError, match=words) as caught:
            plan.check_rmw(rmw, prefixes, [spec])
        assert 'RMW_IMPLEMENTATION' in caught.value.hint
        assert ('dds=' in caught.value.hint) == ('hear each other' not in words)


@pytest.mark.parametrize(('environment', 'own'), [
    ({}, ''), ({'ROS_DOMAIN_ID': '3'}, ''), ({'ROS_DOMAIN_ID': '5'}, '5'),
    ({'ROS_DOMAIN_ID': ''}, '0'), ({'ROS_DOMAIN_ID': '0x3'}, '')])
def test_machine_has_the_domain_of_the_launch(environment: dict[str, str], own: str) -> None:
    specs = [MachineSpec('n', 'ssh'), MachineSpec('m', 'ssh', environment=environment)]
    refused = pytest.raises(DdsError, match=f"'m' would have ROS_DOMAIN_ID={own}, those here 3")
    with refused if own else contextlib.nullcontext():
        plan.check_domain(3, specs)


@pytest.mark.parametrize(('text', 'domain'), [
    ('', 0), ('0', 0), ('05', 5), ('010', 8), ('0x10', 16), (' 42', 42), ('101', 101)])
def test_domain_is_read_as_nodes_read_it(text: str, domain: int) -> None:
    assert plan.read_domain(text) == domain
    for wrong in ('08', 'x', '1.5'):
        with pytest.raises(ConfigurationError, match='is no number'):
            plan.read_domain(wrong)


@pytest.mark.parametrize('name', ['fastdds', 'fastrtps', 'rmw_fastrtps_cpp'])
def test_a_launch_file_names_its_middleware(name: str) -> None:
    known = ['rmw_cyclonedds_cpp', 'rmw_fastrtps_cpp']
    assert plan.rmw_of(name, known) == 'rmw_fastrtps_cpp'
    with pytest.raises(DdsError, match='opendds'):
        plan.rmw_of('opendds', known)

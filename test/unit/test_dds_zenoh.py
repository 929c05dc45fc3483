# SPDX-License-Identifier: Apache-2.0
"""Zenoh's configurations by value; what comes of them: ``integration/vpn/test_dds_zenoh``."""

from __future__ import annotations

import json

import pytest

from fogros2.dds.zenoh import Zenoh
from fogros2.errors import DdsError

ROBOT, MACHINE, OTHER = '198.18.7.1', '198.18.7.2', '198.18.7.3'


def dialled(text: str) -> list[str]:
    endpoints: list[str] = json.loads(text)['connect']['endpoints']
    return endpoints


def test_nodes_know_the_router_of_their_host_alone() -> None:
    dds = Zenoh()
    for interfaces in (dds.robot_interfaces(ROBOT, None, {}), dds.machine_interfaces(ROBOT)):
        text = dds.render(interfaces, [OTHER])
        assert dialled(text) == [f'tcp/{ROBOT}:7448']
        assert json.loads(text)['scouting']['multicast'] == {'enabled': False}
    assert dds.environment('/x', {}) == {
        'RMW_IMPLEMENTATION': 'rmw_zenoh_cpp', 'ZENOH_SESSION_CONFIG_URI': '/x'}


@pytest.mark.parametrize('user, others, beside', [
    ({}, [], ('127.0.0.1', 7447)),
    ({'ROS_STATIC_PEERS': 'nuc.local'}, ['tcp/nuc.local:7447'], ('127.0.0.1', 7447)),
    ({'ROS_STATIC_PEERS': '127.0.0.1'}, ['tcp/127.0.0.1:7447'], None)])
def test_robots_router_dials_machines_and_what_the_user_names(
        user: dict[str, str], others: list[str], beside: tuple[str, int] | None) -> None:
    router = Zenoh().router(ROBOT, [MACHINE], user)
    assert router is not None and router.beside == beside
    assert json.loads(router.config)['listen']['endpoints'] == [f'tcp/{ROBOT}:7448']
    assert dialled(router.config) == [f'tcp/{MACHINE}:7448', *others]


@pytest.mark.parametrize('user', [
    None, {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_STATIC_PEERS': 'nuc.local'},
    {'ROS_LOCALHOST_ONLY': '1'}])
def test_local_node_and_machine_meet_no_other_computer(
        user: dict[str, str] | None) -> None:
    router = Zenoh().router(MACHINE, [OTHER], user)
    assert router is not None
    assert dialled(router.config) == [f'tcp/{OTHER}:7448']


@pytest.mark.parametrize('user', [
    {'ZENOH_SESSION_CONFIG_URI': '/mine'}, {'ZENOH_CONFIG_OVERRIDE': 'mode="client"'},
    {'ZENOH_CONFIG_OVERRIDE': 'connect/endpoints=["tcp/a:1"]'},
    {'ZENOH_CONFIG_OVERRIDE': 'adminspace/enabled=true; listen/endpoints=["tcp/[::]:0"]'}])
def test_what_leads_nodes_elsewhere_is_refused(user: dict[str, str]) -> None:
    with pytest.raises(DdsError, match="bypass the launch's router") as caught:
        Zenoh().robot_interfaces(ROBOT, None, user)
    assert caught.value.hint
    with pytest.raises(DdsError, match='OFF'):
        Zenoh().environment('/x', {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'off'})
    with pytest.raises(DdsError, match='300'):
        Zenoh(300)


def test_override_that_leaves_nodes_at_their_router_is_allowed() -> None:
    Zenoh().robot_interfaces(ROBOT, None, {
        'ZENOH_CONFIG_OVERRIDE': 'scouting/gossip/autoconnect/peer=["peer"];open/return_mode=1'})

# SPDX-License-Identifier: Apache-2.0
"""Launches on Compute Engine instances, from nothing to messages to nothing."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.timeout(120)

#: What Google may be asked for one launch at the most, from its beginning to its end.
CALLS = 25


def clean(run):
    """Return whether it said nothing that would worry anybody; Ctrl-C is a warning to launch."""
    others = run.text.replace('[WARNING] [launch]: user interrupted with ctrl-c', '')
    return run.errors == [] and 'WARNING' not in others and 'Traceback' not in others


def test_gcp_talker_from_nothing_to_nothing(robot, box, name):
    run = robot.launch('fogros2_examples', 'talker.gcp.launch.py', f'name:={name}')
    run.wait_for(f'I heard: [Hello World from {name} ')
    (instance,) = box.alive()
    assert (instance.type, instance.region) == ('e2-medium', 'us-central1')
    assert instance.tags['fogros2-name'] == name
    # SSH goes through the VPN by now: its rule is gone, everybody else is denied
    (host,) = box.things()['instances']
    assert sorted(box.things()['firewalls']) == [f'{host}-deny', f'{host}-vpn']
    deny = box.firewall(f'{host}-deny')
    assert (deny['denied'], deny['sourceRanges'], deny['targetTags']) == (
        [{'IPProtocol': 'all'}], ['0.0.0.0/0'], [host])
    assert 1000 < deny['priority'] < 65534
    run.interrupt()
    assert run.ended() == 0, run.text
    assert clean(run), run.text
    calls = box.calls()
    assert len(calls) <= CALLS, [call.action for call in calls]

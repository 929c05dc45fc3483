# SPDX-License-Identifier: Apache-2.0
"""The phases of a machine in one launch, and how it ends in each, by value."""

from __future__ import annotations

import pytest

from fogros2.deploy.life import Life, Phase


@pytest.mark.parametrize('phases, phase, lost', [
    ('kept up', 'up', ''),
    ('up ended', 'ended', ''),
    ('up lost lost deleted', 'deleted', 'lost'),
    # what comes too late
    ('up kept', 'up', ''),
    ('up stopped up ended lost', 'stopped', 'stopped')])
def test_machine_goes_from_phase_to_phase(phases: str, phase: Phase, lost: str) -> None:
    life = Life()
    for each in phases.split():
        life = life.then(each, each if each in ('ended', 'lost', 'stopped') else '')  # type: ignore
    assert (life.phase, life.lost) == (phase, lost)


@pytest.mark.parametrize('phase, on_exit, ending, cleaned, closed', [
    ('new', 'keep', 'delete', False, False),
    ('kept', 'keep', 'keep', True, True),
    ('up', 'delete', 'delete', False, False),
    ('up', 'stop', 'stop', False, True),
    ('lost', 'keep', 'keep', True, True),
    ('stopped', 'keep', 'keep', False, False),
    ('deleted', 'stop', 'delete', False, False)])
def test_machine_is_cleaned_up_and_closed_if_it_stays(
        phase: Phase, on_exit: str, ending: str, cleaned: bool, closed: bool) -> None:
    life = Life(phase)
    assert life.ending(on_exit) == ending
    assert life.survives(on_exit, owned=True) == cleaned
    assert life.survives(on_exit, owned=True, stopped=True) == closed
    assert life.survives(on_exit, owned=False) == (phase not in ('stopped', 'deleted'))

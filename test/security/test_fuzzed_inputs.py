# SPDX-License-Identifier: Apache-2.0
"""
Mutated inputs are read or refused: by decoders, agent, gate, dashboard, VPN helper, DDS parsers.

A short run, the same each time; ``benchmarks/security.py`` goes on for minutes.
"""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
pytest.importorskip('cv2', reason='OpenCV (the extra "video") is not installed')
from fogros2.dds.cyclonedds import CycloneDds
from fogros2.dds.fastdds import FastDds, VARIABLE
from fogros2.errors import DdsError
from fogros2.model import DdsInterface
from rigs import fuzz_targets, fuzzing

VPN = [DdsInterface('198.18.7.2')]
#: Bytes that a process may take, with OpenCV and PyAV in it.
LIMIT = 500e6


def test_mutated_inputs_are_read_or_refused() -> None:
    done = subprocess.run(
        [sys.executable, '-m', 'rigs.fuzzing', *fuzz_targets.TARGETS, '1', '--count', '400'],
        capture_output=True, text=True, timeout=300)
    results: list[dict[str, Any]] = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, (results[-1:], done.stderr[-2000:])
    assert {result['target'] for result in results} == {*fuzz_targets.TARGETS}
    for result in results:
        assert result['done'] == 400 and not result['found'], result
        assert result['peak'] < LIMIT


@pytest.mark.parametrize('error, wrong', [
    (KeyError('x'), 'KeyError in fail, test_fuzzed_inputs.py'), (ValueError(), '')])
def test_only_an_unexpected_error_is_a_finding(error: Exception, wrong: str) -> None:
    def fail(data: bytes) -> None:
        raise error

    found = fuzzing.feed(fuzz_targets.Target([], fail, (ValueError,)), b'') or ''
    assert found.rpartition(':')[0] == wrong


def test_dds_configuration_of_another_encoding_is_read(tmp_path: Any) -> None:
    path = tmp_path / 'user.xml'
    path.write_bytes('<?xml version="1.0" encoding="latin-1"?><dds><!-- für --></dds>'.encode(
        'latin-1'))
    assert CycloneDds().robot_interfaces('fog', None, {'CYCLONEDDS_URI': f'file://{path}'})
    assert 'fogros2' in FastDds().render(VPN, [], {VARIABLE: str(path)})


def test_dds_configuration_of_an_unknown_encoding_is_refused(tmp_path: Any) -> None:
    path = tmp_path / 'user.xml'
    path.write_text('<?xml version="1.0" encoding="nonsense"?><dds/>')
    with pytest.raises(DdsError, match='is no XML'):
        FastDds().render(VPN, [], {VARIABLE: str(path)})

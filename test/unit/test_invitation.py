# SPDX-License-Identifier: Apache-2.0
"""Invitations: sealed to one computer, whole, and valid for a time."""

from __future__ import annotations

import base64
import dataclasses
import json
from pathlib import Path
import time

import pytest

from fogros2.errors import ConfigurationError
from fogros2.store import Store
from fogros2_features.guests import invitation
from fogros2_features.guests.invitation import Invitation

KEY = 'nLDHqcSHfnzLjlrO6PdzdSUWfvrWqPqRUQgyn6lKsjw='


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / 'state')


@pytest.fixture
def valid() -> Invitation:
    return Invitation('planner', KEY, '198.18.7.2', '203.0.113.9:50000', '198.18.7.224',
                      '198.18.7.0/24', 'rmw_cyclonedds_cpp', 3, time.time() + 60)


def sealed(store: Store, content: Invitation) -> str:
    return invitation.seal(content, invitation.public_text(invitation.own_key(store)))


def test_invited_computer_reads_what_was_sealed(store: Store, valid: Invitation) -> None:
    text = sealed(store, valid)
    assert invitation.unseal(f' {text[:40]}\n{text[40:]}\n', invitation.own_key(store)) == valid
    assert text.startswith('fog1.') and text != sealed(store, valid)


def test_nothing_of_an_invitation_is_readable(store: Store, valid: Invitation) -> None:
    data = base64.urlsafe_b64decode(sealed(store, valid).removeprefix('fog1.'))
    assert not [word for word in ('planner', '198.18', KEY, 'rmw') if word.encode() in data]


def test_invitation_for_another_computer_is_refused(
    tmp_path: Path, store: Store, valid: Invitation,
) -> None:
    other = invitation.own_key(Store(tmp_path / 'other'))
    with pytest.raises(ConfigurationError, match='another computer'):
        invitation.unseal(sealed(store, valid), other)


@pytest.mark.parametrize('content', [b'', b'\xff', b'AAAA\n', b'no key', b'A' * 43 + b'*='])
def test_damaged_key_of_this_computer_is_reported(store: Store, content: bytes) -> None:
    invitation.own_key(store)
    (store.root / 'key').write_bytes(content)
    with pytest.raises(ConfigurationError, match='/key holds no key') as raised:
        invitation.own_key(store)
    assert 'delete it' in raised.value.hint


def test_each_changed_character_is_noticed(store: Store, valid: Invitation) -> None:
    text, key = sealed(store, valid), invitation.own_key(store)
    for at in range(len(text)):
        changed = text[:at] + ('A' if text[at] != 'A' else 'B') + text[at + 1:]
        with pytest.raises(ConfigurationError):
            invitation.unseal(changed, key)
    for other in ('', 'fog1.', 'fog1.AAAA', text[:60], '\u2603'):
        with pytest.raises(ConfigurationError):
            invitation.unseal(other, key)


def test_expired_invitation_is_refused(store: Store, valid: Invitation) -> None:
    old = dataclasses.replace(valid, expires=time.time() - 1)
    with pytest.raises(ConfigurationError, match="to 'planner' has expired"):
        invitation.unseal(sealed(store, old), invitation.own_key(store))


@pytest.mark.parametrize('change', [
    {'machine': '../planner'}, {'address': '198.18.8.2'}, {'joiner': '198.18.7.2'},
    {'network': '198.18.7.0/33'},
    {'network': '10.255.0.0/24', 'address': '10.255.0.2', 'joiner': '10.255.0.224'},
    {'domain': '3'}, {'domain': 233}, {'expires': 'never'}, {'more': 1}])
def test_content_that_makes_no_sense_is_refused(
    store: Store, valid: Invitation, change: dict[str, object], monkeypatch: pytest.MonkeyPatch,
) -> None:
    content = json.dumps({**dataclasses.asdict(valid), **change})
    monkeypatch.setattr(invitation, 'to_json', lambda data: content)
    with pytest.raises(ConfigurationError, match='no invitation'):
        invitation.unseal(sealed(store, valid), invitation.own_key(store))


def test_key_of_a_computer_stays_and_is_private(store: Store) -> None:
    text = invitation.own_name(store)
    assert text == invitation.own_name(store)
    name, key = invitation.parse_key(f'{text}\n')
    assert name and invitation.parse_key(key) == ('', key)
    assert (store.root / 'key').stat().st_mode & 0o777 == 0o600
    with pytest.raises(ConfigurationError, match='no key'):
        invitation.parse_key('ssh-ed25519 AAAA')

# SPDX-License-Identifier: Apache-2.0
"""The host keys that known_hosts accepts, and the certificates of hosts; made by ssh-keygen."""

from __future__ import annotations

from base64 import b64decode
import subprocess

import pytest

from fogros2 import process
from fogros2.errors import HostKeyError
from fogros2.shell import known_hosts
from fogros2.shell.known_hosts import Known
from fogros2.shell.ssh_config import Settings

pytestmark = pytest.mark.skipif(
    process.which('ssh-keygen') is None, reason='OpenSSH is not installed')
SK = 'sk-ssh-ed25519@openssh.com AAAAGnNrLXNzaC1lZDI1NTE5QG9wZW5zc2guY29t'


def keygen(*words):
    subprocess.run(['ssh-keygen', '-q', *map(str, words)], check=True, capture_output=True)


@pytest.fixture(scope='module')
def keys(tmp_path_factory):
    """Return the folder of keys, and their public halves by name."""
    folder = tmp_path_factory.mktemp('keys')
    for name in ('a', 'b', 'c', 'ca', 'ca2'):
        keygen('-t', 'ed25519', '-N', '', '-C', '', '-f', folder / name)
    keygen('-t', 'ecdsa', '-N', '', '-C', '', '-f', folder / 'ecdsa')
    keygen('-t', 'rsa', '-b', '2048', '-N', '', '-C', '', '-f', folder / 'rsa')
    return folder, {path.stem: path.read_text().strip() for path in folder.glob('*.pub')}


def look_up(tmp_path, text, host='lab.example', port=22, label=''):
    file = tmp_path / 'known_hosts'
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return known_hosts.look_up(Settings(
        host, port, label=label, known_hosts=(str(tmp_path / 'none'), str(file))))


@pytest.mark.parametrize('line', [
    'lab.example {a}', 'LAB.Example {a} a comment', '10.0.0.1,lab.example {a}',
    '*.example {a}', 'l?b.example,!other {a}', '  lab.example\t{a}'])
def test_line_that_openssh_allows_is_accepted(tmp_path, keys, line):
    assert look_up(tmp_path, line.format(**keys[1])) == Known((keys[1]['a'],))


@pytest.mark.parametrize('line', [
    'other {a}', '!lab.example,*.example {a}', '# lab.example {a}', '[lab.example]:2200 {a}',
    'lab.example ssh-ed25519 AAAAdamaged', 'lab.example ssh-ed25519 AAAA', 'lab.example', 'x',
    'lab.example ssh-rsa AAAAC3NzaC1lZDI1NTE5AAAAINhr1xZ0GZJ4Mqbso1vdFbxmsNCtINbcVrdTGUPNy8U9',
    'lab.example 2048 65537 1234', '@unknown lab.example {a}', '@revoked', '\xff\0\x80'])
def test_other_or_damaged_line_is_skipped(tmp_path, keys, line):
    text = f'{line.format(**keys[1])}\nlab.example {keys[1]["b"]}\n'
    assert look_up(tmp_path, text.encode('latin-1')) == Known((keys[1]['b'],))


def test_hashed_names_are_found_in_any_case(tmp_path, keys):
    file = tmp_path / 'known_hosts'
    file.write_text(f'lab.example {keys[1]["a"]}\n[lab.example]:2200 {keys[1]["b"]}\n')
    keygen('-H', '-f', file)
    text = file.read_text()
    assert 'lab' not in text
    assert look_up(tmp_path, text, 'LAB.example') == Known((keys[1]['a'],))
    assert look_up(tmp_path, text, port=2200) == Known((keys[1]['b'],))


def test_markers_and_other_types_are_told_apart(tmp_path, keys):
    _, public = keys
    assert look_up(tmp_path, (
        f'@cert-authority *.example {public["ca"]}\n@revoked * {public["b"]}\n'
        f'lab.example {public["a"]}\nlab.example {public["ecdsa"]}\nlab.example {SK}\n')) == Known(
            (public['a'], public['ecdsa'], SK), (public['ca'],), (public['b'],))


def test_key_of_the_host_holds_at_its_other_ports(tmp_path, keys):
    _, public = keys
    text = f'lab.example {public["a"]}\n@revoked lab.example {public["b"]}\n'
    assert look_up(tmp_path, text, port=2200) == Known((public['a'],), (), (public['b'],))
    text += f'[lab.example]:2200 {public["c"]}\n'
    assert look_up(tmp_path, text, port=2200).keys == (public['c'],)
    assert look_up(tmp_path, f'gpu {public["c"]}\n', port=2200, label='gpu').keys == (public['c'],)


def test_file_that_cannot_be_read_is_an_error(tmp_path):
    with pytest.raises(HostKeyError, match='can not be read: Is a directory'):
        known_hosts.look_up(Settings('lab', known_hosts=(str(tmp_path),)))


def test_file_that_cannot_be_read_matters_to_no_known_host(tmp_path, keys):
    file = tmp_path / 'global'
    file.write_text(f'lab {keys[1]["a"]}\n')
    assert known_hosts.look_up(Settings('lab', known_hosts=(str(tmp_path), str(file)))) == Known(
        (keys[1]['a'],))


def certificate(keys, tmp_path, *words, kind='a', authority='ca'):
    """Return a certificate that ``authority`` signs for a host's key."""
    file = tmp_path / 'host.pub'
    file.write_text(keys[1][kind])
    keygen('-s', keys[0] / authority, '-I', 'id', *words, file)
    return b64decode((tmp_path / 'host-cert.pub').read_text().split()[1])


def fault(keys, blob, **known):
    given = {'authorities': (keys[1]['ca'],), **known}
    return known_hosts.fault_of(blob, 'lab.example', Known(**given))


@pytest.mark.parametrize('kind', ['a', 'ecdsa', 'rsa'])
@pytest.mark.parametrize('authority', ['ca', 'ecdsa', 'rsa'])
def test_certificate_of_a_known_authority_is_valid(keys, tmp_path, kind, authority):
    blob = certificate(
        keys, tmp_path, '-h', '-n', 'x,lab.example', kind=kind, authority=authority)
    assert fault(keys, blob, authorities=(keys[1][authority],)) == ''
    changed = blob.replace(b'lab.example', b'Lab.example')
    assert fault(keys, changed, authorities=(keys[1][authority],)) == 'has a wrong signature'


@pytest.mark.parametrize(('words', 'expected'), [
    (('-h', '-n', '*.example'), ''),
    (('-h', '-n', 'lab.?xample'), ''),
    (('-h', '-V', '-1d:+1d'), ''),
    (('-h', '-n', 'other.example'), 'is for other.example'),
    (('-h', '-n', '[l]ab.example'), r'is for [l]ab.example'),
    (('-h', '-V', '-2d:-1d'), 'is not valid now'),
    (('-h', '-V', '+1d:+2d'), 'is not valid now'),
    (('-n', 'lab.example'), 'is not for hosts')])
def test_certificate_holds_for_its_names_and_time(keys, tmp_path, words, expected):
    assert fault(keys, certificate(keys, tmp_path, *words)) == expected


def test_certificate_of_another_authority_decides_nothing(keys, tmp_path):
    blob = certificate(keys, tmp_path, '-h', authority='ca2')
    assert fault(keys, blob) is None
    assert fault(keys, blob, revoked=(keys[1]['ca2'],)) == 'is of a revoked authority'


@pytest.mark.parametrize('change', [
    lambda blob: b'\0\0\0\1\xff' + blob,
    lambda blob: blob.replace(b'lab.example', b'lab\xffexample')])
def test_damaged_certificate_is_refused(keys, tmp_path, change):
    blob = certificate(keys, tmp_path, '-h', '-n', 'lab.example')
    assert fault(keys, change(blob)) == 'is damaged'


def test_certificate_with_a_sha_1_signature_is_refused(keys, tmp_path):
    blob = certificate(keys, tmp_path, '-h', '-t', 'ssh-rsa', authority='rsa')
    assert fault(keys, blob, authorities=(keys[1]['rsa'],)) == 'has a wrong signature'


def test_certificate_with_an_unknown_critical_option_is_refused(keys, tmp_path):
    """OpenSSH defines none for hosts, and refuses those that it does not know."""
    blob = certificate(keys, tmp_path, '-h', '-O', 'critical:only-on@example.com=monday')
    assert fault(keys, blob) == 'is not for hosts'

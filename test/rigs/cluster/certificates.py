# SPDX-License-Identifier: Apache-2.0
"""Keys and certificates of a test's own, valid for a day."""

from __future__ import annotations

from collections.abc import Iterable
import dataclasses
import datetime
import ipaddress

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_DAY = datetime.timedelta(days=1)


@dataclasses.dataclass(frozen=True)
class Pair:
    """A certificate and its private key, both PEM."""

    certificate: bytes
    key: bytes


class Authority:
    """A certificate authority that lives as long as this object: its key is written nowhere."""

    def __init__(self, name: str) -> None:
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = _name(name)
        public = self._key.public_key()
        self._certificate = _builder(self._name, self._name, public).add_extension(
            x509.BasicConstraints(ca=True, path_length=0), critical=True,
        ).add_extension(_usage(signs=True), critical=True).add_extension(
            x509.SubjectKeyIdentifier.from_public_key(public), critical=False,
        ).sign(self._key, hashes.SHA256())

    @property
    def certificate(self) -> bytes:
        """Return what clients have to trust, PEM."""
        return self._certificate.public_bytes(serialization.Encoding.PEM)

    def issue(self, name: str, hosts: Iterable[str] = ()) -> Pair:
        """
        Return a certificate for a server or client.

        :param hosts: names and addresses that a server answers to.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        builder = _builder(_name(name), self._name, key.public_key()).add_extension(
            x509.BasicConstraints(ca=False, path_length=None), critical=True,
        ).add_extension(_usage(signs=False), critical=True).add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH,
                                   ExtendedKeyUsageOID.CLIENT_AUTH]), critical=False,
        ).add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(
            self._key.public_key()), critical=False)
        answers = [_general_name(host) for host in hosts]
        if answers:
            builder = builder.add_extension(x509.SubjectAlternativeName(answers), critical=False)
        certificate = builder.sign(self._key, hashes.SHA256())
        return Pair(certificate.public_bytes(serialization.Encoding.PEM), _pem(key))


def rsa_key() -> bytes:
    """Return a new private key, PEM: what a cluster signs its service accounts' tokens with."""
    return _pem(rsa.generate_private_key(public_exponent=65537, key_size=2048))


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True, content_commitment=False, key_encipherment=not signs,
        data_encipherment=False, key_agreement=False, key_cert_sign=signs, crl_sign=signs,
        encipher_only=False, decipher_only=False)


def _builder(
    subject: x509.Name, issuer: x509.Name, public: ec.EllipticCurvePublicKey,
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.timezone.utc)
    return x509.CertificateBuilder(
        issuer_name=issuer, subject_name=subject, public_key=public,
        serial_number=x509.random_serial_number(),
        # clocks of a cluster's parts may differ
        not_valid_before=now - _DAY / 24, not_valid_after=now + _DAY)


def _pem(key: ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.TraditionalOpenSSL,
        serialization.NoEncryption())

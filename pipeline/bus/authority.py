"""Makes certificates: a site's authority, and what it signs. Keys are created unreadable for others; no file is ever
half written, and none is replaced unless asked.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, EllipticCurvePrivateKey, generate_private_key
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fantwin.pipeline.bus.certificates import in_words
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import PRIVATE, PUBLIC, replace_file

LONGEST_ROLE = 64
"""characters of a common name"""
CLOCK_SKEW = timedelta(minutes=5)
"""a certificate holds from so long before it was made: clocks of hosts differ"""
_LABEL = r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
_HOST_NAME = re.compile(rf"(\*\.)?{_LABEL}(\.{_LABEL})*")
_LONGEST_HOST = 253


class Authority:
    """A site's authority, with its private key."""

    def __init__(self, certificate: x509.Certificate, key: EllipticCurvePrivateKey) -> None:
        self.certificate = certificate
        self._key = key

    @classmethod
    def new(cls, site: str, lifetime: timedelta) -> Authority:
        """Make one."""
        key = generate_private_key(SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"fantwin {site}"[:LONGEST_ROLE])])
        usage = _key_usage(signs=True)
        builder = (
            _begun(name, name, key, lifetime)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
        )
        return cls(builder.sign(key, hashes.SHA256()), key)

    @classmethod
    def read(cls, folder: Path) -> Authority:
        """Read one from its folder.

        Raises:
            UserError: it is not there, or cannot be used.
        """
        try:
            certificate = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
            key = load_pem_private_key((folder / "ca.key").read_bytes(), password=None)
        except OSError as error:
            raise UserError(
                f"{folder}: no authority here ({error.strerror}): `fantwin certs init` makes one"
            ) from error
        except (ValueError, TypeError) as error:
            raise UserError(f"{folder}: ca.pem or ca.key cannot be used: {error}") from error
        if not isinstance(key, EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
            raise UserError(f"{folder}: ca.key is not the key of ca.pem")
        if certificate.not_valid_after_utc <= datetime.now(UTC):
            end = in_words(certificate.not_valid_after_utc)
            raise UserError(f"{folder}: the authority expired on {end}: `fantwin certs init --replace` makes a new one")
        return cls(certificate, key)

    def write(self, folder: Path, *, replace: bool) -> None:
        """Write certificate and key into a folder that others cannot open.

        Raises:
            UserError: it cannot be written, or there is one and `replace` is False.
        """
        write_pair(folder / "ca.pem", folder / "ca.key", self.certificate, self._key, replace=replace)
        with suppress(OSError):
            folder.chmod(0o700)

    def issue(
        self, role: str, hosts: Sequence[str], lifetime: timedelta
    ) -> tuple[x509.Certificate, EllipticCurvePrivateKey]:
        """A certificate for a role, which ends with the authority at the latest, and its key."""
        key = generate_private_key(SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, role)])
        left = self.certificate.not_valid_after_utc - datetime.now(UTC)
        usages = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]  # a peer both connects and listens
        signer = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        builder = (
            _begun(name, self.certificate.subject, key, min(lifetime, left))
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
            .add_extension(x509.SubjectAlternativeName([_alternative(host) for host in hosts]), critical=False)
            .add_extension(signer, critical=False)
        )
        return builder.sign(self._key, hashes.SHA256()), key


def is_host(text: str) -> bool:
    """Whether a certificate can be for this name or address of a host."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return len(text) <= _LONGEST_HOST and _HOST_NAME.fullmatch(text) is not None
    return "%" not in text


def write_pair(
    certificate: Path, key: Path, signed: x509.Certificate, private: EllipticCurvePrivateKey, *, replace: bool
) -> None:
    """Write a certificate and its key.

    Raises:
        UserError: they cannot be written, or one exists and `replace` is False.
    """
    if not replace:
        for path in (certificate, key):
            if path.exists():
                raise UserError(f"{path} exists: --replace makes a new one in its place")
    text = private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    write_file(key, text, is_private=True)
    write_file(certificate, signed.public_bytes(Encoding.PEM), is_private=False)


def write_file(path: Path, content: bytes, *, is_private: bool) -> None:
    """Put a whole file in its place; a private one is never readable by others, not for a moment.

    Raises:
        UserError: it cannot be written.
    """
    try:
        path.parent.mkdir(mode=0o700 if is_private else 0o755, parents=True, exist_ok=True)
        replace_file(path, content, PRIVATE if is_private else PUBLIC)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from error


def _begun(
    subject: x509.Name, issuer: x509.Name, key: EllipticCurvePrivateKey, lifetime: timedelta
) -> x509.CertificateBuilder:
    now = datetime.now(UTC).replace(microsecond=0)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_SKEW)
        .not_valid_after(now + lifetime)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _key_usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs,
        crl_sign=signs,
        encipher_only=False,
        decipher_only=False,
    )


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)

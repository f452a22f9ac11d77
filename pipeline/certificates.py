"""Certificates of TLS: making, writing, reading and checking them.

Every part that shows or checks a certificate uses this module: the bus, the page, samples over HTTP, OPC UA, MQTT.
What cannot be used is refused in one line that names the file, says why, and never asks for a password.
"""

from __future__ import annotations

import ipaddress
import os
import re
import ssl
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_der_private_key,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import PRIVATE, PUBLIC, closed_to, is_read_by_others, write_whole

LONGEST_NAME = 64
"""characters of a common name"""
CLOCK_SKEW = timedelta(minutes=5)
"""A certificate is valid from this long before it is made: clocks of hosts differ."""
SELF_SIGNED_LIFETIME = timedelta(days=3650)
RSA_BITS = 2048
"""OPC UA's Basic256Sha256 allows 2048 to 4096."""
WARN_BEFORE = timedelta(days=30)
WARN_SHARE = 0.2
"""of its lifetime: a certificate for an hour is not warned of from the first minute"""
_LABEL = r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
_HOST_NAME = re.compile(rf"(\*\.)?{_LABEL}(\.{_LABEL})*")
_LONGEST_HOST = 253
_USAGES = (ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH)  # a peer both connects and listens
_SIGNATURE = ("digital_signature",)
_OF_OPCUA = ("digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_cert_sign")
_OF_AUTHORITY = ("digital_signature", "key_cert_sign", "crl_sign")

Key = ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey
Parsed = TypeVar("Parsed")


@dataclass(frozen=True)
class Certificate:
    """What a certificate says.

    Attributes:
        role: its common name; empty if it has none.
        hosts: the names and addresses at which its owner may listen.
        uris: the URIs of its owner, such as the application URI of OPC UA.
        is_authority: whether it may sign others.
        issuer: the common name of the authority that signed it.
    """

    path: Path
    role: str
    hosts: tuple[str, ...]
    uris: tuple[str, ...]
    not_before: datetime
    not_after: datetime
    is_authority: bool
    issuer: str

    def time_problem(self, now: datetime) -> str:
        """Say that it has expired or is not valid yet; empty if it may be used now."""
        if now >= self.not_after:
            return f"{self.path}: expired on {in_words(self.not_after)}"
        if now < self.not_before:
            return f"{self.path}: not valid before {in_words(self.not_before)}: is the clock of this host right?"
        return ""

    def warning(self, now: datetime) -> str:
        """Say that it expires soon or may not be used; else empty."""
        early = min(WARN_BEFORE, (self.not_after - self.not_before) * WARN_SHARE)
        if (problem := self.time_problem(now)) or now < self.not_after - early:
            return problem
        hours = (self.not_after - now).total_seconds() / 3600
        left = f"{hours / 24:.0f} days" if hours >= 48 else f"{hours:.0f} hours"
        return f"{self.path}: expires in {left}, on {in_words(self.not_after)}"


def read_certificate(path: Path) -> Certificate:
    """Describe the first certificate of a file, PEM or DER.

    Raises:
        UserError: it cannot be read.
    """
    return _described(path, _certificate(path))


def check_pair(certificate: Path, key: Path, ca: Path | None = None, *, needs_rsa: bool = False) -> Certificate:
    """Describe a certificate whose key its owner can use. It may have expired: see `require_valid`.

    Args:
        certificate: PEM or DER.
        key: its private key, without a password, which only its owner may read.
        ca: the certificate of the authority that must have signed it; None: any.
        needs_rsa: whether only an RSA key will do.

    Raises:
        UserError: a file cannot be read or used, or they do not belong together.
    """
    own = _certificate(certificate)
    try:
        if is_read_by_others(key.stat()):
            raise UserError(f"{key}: others may read this private key: chmod 600 {key}")
        private = _parsed(
            key, lambda text: load_pem_private_key(text, None), lambda text: load_der_private_key(text, None), "key"
        )
    except PermissionError as error:
        raise UserError(f"{key}: {closed_to(key, os.geteuid())}") from error
    except OSError as error:
        raise UserError(f"{key}: {error.strerror}") from error
    except TypeError as error:
        raise UserError(
            f"{key}: the key has a password, which nobody is asked for: `openssl pkey -in KEY -out NEW` takes it out"
        ) from error
    if private.public_key() != own.public_key():
        raise UserError(f"{key}: not the key of the certificate {certificate}")
    if needs_rsa and not isinstance(private, rsa.RSAPrivateKey):
        raise UserError(f"{key}: no RSA key, which OPC UA needs")
    if ca is not None:
        try:
            own.verify_directly_issued_by(_certificate(ca))
        except (ValueError, TypeError, InvalidSignature) as error:
            raise UserError(
                f"{certificate}: not signed by the authority of {ca}: use the certificates of one site together"
            ) from error
    return _described(certificate, own)


def require_valid(*certificates: Certificate) -> None:
    """Raises:
    UserError: one has expired, or is not valid yet.
    """
    now = datetime.now(UTC)
    for each in certificates:
        if problem := each.time_problem(now):
            raise UserError(problem)


def server_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """TLS of a server.

    Raises:
        UserError: a file cannot be used.
    """
    check_pair(certificate, key)
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    _load_chain(context, certificate, key)
    return context


def client_context(ca: Path | None, certificate: Path | None, key: Path | None) -> ssl.SSLContext:
    """TLS of a client that checks certificate and host of its server.

    Args:
        ca: the authority to trust; None: those of the system.
        certificate: what the client shows; None: nothing.
        key: the key of that certificate.

    Raises:
        UserError: a file cannot be used, or the client's certificate is not valid now.
    """
    try:
        context = ssl.create_default_context(cafile=ca)
    except OSError as error:
        raise UserError(f"{ca}: {error.strerror or error}") from error
    if certificate is not None and key is not None:
        require_valid(check_pair(certificate, key))
        _load_chain(context, certificate, key)
    return context


def tls_refusal(error: ssl.SSLError, server: str) -> str:
    """Say why a client gets no connection by TLS, and what to check. server: what it is, such as "broker"."""
    if isinstance(error, ssl.SSLCertVerificationError):
        advice = f"{error.verify_message}: check ca, and that the host is a name in the certificate of the {server}"
    else:
        advice = f"check port, and whether the {server} has TLS there: if not, mqtt:// in url"
    return f"no connection by TLS: {error.strerror or error}; {advice}"


class Authority:
    """A site's authority, with its private key."""

    def __init__(self, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
        self.certificate = certificate
        self._key = key

    @classmethod
    def new(cls, site: str, lifetime: timedelta) -> Authority:
        """Make one."""
        key = ec.generate_private_key(ec.SECP256R1())
        name = _named(f"fantwin {site}"[:LONGEST_NAME])
        return cls(_signed(name, key, (name, key), lifetime, _OF_AUTHORITY), key)

    @classmethod
    def read(cls, folder: Path) -> Authority:
        """Read one from its folder.

        Raises:
            UserError: it is not there, or cannot be used.
        """
        ca, key = folder / "ca.pem", folder / "ca.key"
        if not ca.exists():
            raise UserError(f"{folder}: no authority here: `fantwin certs init` makes one")
        if problem := check_pair(ca, key).time_problem(datetime.now(UTC)):
            raise UserError(f"{problem}: `fantwin certs init --replace` makes a new authority")
        private = load_pem_private_key(key.read_bytes(), None)
        if not isinstance(private, ec.EllipticCurvePrivateKey):
            raise UserError(f"{key}: not made by `fantwin certs init`")
        return cls(_certificate(ca), private)

    def write(self, folder: Path, *, replace: bool) -> None:
        """Write certificate and key into a folder that others cannot open.

        Raises:
            UserError: it cannot be written, or there is one and `replace` is False.
        """
        write_pair(folder / "ca.pem", folder / "ca.key", self.certificate, self._key, replace=replace)
        with suppress(OSError):
            folder.chmod(0o700)

    def issue(self, role: str, hosts: Sequence[str], lifetime: timedelta) -> tuple[x509.Certificate, Key]:
        """Make a certificate for a role, which ends with the authority at the latest, and its key."""
        key = ec.generate_private_key(ec.SECP256R1())
        until_the_end = min(lifetime, self.certificate.not_valid_after_utc - datetime.now(UTC))
        signer, names = (self.certificate.subject, self._key), [_alternative(host) for host in hosts]
        return _signed(_named(role), key, signer, until_the_end, _SIGNATURE, names), key


def make_self_signed(certificate: Path, key: Path, name: str, uri: str, hosts: Sequence[str]) -> None:
    """Write a certificate that signs itself, and its RSA key, unless both are there: who trusts it goes on doing so.

    Raises:
        UserError: they cannot be written.
    """
    if certificate.exists() and key.exists():
        return
    private = rsa.generate_private_key(public_exponent=65537, key_size=RSA_BITS)
    names = [x509.UniformResourceIdentifier(uri), *map(_alternative, dict.fromkeys(hosts))]
    signed = _signed(_named(name), private, (_named(name), private), SELF_SIGNED_LIFETIME, _OF_OPCUA, names)
    write_pair(certificate, key, signed, private, replace=True)


def write_pair(certificate: Path, key: Path, signed: x509.Certificate, private: Key, *, replace: bool) -> None:
    """Write a certificate, in DER if its file is called so, and its key, which is never readable by others, not for a
    moment.

    Raises:
        UserError: they cannot be written, or one exists and `replace` is False.
    """
    for path in (certificate, key):
        if path.exists() and not replace:
            raise UserError(f"{path} exists: --replace makes a new one in its place")
    encoding = Encoding.DER if certificate.suffix == ".der" else Encoding.PEM
    write_whole(key, private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), "", PRIVATE)
    write_whole(certificate, signed.public_bytes(encoding), "", PUBLIC)


def is_host(text: str) -> bool:
    """Whether a certificate can be for this name or address of a host."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return len(text) <= _LONGEST_HOST and _HOST_NAME.fullmatch(text) is not None
    return "%" not in text


def in_words(time: datetime) -> str:
    """A point in time for people: UTC, to the minute."""
    return f"{time:%Y-%m-%d %H:%M} UTC"


def _signed(
    subject: x509.Name,
    key: Key,
    signer: tuple[x509.Name, Key],
    lifetime: timedelta,
    usages: Sequence[str],
    names: Sequence[x509.GeneralName] = (),
) -> x509.Certificate:
    """A certificate. signer: name and key. usages: those of an authority make one. names: of its owner."""
    is_authority = usages == _OF_AUTHORITY
    now = datetime.now(UTC).replace(microsecond=0)
    known = ("key_agreement", "encipher_only", "decipher_only", *_OF_OPCUA, *_OF_AUTHORITY)
    extensions: list[tuple[x509.ExtensionType, bool]] = [
        (x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False),
        (x509.AuthorityKeyIdentifier.from_issuer_public_key(signer[1].public_key()), False),
        (x509.BasicConstraints(ca=is_authority, path_length=0 if is_authority else None), True),
        (x509.KeyUsage(**{usage: usage in usages for usage in known}), True),
    ]
    if not is_authority:
        extensions += [(x509.ExtendedKeyUsage(_USAGES), False), (x509.SubjectAlternativeName(names), False)]
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(signer[0])
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_SKEW)
        .not_valid_after(now + lifetime)
    )
    for extension, is_critical in extensions:
        builder = builder.add_extension(extension, critical=is_critical)
    return builder.sign(signer[1], hashes.SHA256())


def _named(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        return x509.DNSName(host)


def _certificate(path: Path) -> x509.Certificate:
    return _parsed(path, x509.load_pem_x509_certificate, x509.load_der_x509_certificate, "certificate")


def _parsed(path: Path, pem: Callable[[bytes], Parsed], der: Callable[[bytes], Parsed], what: str) -> Parsed:
    try:
        content = path.read_bytes()
        return (pem if b"-----BEGIN" in content else der)(content)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        raise UserError(f"{path}: no {what} in PEM or DER") from error


def _load_chain(context: ssl.SSLContext, certificate: Path, key: Path) -> None:
    try:
        context.load_cert_chain(certificate, key)
    except OSError as error:  # DER, or a key that OpenSSL finds too weak
        raise UserError(f"{certificate}, {key}: {error.strerror or error}") from error


def _described(path: Path, certificate: x509.Certificate) -> Certificate:
    names = _extension(certificate, x509.SubjectAlternativeName)
    basic = _extension(certificate, x509.BasicConstraints)
    uris = names.get_values_for_type(x509.UniformResourceIdentifier) if names else []
    return Certificate(
        path,
        _common_name(certificate.subject),
        tuple(str(each.value) for each in names or () if str(each.value) not in uris),
        tuple(uris),
        certificate.not_valid_before_utc,
        certificate.not_valid_after_utc,
        basic is not None and basic.ca,
        _common_name(certificate.issuer),
    )


def _extension(certificate: x509.Certificate, kind: type[Any]) -> Any:
    try:
        return certificate.extensions.get_extension_for_class(kind).value
    except x509.ExtensionNotFound:
        return None


def _common_name(name: x509.Name) -> str:
    values = [str(each.value) for each in name.get_attributes_for_oid(NameOID.COMMON_NAME)]
    return values[0] if values else ""

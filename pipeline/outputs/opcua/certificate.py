"""The certificate with which the server shows who it is."""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_der_private_key,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fantwin.pipeline.errors import UserError

VALID_DAYS = 3650
KEY_BITS = 2048
"""Basic256Sha256 allows 2048 to 4096"""


def make_certificate(certificate: Path, key: Path, application_uri: str, names: Sequence[str]) -> None:
    """Write both unless they are there: clients that trust the server go on doing so after a restart.

    Raises:
        UserError: they cannot be written.
    """
    try:
        if not (certificate.exists() and key.exists()):
            certificate.parent.mkdir(parents=True, exist_ok=True)
            _make(certificate, key, application_uri, names)
    except OSError as error:
        raise UserError(f"{certificate}: the certificate cannot be written: {error.strerror}") from error


def check_certificate(certificate: Path, key: Path) -> None:
    """Raises:
    UserError: these are no certificate and its RSA key, or it is over.
    """
    what = f"opcua.certificate = {str(certificate)!r}, opcua.key = {str(key)!r}"
    try:
        found = certificate.read_bytes()
        is_pem = found.startswith(b"-----")
        parsed = x509.load_pem_x509_certificate(found) if is_pem else x509.load_der_x509_certificate(found)
        secret = key.read_bytes()
        load = load_pem_private_key if secret.startswith(b"-----") else load_der_private_key
        private = load(secret, None)
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"{what}: {getattr(error, 'strerror', None) or error}") from error
    if not isinstance(private, rsa.RSAPrivateKey) or parsed.public_key() != private.public_key():
        raise UserError(f"{what}: the key is not the RSA key of the certificate")
    if parsed.not_valid_after_utc < datetime.now(UTC):
        raise UserError(f"{what}: the certificate is over since {parsed.not_valid_after_utc:%Y-%m-%d}")


def check_port(host: str, port: int) -> None:
    """Raises:
    UserError: the port is taken, or the address is not of this host.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as listening:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind(address)
            listening.listen(1)
    except OSError as error:
        where = f"opcua.host = {host!r}, opcua.port = {port}"
        raise UserError(f"{where}: cannot listen there ({error.strerror}): choose another one") from error


def _make(certificate: Path, key: Path, application_uri: str, names: Sequence[str]) -> None:
    private = rsa.generate_private_key(public_exponent=65537, key_size=KEY_BITS)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "fantwin OPC UA server")])
    now = datetime.now(UTC)
    usage = x509.KeyUsage(
        digital_signature=True,
        content_commitment=True,
        key_encipherment=True,
        data_encipherment=True,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )
    extended = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
    named = [x509.UniformResourceIdentifier(application_uri), *map(_general_name, {socket.gethostname(), *names})]
    identifier = x509.SubjectKeyIdentifier.from_public_key(private.public_key())
    made = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(private.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(days=VALID_DAYS))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(extended, critical=False)
        .add_extension(x509.SubjectAlternativeName(named), critical=False)
        .add_extension(identifier, critical=False)
        .sign(private, hashes.SHA256())
    )
    secret = private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    key.unlink(missing_ok=True)
    with os.fdopen(os.open(key, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(secret)
    certificate.write_bytes(made.public_bytes(Encoding.DER))


def _general_name(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name.strip("[]")))
    except ValueError:
        return x509.DNSName(name)

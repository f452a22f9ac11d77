"""Certificates of processes: what they say, and what keeps one from being used. No Zenoh here.

The common name of a certificate is a role, as `scorer` or `acquisition.tray1` (`pipeline.config.roles`).
"""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import NameOID

from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.config.models import ROLE_PLACE, SecurityConfig

WARN_BEFORE = timedelta(days=30)
WARN_SHARE = 0.2
"""of its lifetime: a certificate for an hour is not warned of from the first minute"""
_OTHERS, _GROUP_OR_OTHERS = 0o007, 0o077


@dataclass(frozen=True)
class Certificate:
    """What a certificate says.

    Attributes:
        role: its common name.
        hosts: the names and addresses at which its owner may listen.
        is_authority: it signs others.
        issuer: the common name of the authority that signed it.
    """

    path: Path
    role: str
    hosts: tuple[str, ...]
    not_before: datetime
    not_after: datetime
    is_authority: bool
    issuer: str

    def time_problem(self, now: datetime) -> str:
        """That it has expired or is not valid yet; empty if it may be used now."""
        if now >= self.not_after:
            return f"{self.path}: expired on {in_words(self.not_after)}: {_renew(self)}"
        if now < self.not_before:
            return f"{self.path}: not valid before {in_words(self.not_before)}: is the clock of this host right?"
        return ""

    def warning(self, now: datetime) -> str:
        """That it expires soon, or may not be used; else empty."""
        early = min(WARN_BEFORE, (self.not_after - self.not_before) * WARN_SHARE)
        if (problem := self.time_problem(now)) or now < self.not_after - early:
            return problem
        return f"{self.path}: expires {_left(self.not_after - now)}, on {in_words(self.not_after)}: {_renew(self)}"


@dataclass(frozen=True)
class Credentials:
    """The files that a process uses, checked, and what its certificate and that of its authority say."""

    ca: Path
    certificate: Path
    key: Path
    own: Certificate
    authority: Certificate

    @property
    def role(self) -> str:
        """The role that the certificate gives its owner."""
        return self.own.role

    def warning(self) -> str:
        """That a certificate expires soon or has expired; else empty."""
        now = datetime.now(UTC)
        return self.own.warning(now) or self.authority.warning(now)


def read_certificate(path: Path) -> Certificate:
    """What the first certificate of a PEM file says.

    Raises:
        BusError: it cannot be read, or is no certificate with a common name.
    """
    return _described(path, _loaded(path))


def checked_credentials(security: SecurityConfig, roles: Sequence[str]) -> Credentials:
    """The files of a process, of the first of these roles that has a certificate here.

    Raises:
        BusError: a file is missing or cannot be used: one line that says which, why, and what to do.
    """
    places = {role: of_role(security.certificate, role) for role in roles}
    role = next((each for each, path in places.items() if path.exists()), "")
    if not role:
        names = " or ".join(map(str, dict.fromkeys(places.values())))
        raise BusError(f"{names}: no such certificate: `fantwin certs issue` makes it")
    ca, certificate, key = (of_role(path, role) for path in (security.ca, security.certificate, security.key))
    parent, own = _loaded(ca), _loaded(certificate)
    _require_private(key)
    try:
        private = load_pem_private_key(_content(key), password=None)
    except (ValueError, TypeError) as error:
        raise BusError(f"{key}: no private key in PEM without a password: `fantwin certs issue {role}`") from error
    if private.public_key() != own.public_key():
        raise BusError(f"{key}: does not match {certificate}: `fantwin certs issue {role} --replace` makes both")
    try:
        own.verify_directly_issued_by(parent)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise BusError(
            f"{certificate}: not signed by the authority of {ca}: use the certificates of one site together"
        ) from error
    described, authority = _described(certificate, own), _described(ca, parent)
    now = datetime.now(UTC)
    if problem := described.time_problem(now) or authority.time_problem(now):
        raise BusError(problem)
    return Credentials(ca, certificate, key, described, authority)


def of_role(path: Path, role: str) -> Path:
    """A path of `bus.security` for one role."""
    return Path(str(path).replace(ROLE_PLACE, role))


def in_words(time: datetime) -> str:
    """A point in time for people: UTC, to the minute."""
    return f"{time:%Y-%m-%d %H:%M} UTC"


def _loaded(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(_content(path))
    except ValueError as error:
        raise BusError(f"{path}: no certificate in PEM") from error


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise BusError(f"{path}: {error.strerror}: `fantwin certs issue` makes it") from error


def _require_private(key: Path) -> None:
    """As ssh and PostgreSQL do: only its owner may read it, or the group as well if it belongs to root, as where a
    cluster hands it to a container."""
    try:
        status = key.stat()
    except OSError as error:
        raise BusError(f"{key}: {error.strerror}: `fantwin certs issue` makes it") from error
    forbidden = _OTHERS if status.st_uid == 0 != os.geteuid() else _GROUP_OR_OTHERS
    if stat.S_IMODE(status.st_mode) & forbidden:
        raise BusError(f"{key}: others may read this private key: chmod 600 {key}")


def _described(path: Path, certificate: x509.Certificate) -> Certificate:
    role = _common_name(certificate.subject)
    if not role:
        raise BusError(f"{path}: a certificate without a common name, which would name its role")
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        hosts = tuple(str(each.value) for each in names)
    except x509.ExtensionNotFound:
        hosts = ()
    try:
        constraints = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
        is_authority = constraints.ca
    except x509.ExtensionNotFound:
        is_authority = False
    return Certificate(
        path,
        role,
        hosts,
        certificate.not_valid_before_utc,
        certificate.not_valid_after_utc,
        is_authority,
        _common_name(certificate.issuer),
    )


def _common_name(name: x509.Name) -> str:
    values = [str(each.value) for each in name.get_attributes_for_oid(NameOID.COMMON_NAME)]
    return values[0] if values else ""


def _left(time: timedelta) -> str:
    hours = time.total_seconds() / 3600
    return f"in {hours / 24:.0f} days" if hours >= 48 else f"in {hours:.0f} hours"


def _renew(certificate: Certificate) -> str:
    if certificate.is_authority:
        return "`fantwin certs init --replace` makes a new authority, and `issue --replace` new certificates"
    return f"`fantwin certs renew {certificate.role}`, and restart its process"

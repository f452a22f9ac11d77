"""The certificate that a process shows on the bus, and the check of it.

Its common name is a role, as `scorer` or `acquisition.tray1` (`pipeline.config.roles`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.certificates import Certificate, check_pair, read_certificate, require_valid
from fantwin.pipeline.config.settings import SecurityConfig
from fantwin.pipeline.errors import UserError


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
        """Say that a certificate expires soon or has expired; else empty."""
        return warning(self.own) or warning(self.authority)


def checked_credentials(security: SecurityConfig, roles: Sequence[str]) -> Credentials:
    """The files of a process, of the first of these roles that has a certificate here.

    Raises:
        BusError: a file is missing or cannot be used: one line that says which, why, and what to do.
    """
    places = {role: security.certificate(role) for role in roles}
    role = next((each for each, path in places.items() if path.exists()), "")
    if not role:
        names = " or ".join(map(str, dict.fromkeys(places.values())))
        raise BusError(f"{names}: no such certificate: `fantwin certs issue` makes it")
    ca, certificate, key = security.ca, security.certificate(role), security.key(role)
    try:
        own, authority = check_pair(certificate, key, ca), read_certificate(ca)
    except UserError as error:
        raise BusError(str(error)) from error
    for each in (own, authority):
        if not each.role:
            raise BusError(f"{each.path}: a certificate without a common name, which would name its role")
        try:
            require_valid(each)
        except UserError as error:
            raise BusError(f"{error}: {_renewal(each)}") from error
    return Credentials(ca, certificate, key, own, authority)


def warning(certificate: Certificate) -> str:
    """Say that a certificate of the bus expires soon or may not be used, and what renews it; else empty."""
    found = certificate.warning(datetime.now(UTC))
    return f"{found}: {_renewal(certificate)}" if found else ""


def _renewal(certificate: Certificate) -> str:
    if certificate.is_authority:
        return "`fantwin certs init --replace` makes a new authority, and `issue --replace` new certificates"
    return f"`fantwin certs renew {certificate.role}`, and restart its process"

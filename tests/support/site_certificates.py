"""Certificates of a site for tests: an authority, and what it signs."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

from cryptography.hazmat.primitives.serialization import Encoding

from fantwin.pipeline.certificates import Authority, write_pair
from fantwin.pipeline.config.settings import SecurityConfig
from fantwin.pipeline.files import write_whole

HOSTS = ("localhost", "127.0.0.1")
DAY = timedelta(days=1)


class SiteCertificates:
    """A folder with an authority's certificate, and certificates by role."""

    def __init__(self, folder: Path, authority: Authority | None = None, *, is_new: bool = True) -> None:
        """is_new: write the authority's certificate; otherwise the files are there, and only used."""
        self.folder = folder
        self.authority = authority or Authority.new("site", 10 * DAY)
        if is_new:
            write_whole(folder / "ca.pem", self.authority.certificate.public_bytes(Encoding.PEM))
        self.security = SecurityConfig(folder=folder)

    def issue(self, *roles: str, lifetime: timedelta = 5 * DAY, authority: Authority | None = None) -> None:
        """Make the certificates of these roles."""
        for role in roles:
            signed, key = (authority or self.authority).issue(role, HOSTS, lifetime)
            write_pair(self.security.certificate(role), self.security.key(role), signed, key, replace=True)

    def show_as(self, role: str, other: str) -> None:
        """Let whoever is of a role show the certificate of another one."""
        for of_role in (self.security.certificate, self.security.key):
            of_role(role).write_bytes(of_role(other).read_bytes())

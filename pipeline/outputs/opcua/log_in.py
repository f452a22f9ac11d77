"""Who logs in, and what he may do."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import USER_TYPES, PermissionRuleset, UserRole
from asyncua.crypto.permission_rules import User as LibraryUser
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from fantwin.pipeline.site.login_failures import LoginFailures
from fantwin.pipeline.site.security_log import SecurityLog
from fantwin.pipeline.site.users import User, Users
from fantwin.pipeline.site.users import UserRole as SiteRole


@dataclass
class SessionUser(LibraryUser):
    """may_act: whether he is an operator. name: empty for whoever is not logged in."""

    may_act: bool = False
    password_hash: str = ""
    """with which he has logged in"""


class Permissions(PermissionRuleset):
    """Which services are open: nobody writes, and nobody changes the address space."""

    def __init__(self, log_in: LogIn) -> None:
        self._log_in = log_in
        refused = {ua.ObjectIds.WriteRequest_Encoding_DefaultBinary}
        self._open = {ua.NodeId(kind) for kind in USER_TYPES if kind not in refused}

    def check_validity(self, user: Any, action_type: ua.NodeId, body: Any) -> bool:
        """Whether a service is open to a user, who may have been removed since he logged in."""
        return action_type in self._open and self._log_in.may_read(user)


class TrustedClients:
    """The certificates in a folder, read again when somebody connects."""

    def __init__(self, folder: Path | None) -> None:
        """folder: None: all clients are trusted."""
        self._folder = folder

    def trusts(self, certificate: bytes) -> bool:
        """Whether a client's certificate (DER) is among them."""
        if self._folder is None:
            return True
        for path in sorted(self._folder.glob("*")):
            try:
                found = path.read_bytes()
                is_pem = found.startswith(b"-----")
                der = x509.load_pem_x509_certificate(found).public_bytes(Encoding.DER) if is_pem else found
            except (OSError, ValueError):
                continue
            if secrets.compare_digest(der, certificate):
                return True
        return False


class LogIn:
    """Who has which password."""

    def __init__(self, users: Users | None, *, is_open: bool) -> None:
        """is_open: whoever does not log in may read."""
        self._users = users
        self._is_open = is_open
        self._failures = LoginFailures()
        self._log = SecurityLog()

    @property
    def problem(self) -> str:
        """What is wrong with the file of users; empty if nothing is."""
        return self._users.problem if self._users else ""

    def is_operator(self, who: object) -> bool:
        """Whether he is one now: the file may have changed since he logged in. who: the user of a session."""
        found = self._still(who)
        return found is not None and found.role == SiteRole.OPERATOR

    def may_read(self, who: object) -> bool:
        """Whether he may still read; for whoever is not logged in: whether anybody may."""
        return self._is_open or self._still(who) is not None

    def _still(self, who: object) -> User | None:
        """The user with whose password somebody has logged in; None: there is none, or he has another one now."""
        if self._users is None or not isinstance(who, SessionUser) or not who.name:
            return None
        found = self._users.of(who.name)
        return found if found is not None and found.password_hash == who.password_hash else None

    def log_untrusted(self, address: str) -> None:
        """A client has come whose certificate is not among the trusted ones."""
        self._log.add("client refused: its certificate is not in the folder `trusted`", by="OPC UA", address=address)

    def user(self, name: str | None, password: str | None, address: str) -> SessionUser | None:
        """Who logs in; None: nobody does.

        Raises:
            ServiceError: he has guessed too often.
        """
        if name is None:
            return SessionUser(UserRole.User, "") if self._is_open else None
        if self._users is None:
            return None
        self._users.of(name)
        if self._users.problem:
            self._log.add("login refused: the file of users cannot be read", by="OPC UA", user=name, address=address)
            return None
        if self._failures.begin(name, address):
            self._log.add("login refused: too many wrong passwords", by="OPC UA", user=name, address=address)
            raise ServiceError(ua.StatusCodes.BadUserAccessDenied)
        user = self._users.verified(name, password or "")
        if user is None:
            self._log.add("login refused: wrong name or password", by="OPC UA", user=name, address=address)
            return None
        self._failures.succeed(name, address)
        self._log.add("login", by="OPC UA", user=user.name, role=str(user.role), address=address)
        return SessionUser(UserRole.User, user.name, user.role == SiteRole.OPERATOR, user.password_hash)

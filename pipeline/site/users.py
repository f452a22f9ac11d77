"""The users of a site, who look and act on the page or by OPC UA, and the tokens by which programs do so without a
login: one file, with the role of each, and the hash of its password or token.

Passwords are hashed with argon2id, whose parameters are those of the library (RFC 9106, low-memory profile). A token is
256 random bits, so a plain hash of it tells nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import PRIVATE, closed_to, is_read_by_others, replace_file

if TYPE_CHECKING:
    from argon2 import PasswordHasher

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
SHORTEST_PASSWORD, LONGEST_PASSWORD = 12, 128
"""characters"""
GUESSED_WORDS = ("fantwin", "password", "operator", "viewer", "ventilator", "admin")
"""with the name of the user, these do not count in a password"""
FEWEST_OTHERS = 5
PREFIX = "fantwin_"
"""begins each token: scanners of leaked secrets find it"""
_OF_USER, _OF_TOKEN = {"role", "password_hash"}, {"role", "sha256", "expires"}


class UserRole(StrEnum):
    """What a user may do."""

    VIEWER = "viewer"
    OPERATOR = "operator"


@dataclass(frozen=True)
class User:
    """One of them."""

    name: str
    role: UserRole
    password_hash: str


@dataclass(frozen=True)
class Token:
    """Token of a program. expires: UTC; None: never."""

    name: str
    role: UserRole
    sha256: str
    expires: datetime | None

    def is_valid(self, now_s: float) -> bool:
        """Whether it has not ended."""
        return self.expires is None or now_s < self.expires.timestamp()


@dataclass
class Accounts:
    """What a file holds, by name; no token has the name of a user."""

    users: dict[str, User] = field(default_factory=dict[str, User])
    tokens: dict[str, Token] = field(default_factory=dict[str, Token])


class Users:
    """The file, read again when it changes. While it is missing, or others may read it, there is nobody."""

    def __init__(self, path: Path, now_s: Callable[[], float] = time.time) -> None:
        """Read it.

        Raises:
            UserError: it cannot be read, others may read it, or it is no such file.
        """
        self._path, self._now_s = path, now_s
        self._hasher = hasher()
        self._nobody_hash = self._hasher.hash("nobody has this password")
        self._stamp: tuple[int, ...] = ()
        self._accounts = Accounts()
        self._by_hash: dict[str, Token] = {}
        self.problem = ""
        """why the file cannot be read; empty if it can"""
        self._read()

    def of(self, name: str) -> User | None:
        """A user; None: there is none of this name."""
        self._read_again()
        return self._accounts.users.get(name)

    def of_token(self, text: str) -> Token | None:
        """The token that a program has sent; None: it is none, or has ended."""
        self._read_again()
        found = self._by_hash.get(_hashed(text))
        return found if found and found.is_valid(self._now_s()) else None

    def verified(self, name: str, password: str) -> User | None:
        """The user with this name and password; None: there is none. It takes as long for a name that is not there."""
        user = self.of(name)
        return user if self.is_password(user, password) else None

    def is_password(self, user: User | None, password: str) -> bool:
        """Whether it is that of a user; for nobody it takes as long. In any thread."""
        from argon2.exceptions import Argon2Error, InvalidHashError  # noqa: PLC0415  slow to import

        try:
            given = password if len(password) <= LONGEST_PASSWORD else ""
            self._hasher.verify(user.password_hash if user else self._nobody_hash, given)
        except (Argon2Error, InvalidHashError):
            return False
        return user is not None

    def _read_again(self) -> None:
        try:
            self._read()
            self.problem = ""
        except UserError as error:
            self._stamp, self._accounts, self._by_hash = (), Accounts(), {}
            self.problem = f"nobody can log in or act, with a token neither: {error}"

    def _read(self) -> None:
        try:
            found = self._path.stat()
        except OSError as error:
            raise _unreadable(self._path, error) from error
        stamp = (found.st_mtime_ns, found.st_ctime_ns, found.st_ino)  # a change of its rights sets st_ctime_ns alone
        if stamp != self._stamp:
            self._accounts = read_accounts(self._path)
            self._by_hash = {each.sha256: each for each in self._accounts.tokens.values()}
            self._stamp = stamp


def hasher() -> PasswordHasher:
    """What hashes passwords."""
    from argon2 import PasswordHasher  # noqa: PLC0415  slow to import

    return PasswordHasher()


def new_token(name: str, role: UserRole, expires: datetime | None) -> tuple[str, Token]:
    """A token and what is kept of it."""
    text = PREFIX + secrets.token_urlsafe(32)
    return text, Token(name, role, _hashed(text), expires)


def read_accounts(path: Path) -> Accounts:
    """What a file holds.

    Raises:
        UserError: as `Users`.
    """
    try:
        with path.open("rb") as file:
            if is_read_by_others(os.fstat(file.fileno())):
                raise UserError(f"{path}: others may read it: chmod 600 {path}")
            tables = tomllib.load(file)
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise _unreadable(path, error) from error
    found = Accounts()
    for name, table in tables.items():
        made = _account(path, name, table)
        if isinstance(made, Token):
            found.tokens[name] = made
        else:
            found.users[name] = made
    return found


def write_accounts(path: Path, accounts: Accounts, beside: Path | None = None) -> None:
    """Replace the file as a whole; only its owner may read it.

    beside: a new file gets the owner of this folder, where the process may say so: root adds users for a service.

    Raises:
        UserError: it cannot be written.
    """
    lines = ["# users and tokens of the site: `fantwin users`\n"]
    for name, user in sorted(accounts.users.items()):
        lines.append(f"\n[{json.dumps(name)}]\nrole = {json.dumps(user.role)}\n")
        lines.append(f"password_hash = {json.dumps(user.password_hash)}\n")
    for name, token in sorted(accounts.tokens.items()):
        expires = token.expires.isoformat() if token.expires else ""
        lines.append(f"\n[{json.dumps(name)}]\nrole = {json.dumps(token.role)}\n")
        lines.append(f'sha256 = "{token.sha256}"\nexpires = "{expires}"\n')
    is_new = not path.exists()
    try:
        replace_file(path, "".join(lines).encode(), PRIVATE)
        if is_new and beside is not None and os.geteuid() == 0:
            owner = beside.stat()
            os.chown(path, owner.st_uid, owner.st_gid)
    except OSError as error:
        raise UserError(f"{path}: the users cannot be written: {error.strerror}") from error


def checked_password(password: str, name: str) -> str:
    """The password, if it is one for this user.

    Raises:
        UserError: it is too short or too long, or easy to guess.
    """
    if not SHORTEST_PASSWORD <= len(password) <= LONGEST_PASSWORD:
        raise UserError(
            f"the password has {len(password)} characters: it must have {SHORTEST_PASSWORD} to {LONGEST_PASSWORD}"
        )
    rest = password.casefold()
    for word in (name.casefold(), *GUESSED_WORDS):
        rest = rest.replace(word, "")
    if len(set(rest)) < FEWEST_OTHERS:
        raise UserError(
            f"the password is easy to guess: it needs {FEWEST_OTHERS} different characters beside the name and "
            f"{', '.join(GUESSED_WORDS)}"
        )
    return password


def _hashed(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _unreadable(path: Path, error: Exception) -> UserError:
    if isinstance(error, FileNotFoundError):
        return UserError(f"{path}: there is no such file: `fantwin users add NAME` makes it")
    if isinstance(error, PermissionError):
        return UserError(f"{path}: {closed_to(path, os.geteuid())}")
    return UserError(f"{path}: the users cannot be read: {getattr(error, 'strerror', None) or error}")


def _account(path: Path, name: str, table: Any) -> User | Token:
    try:
        if not NAME.fullmatch(name) or set(table) not in (_OF_USER, _OF_TOKEN):
            raise ValueError
        role = UserRole(table["role"])
        if "sha256" not in table:
            return User(name, role, str(table["password_hash"]))
        expires = datetime.fromisoformat(table["expires"]).astimezone(UTC) if table["expires"] else None
        return Token(name, role, str(table["sha256"]), expires)
    except (TypeError, ValueError) as error:
        raise UserError(
            f"{path}: [{name}] is no user and no token: make it again with `fantwin users add` or `add-token`"
        ) from error

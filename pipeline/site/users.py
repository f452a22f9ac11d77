"""The users of a site, who look and act on the page or by OPC UA: a file with role and password hash of each.

Passwords are hashed with argon2id, whose parameters are those of the library (RFC 9106, low-memory profile).
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import PRIVATE, is_read_by_others, replace_file

if TYPE_CHECKING:
    from argon2 import PasswordHasher

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
SHORTEST_PASSWORD, LONGEST_PASSWORD = 12, 128
"""characters"""
GUESSED_WORDS = ("fantwin", "password", "operator", "viewer", "ventilator", "admin")
"""with the name of the user, these do not count in a password"""
FEWEST_OTHERS = 5
_ENTRIES = {"role", "password_hash"}


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


class Users:
    """The file, read again when it changes. While it is missing, or others may read it, there are no users."""

    def __init__(self, path: Path) -> None:
        """Read it.

        Raises:
            UserError: it cannot be read, others may read it, or it is no such file.
        """
        self._path = path
        self._hasher = hasher()
        self._nobody_hash = self._hasher.hash("nobody has this password")
        self._stamp: tuple[int, ...] = ()
        self._users: Mapping[str, User] = {}
        self.problem = ""
        """why the file cannot be read; empty if it can"""
        self._read()

    def of(self, name: str) -> User | None:
        """A user; None: there is none of this name."""
        try:
            self._read()
            self.problem = ""
        except UserError as error:
            self._stamp, self._users = (), {}
            self.problem = f"nobody can log in or act: {error}"
        return self._users.get(name)

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

    def _read(self) -> None:
        try:
            found = self._path.stat()
        except OSError as error:
            raise _unreadable(self._path, error) from error
        stamp = (found.st_mtime_ns, found.st_ctime_ns, found.st_ino)  # a change of its rights sets st_ctime_ns alone
        if stamp != self._stamp:
            self._users = read_users(self._path)
            self._stamp = stamp


def hasher() -> PasswordHasher:
    """What hashes passwords."""
    from argon2 import PasswordHasher  # noqa: PLC0415  slow to import

    return PasswordHasher()


def read_private_tables(path: Path) -> dict[str, Any]:
    """The tables of a TOML file that only its owner may read.

    Raises:
        UserError: others may read it.
        OSError, TOMLDecodeError, UnicodeDecodeError: it cannot be read.
    """
    with path.open("rb") as file:
        if is_read_by_others(os.fstat(file.fileno())):
            raise UserError(f"{path}: others may read it: chmod 600 {path}")
        return tomllib.load(file)


def write_private_tables(path: Path, lines: Iterable[str], what: str) -> None:
    """Replace such a file as a whole. what: is in it, for errors.

    Raises:
        UserError: it cannot be written.
    """
    try:
        replace_file(path, "".join(lines).encode(), PRIVATE)
    except OSError as error:
        raise UserError(f"{path}: the {what} cannot be written: {error.strerror}") from error


def read_users(path: Path) -> dict[str, User]:
    """All users of a file, by name.

    Raises:
        UserError: as `Users`.
    """
    try:
        tables = read_private_tables(path)
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise _unreadable(path, error) from error
    return {name: _user(path, name, table) for name, table in tables.items()}


def write_users(path: Path, users: Mapping[str, User]) -> None:
    """Replace the file as a whole; only its owner may read it.

    Raises:
        UserError: it cannot be written.
    """
    lines = ["# users of the site: `fantwin users`\n"]
    for name, user in sorted(users.items()):
        lines.append(f"\n[{json.dumps(name)}]\nrole = {json.dumps(user.role)}\n")
        lines.append(f"password_hash = {json.dumps(user.password_hash)}\n")
    write_private_tables(path, lines, "users")


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


def _unreadable(path: Path, error: Exception) -> UserError:
    if isinstance(error, FileNotFoundError):
        return UserError(f"{path}: there is no such file: `fantwin users add NAME` makes it")
    return UserError(f"{path}: the users cannot be read: {getattr(error, 'strerror', None) or error}")


def _user(path: Path, name: str, table: Any) -> User:
    known = [role.value for role in UserRole]
    if not (isinstance(table, dict) and set(table) == _ENTRIES and table["role"] in known and NAME.fullmatch(name)):
        raise UserError(f"{path}: [{name}] is no user: it needs role ({' or '.join(known)}) and password_hash")
    return User(name, UserRole(table["role"]), str(table["password_hash"]))

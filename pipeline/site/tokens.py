"""Tokens of programs, which read the site or act on it without a login: a file beside that of the users, with role,
hash and end of each.

A token is 256 random bits, so a plain hash of it tells nothing (passwords need a slow one).
"""

from __future__ import annotations

import hashlib
import json
import secrets
import time
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.users import NAME, UserRole, read_private_tables, write_private_tables

PREFIX = "fantwin_"
"""begins each token: scanners of leaked secrets find it"""
_ENTRIES = {"role", "sha256", "expires"}


@dataclass(frozen=True)
class Token:
    """One of them. expires: UTC; None: never."""

    name: str
    role: UserRole
    sha256: str
    expires: datetime | None

    def is_valid(self, now_s: float) -> bool:
        """Whether it has not ended."""
        return self.expires is None or now_s < self.expires.timestamp()


class Tokens:
    """The file, read again when it changes. Without it, or while others may read it, there are no tokens."""

    def __init__(self, users: Path, now_s: Callable[[], float] = time.time) -> None:
        """users: the file of users, beside which it lies."""
        self._path, self._now_s = tokens_file(users), now_s
        self._stamp: tuple[int, ...] = ()
        self._by_hash: Mapping[str, Token] = {}
        self.problem = ""
        """why the file cannot be read; empty if it can"""

    def of(self, text: str) -> Token | None:
        """The token that a program has sent; None: it is none, or has ended."""
        try:
            self._read()
            self.problem = ""
        except UserError as error:
            self._stamp, self._by_hash = (), {}
            self.problem = f"no token is accepted: {error}"
        found = self._by_hash.get(_hashed(text))
        return found if found and found.is_valid(self._now_s()) else None

    def _read(self) -> None:
        try:
            found = self._path.stat()
        except FileNotFoundError:
            self._stamp, self._by_hash = (), {}
            return
        except OSError as error:
            raise _unreadable(self._path, error) from error
        stamp = (found.st_mtime_ns, found.st_ctime_ns, found.st_ino)
        if stamp != self._stamp:
            self._by_hash = {each.sha256: each for each in read_tokens(self._path).values()}
            self._stamp = stamp


def tokens_file(users: Path) -> Path:
    """`users.tokens.toml` beside `users.toml`."""
    return users.with_suffix(".tokens.toml")


def new_token(name: str, role: UserRole, expires: datetime | None) -> tuple[str, Token]:
    """A token and what is kept of it."""
    text = PREFIX + secrets.token_urlsafe(32)
    return text, Token(name, role, _hashed(text), expires)


def read_tokens(path: Path) -> dict[str, Token]:
    """All tokens of a file, by name; none if there is no file.

    Raises:
        UserError: it cannot be read, others may read it, or it is no such file.
    """
    try:
        tables = read_private_tables(path)
    except FileNotFoundError:
        return {}
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise _unreadable(path, error) from error
    return {name: _token(path, name, table) for name, table in tables.items()}


def write_tokens(path: Path, tokens: Mapping[str, Token]) -> None:
    """Replace the file as a whole; only its owner may read it.

    Raises:
        UserError: it cannot be written.
    """
    lines = ["# tokens of programs: `fantwin users add-token`\n"]
    for name, token in sorted(tokens.items()):
        expires = token.expires.isoformat() if token.expires else ""
        lines.append(f"\n[{json.dumps(name)}]\nrole = {json.dumps(token.role)}\n")
        lines.append(f'sha256 = "{token.sha256}"\nexpires = "{expires}"\n')
    write_private_tables(path, lines, "tokens")


def _hashed(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _unreadable(path: Path, error: Exception) -> UserError:
    return UserError(f"{path}: the tokens cannot be read: {getattr(error, 'strerror', None) or error}")


def _token(path: Path, name: str, table: Any) -> Token:
    try:
        if set(table) != _ENTRIES or not NAME.fullmatch(name):
            raise ValueError
        expires = datetime.fromisoformat(table["expires"]).astimezone(UTC) if table["expires"] else None
        return Token(name, UserRole(table["role"]), str(table["sha256"]), expires)
    except (TypeError, ValueError) as error:
        raise UserError(f"{path}: [{name}] is no token: make it again with `fantwin users add-token`") from error

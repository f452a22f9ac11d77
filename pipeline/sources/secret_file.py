"""A secret that a stage needs, such as a password: from a file that only its owner reads.

A configuration is in every recording, so that it names where a secret is and never holds one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Self
from urllib.parse import SplitResult, unquote, urlsplit

from pydantic import BaseModel, Field, field_validator, model_validator

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import is_read_by_others


class LogIn(BaseModel, frozen=True):
    """The address of a server, who logs in there, and where the password is.

    A subclass says what its URL is.
    """

    schemes: ClassVar[Mapping[str, int]]
    """schemes of its URL, with the port of each"""

    url: str
    password_file: Path | None = Field(
        default=None,
        description="file whose first line is the password, readable by its owner alone; or a folder of such: HOST, "
        "`default`",
    )

    @property
    def host(self) -> str:
        """Name or address of the server."""
        return self.parts.hostname or ""

    @property
    def port(self) -> int:
        """Port of the server."""
        return self.parts.port or self.schemes[self.parts.scheme]

    @property
    def username(self) -> str:
        """User that logs in; empty: nobody does."""
        return unquote(self.parts.username or "")

    @property
    def parts(self) -> SplitResult:
        """The parts of the URL."""
        return urlsplit(self.url)

    @field_validator("url")
    @classmethod
    def _is_address(cls, value: str) -> str:
        try:
            parts = urlsplit(value)
            is_address = parts.scheme in cls.schemes and parts.hostname and parts.port != 0
            has_path = parts.path.strip("/") and ("@" in parts.path or not parts.scheme.startswith("http"))
        except ValueError:
            is_address = has_path = False
        if not is_address or has_path or re.search(r"[\s?#]", value):  # what is cut off may be of a password
            raise ValueError(f"write the address of the server alone, such as {list(cls.schemes)[-1]}://HOST")
        if urlsplit(value).password is not None:
            raise ValueError("a configuration is recorded: give password_file, and only the user in url")
        return value

    @model_validator(mode="after")
    def _password_of_a_user(self) -> Self:
        if self.password_file and not self.username:
            raise ValueError(f"password_file needs a user in url, such as {self.parts.scheme}://USER@{self.host}")
        return self

    def password(self, folder: Path) -> str | None:
        """The password; None: there is none. folder: relative paths start here.

        Raises:
            UserError: it cannot be read.
        """
        path = self.password_path(folder)
        return read_secret(path) if path else None

    def password_path(self, folder: Path) -> Path | None:
        """The file with the password; None: there is none."""
        path = folder / self.password_file if self.password_file else None
        if path and path.is_dir():
            return path / (self.host if (path / self.host).exists() else "default")
        return path


def read_secret(path: Path) -> str:
    """The first line of a file.

    Raises:
        UserError: it cannot be read, is empty, or others may read it.
    """
    try:
        with path.open(encoding="utf-8") as file:
            if is_read_by_others(os.fstat(file.fileno())):
                raise UserError(f"{path}: others may read it: chmod 600 {path}")
            secret = file.readline().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not secret:
        raise UserError(f"{path}: its first line is empty")
    return secret

"""A secret that a stage needs, such as a password: from a file that only its owner reads, or from the environment.

A configuration is in every recording, so that it names where a secret is and never holds one.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Self

from pydantic import BaseModel, Field, model_validator

from fantwin.pipeline.errors import UserError

OTHERS = 0o077


class LogIn(BaseModel, frozen=True):
    """Who logs in, and where the password is."""

    username: str = Field(default="", description="user that logs in; without it, nobody does")
    password_file: Path | None = Field(
        default=None, description="file with the password in its first line; only its owner may be able to read it"
    )
    password_env: str = Field(
        default="", description="instead of password_file: environment variable that holds the password"
    )

    @model_validator(mode="after")
    def _one_password_of_a_user(self) -> Self:
        if self.password_file and self.password_env:
            raise ValueError("give password_file or password_env, not both")
        if (self.password_file or self.password_env) and not self.username:
            raise ValueError("a password needs username")
        return self

    def password(self, folder: Path, process: str = "acquisition") -> str | None:
        """The password; None: there is none. folder: relative paths start here. process: that needs it.

        Raises:
            UserError: it cannot be read, or is not set.
        """
        if self.password_file:
            return read_secret(folder / self.password_file)
        return secret_of_environment(self.password_env, process) if self.password_env else None


def read_secret(path: Path) -> str:
    """The first line of a file.

    Raises:
        UserError: it cannot be read, is empty, or others may read it.
    """
    try:
        with path.open(encoding="utf-8") as file:
            if os.fstat(file.fileno()).st_mode & OTHERS:
                raise UserError(f"{path}: others may read it: chmod 600 {path}")
            secret = file.readline().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not secret:
        raise UserError(f"{path}: its first line is empty")
    return secret


def secret_of_environment(name: str, stage: str = "acquisition") -> str:
    """A variable of the environment. stage: the one that needs it.

    Raises:
        UserError: it is not set.
    """
    secret = os.environ.get(name, "")
    if not secret:
        raise UserError(f"the environment has no {name}: set it for the process of {stage}")
    return secret

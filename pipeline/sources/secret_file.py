"""A secret that a stage needs, such as a password: from a file that only its owner reads, or from the environment."""

from __future__ import annotations

import os
from pathlib import Path

from fantwin.pipeline.errors import UserError

OTHERS = 0o077


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

"""Adds the twin of a tray to the text of a configuration; all else stays as its user wrote it."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

from pipeline.config.models import ConfigError

_HEADER = re.compile(r"^([ \t]*)\[\[[ \t]*tray[ \t]*\]\][^\r\n]*(\r?)$", re.MULTILINE)


def with_twin(text: str, twin: str, path: Path) -> str:
    """The text of a configuration with one tray, which gets this twin. path: the file, for the error.

    Raises:
        ConfigError: there is no place for it that is certain to be right, so its user has to add it.
    """
    entry = f"twin = {json.dumps(twin, ensure_ascii=False)}"
    added = _HEADER.sub(lambda found: f"{found[0]}\n{found[1]}{entry}{found[2]}", text, count=1)
    try:
        wanted, got = tomllib.loads(text), tomllib.loads(added)
        (tray,) = wanted["tray"]
        is_right = "twin" not in tray and got == wanted | {"tray": [tray | {"twin": twin}]}
    except (tomllib.TOMLDecodeError, KeyError, ValueError, TypeError):
        is_right = False
    if not is_right:
        raise ConfigError(f"{path}: {entry} cannot be added: write its tray as one section [[tray]] without twin")
    return added

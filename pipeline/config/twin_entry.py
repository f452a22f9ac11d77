"""Adds the twin of a tray to a configuration; all else stays as its user wrote it."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from fantwin.pipeline.config.settings import Config, ConfigError
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import replace_file

_HEADER = re.compile(r"^([ \t]*)\[\[[ \t]*tray[ \t]*\]\][^\r\n]*(\r?)$", re.MULTILINE)


def with_twin(text: str, tray: str, twin: str, path: Path) -> str:
    """The text of a configuration in which the tray of this name gets this twin. path: the file, for the error.

    Raises:
        ConfigError: there is no place for it that is certain to be right, so its user has to add it.
    """
    entry = f"twin = {json.dumps(twin, ensure_ascii=False)}"
    wanted = _table_with_twin(text, tray, twin)
    for header in _HEADER.finditer(text):
        end = header.end()
        added = f"{text[:end]}\n{header[1]}{entry}{header[2]}{text[end:]}"
        if wanted is not None and _table(added) == wanted:
            return added
    raise ConfigError(f"{path}: {entry} cannot be added: write tray {tray} as one section [[tray]] without twin")


def write_twin(settings: Config, tray: str, twin: Path) -> str:
    """Write the twin of a tray into the configuration; returns its path as it is written there.

    Raises:
        UserError: the file cannot be changed.
    """
    resolved, folder = twin.resolve(), settings.folder.resolve()
    entry = str(resolved.relative_to(folder)) if resolved.is_relative_to(folder) else str(resolved)
    path = settings.path.resolve()
    try:
        text = with_twin(
            path.read_bytes().decode(), tray, entry, settings.path
        )  # its user may have edited it meanwhile
        replace_file(path, text.encode())
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f'{settings.path}: cannot be changed ({error}): add twin = "{entry}" to tray {tray}') from error
    return entry


def _table_with_twin(text: str, name: str, twin: str) -> dict[str, Any] | None:
    """What the text says, with the twin; None if it has not exactly one tray of this name, or that names a twin."""
    table = _table(text) or {}
    try:
        (tray,) = (tray for tray in table["tray"] if tray["name"] == name)
    except (KeyError, ValueError, TypeError):
        return None
    if "twin" in tray:
        return None
    tray["twin"] = twin
    return table


def _table(text: str) -> dict[str, Any] | None:
    """What a text says; None if it is not TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None

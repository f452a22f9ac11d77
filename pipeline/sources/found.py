"""What `fantwin init` finds: devices whose fans could be watched, each as a [[tray]] of a configuration."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Found:
    """Possible tray: a chip with fans, a serial port, a controller.

    Attributes:
        kind: of its source.
        title: one line.
        tray: the keys of its [[tray]]; empty if it cannot be one.
        notes: what to know of it.
        missing: what keeps it from being watched, or commanded, and what to do.
    """

    kind: str
    title: str
    tray: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    @property
    def fans(self) -> int:
        """The number of fans of the tray."""
        fans = self.tray.get("fans", self.tray.get("fan", ()))
        return fans if isinstance(fans, int) else len(fans)

    @property
    def toml(self) -> str:
        """The [[tray]], with what to know as comments; empty if it cannot be one."""
        if not self.tray:
            return ""
        lines = [f"# {line}" for line in (self.title, *self.notes, *self.missing)]
        return "\n".join(["[[tray]]", *lines, *(f"{key} = {as_toml(value)}" for key, value in self.tray.items()), ""])


def free_name(wanted: str, names: set[str]) -> str:
    """A name of a tray that none of `names` is, which it joins; as near to the wanted one as the rules allow."""
    base = re.sub(r"[^A-Za-z0-9_-]", "-", wanted) or "tray"
    name, number = base, 1
    while name in names:
        number += 1
        name = f"{base}-{number}"
    names.add(name)
    return name


def as_toml(value: object) -> str:
    """A value of a configuration as TOML writes it."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {as_toml(each)}' for key, each in value.items())} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(as_toml, value))}]"
    if isinstance(value, str) and '"' in value and "'" not in value and value.isprintable():
        return f"'{value}'"
    return json.dumps(value, ensure_ascii=False)  # texts, numbers and booleans are alike in both

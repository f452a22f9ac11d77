"""Single keys from a terminal, without Return. The terminal's mode is restored however the program ends."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from contextlib import suppress
from enum import Enum
from types import TracebackType
from typing import Any, Self


class Key(Enum):
    """The keys and their actions."""

    PAUSE = "space"
    STEP = "right or s"
    FASTER = "up"
    SLOWER = "down"
    QUIT = "q"


_KEYS = {
    b" ": Key.PAUSE,
    b"s": Key.STEP,
    b"q": Key.QUIT,
    # terminals send arrows in one of two forms
    **{start + b"C": Key.STEP for start in (b"\x1b[", b"\x1bO")},
    **{start + b"A": Key.FASTER for start in (b"\x1b[", b"\x1bO")},
    **{start + b"B": Key.SLOWER for start in (b"\x1b[", b"\x1bO")},
}


class KeyParser:
    """Bytes to keys. An incomplete arrow is kept until the rest arrives; other bytes are ignored."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Key]:
        """The keys that these bytes complete."""
        rest, keys = self._rest + data, []
        while rest:
            known = next((known for known in _KEYS if rest.startswith(known)), None)
            if known is None and any(known.startswith(rest) for known in _KEYS):
                break
            if known is not None:
                keys.append(_KEYS[known])
            rest = rest[len(known) if known else 1 :]
        self._rest = rest
        return keys


class Keys:
    """Keys pressed on standard input, if it is a terminal with this process in the foreground."""

    def __init__(self) -> None:
        self._descriptor: int | None = None
        self._before: list[Any] = []
        self._parser = KeyParser()
        with suppress(OSError, ValueError):  # standard input is closed or has no descriptor
            descriptor = sys.stdin.fileno()
            if os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp():
                self._descriptor = descriptor

    @property
    def is_available(self) -> bool:
        """Whether keys can be pressed."""
        return self._descriptor is not None

    def __enter__(self) -> Self:
        if self._descriptor is not None:
            self._before = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._descriptor is not None:
            with suppress(termios.error):  # the terminal was closed
                termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def pressed(self) -> list[Key]:
        """The keys pressed since the last call."""
        found: list[Key] = []
        while self._descriptor is not None and select.select([self._descriptor], [], [], 0)[0]:
            try:
                data = os.read(self._descriptor, 1024)
            except OSError:
                data = b""
            if not data:  # the terminal was closed
                self._descriptor = None
            found += self._parser.feed(data)
        return found

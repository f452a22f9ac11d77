"""Single keys from a terminal, without Return. The terminal's mode is restored however the program ends."""

from __future__ import annotations

import os
import re
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


_ARROWS = {b"C": Key.STEP, b"A": Key.FASTER, b"B": Key.SLOWER}
_LETTERS = {b" ": Key.PAUSE, b"s": Key.STEP, b"q": Key.QUIT}
_KEYS = re.compile(rb"\x1b[\[O]([ABC])|([ sq])")
"""terminals send arrows in one of two forms"""


class Keys:
    """Keys pressed on standard input, if it is a terminal with this process in the foreground."""

    def __init__(self) -> None:
        self._descriptor: int | None = None
        self._before: list[Any] = []
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
            found += keys_in(data)
        return found


def keys_in(data: bytes) -> list[Key]:
    """The keys that a terminal has sent; other bytes are ignored."""
    return [_ARROWS.get(arrow) or _LETTERS[letter] for arrow, letter in _KEYS.findall(data)]

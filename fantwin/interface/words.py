"""Warnings for the caller, and the errors of the pipeline in the words of Python."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fantwin.pipeline.errors import FantwinError

TEMPORARY = "fantwin-python-"
"""beginning of the names of temporary folders, which no message shows"""
_HERE = str(Path(__file__).parent)
_OPTION = re.compile(r"--([a-z][a-z-]*)")
_COMMAND = re.compile(r"\bfantwin (train|calibrate)\b")
_TEMPORARY = re.compile(rf"\S*{TEMPORARY}[^/\s]+/(?:table-(\d+)\.mcap)?")
_TACHO = re.compile(r'`tacho = \{ kind = "(\w+)"(?:, )?(.*?) \}` in \[\[tray\]\]')


class FantwinWarning(UserWarning):
    """What a result leaves out or takes for granted; `warnings.simplefilter("error")` makes it an exception."""


FantwinWarning.__module__ = "fantwin"


def warn(lines: Iterable[str]) -> None:
    """Give a warning for each line, at the line of the program that called."""
    level, frame = 1, sys._getframe()
    while frame.f_back and (frame.f_code.co_filename.startswith(_HERE) or "contextlib" in frame.f_code.co_filename):
        level, frame = level + 1, frame.f_back
    for line in lines:
        warnings.warn(_of_python(line), FantwinWarning, stacklevel=level)


@contextmanager
def in_python() -> Iterator[None]:
    """Errors of the pipeline and of the model maker as one of fantwin, whose options are arguments."""
    from fantwin.twin.errors import TwinError  # noqa: PLC0415  only then twin is loaded

    try:
        yield
    except (FantwinError, TwinError) as error:
        raise FantwinError(_of_python(str(error))) from None


def _of_python(line: str) -> str:
    """A line of the pipeline without options of commands, keys of a configuration and temporary files."""
    line = _TEMPORARY.sub(lambda found: f"table {found[1]}" if found[1] else "", line)
    line = _TACHO.sub(lambda found: f'`tacho="{found[1]}:{found[2].replace(" ", "")}"`', line)
    line = _COMMAND.sub(r"fantwin.\1", line.replace("; correct [[tray]] twin", ""))
    return _OPTION.sub(lambda found: f"`{found[1].replace('-', '_')}`", line)

"""Warnings for the caller, and the errors of the pipeline in the words of Python."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fantwin.pipeline.errors import FantwinError

_HERE = str(Path(__file__).parent)
_OPTION = re.compile(r"--([a-z][a-z-]*)")


class FantwinWarning(UserWarning):
    """What a result leaves out or takes for granted; `warnings.simplefilter("error")` makes it an exception."""


FantwinWarning.__module__ = "fantwin"


def warn(lines: Iterable[str]) -> None:
    """Give a warning for each line, at the line of the program that called."""
    level, frame = 1, sys._getframe()
    while frame.f_back and (frame.f_code.co_filename.startswith(_HERE) or "contextlib" in frame.f_code.co_filename):
        level, frame = level + 1, frame.f_back
    for line in lines:
        warnings.warn(line, FantwinWarning, stacklevel=level)


@contextmanager
def in_python(folder: Path | None = None) -> Iterator[None]:
    """Errors of the pipeline and of the model maker as one of fantwin, whose options are arguments.

    folder: of temporary files, whose names alone are said.
    """
    from fantwin.twin.errors import TwinError  # noqa: PLC0415  only then twin is loaded

    try:
        yield
    except (FantwinError, TwinError) as error:
        text = str(error).replace(f"{folder}/", "") if folder else str(error)
        raise FantwinError(_OPTION.sub(lambda found: f"`{found[1].replace('-', '_')}`", text)) from None

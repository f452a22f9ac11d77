"""Warnings for the caller, and the errors of the pipeline in the words of Python."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fantwin.interface.columns import Fan
from fantwin.pipeline.errors import FantwinError

_HERE = str(Path(__file__).parent)
_OPTION = re.compile(r"--([a-z][a-z-]*)")
_FLAG = "extrapolate"
_FANS = re.compile(r"\b([Ff])ans? (\d+(?:(?:, | to )\d+)*)")
_FILE = re.compile(r"\btable(?:-(\d+))?\.mcap")
_COMMAND = re.compile(r"\bfantwin (train|calibrate)\b")
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
        warnings.warn(line, FantwinWarning, stacklevel=level)


@dataclass
class Words:
    """Lines of the pipeline in the words of Python: its options are arguments.

    Attributes:
        folder: of temporary files; their tables are `table 1` and so on.
        fans: what the caller's table calls the fans, once it is read.
    """

    folder: Path | None = None
    fans: Sequence[Fan] = ()

    def of(self, line: str) -> str:
        """A line as the caller would say it."""
        line = _FILE.sub(
            lambda found: f"table {found[1]}" if found[1] else "the table",
            line.replace(f"{self.folder}/", "") if self.folder else line,
        )
        for number, fan in enumerate(self.fans):
            line = line.replace(f"{fan} (fan {number})", str(fan))
        line = _FANS.sub(self._fans, line)
        line = _TACHO.sub(lambda found: f'`tacho="{found[1]}:{found[2].replace(" ", "")}"`', line)
        line = _COMMAND.sub(r"fantwin.\1", line.replace("; correct [[tray]] twin", ""))
        return _OPTION.sub(lambda found: f"`{found[1].replace('-', '_')}{'=True' * (found[1] == _FLAG)}`", line)

    def warn(self, lines: Iterable[str]) -> None:
        """Give a warning for each line."""
        warn(map(self.of, lines))

    def _fans(self, found: re.Match[str]) -> str:
        numbers = list(map(int, re.findall(r"\d+", found[2])))
        if max(numbers) >= len(self.fans):
            return found[0]
        named = re.sub(r"\d+", lambda number: str(self.fans[int(number[0])]), found[2])
        if not isinstance(self.fans[numbers[0]], int):
            return named
        return f"{found[1]}an{'s' * (len(numbers) > 1)} {named}"


@contextmanager
def in_python(folder: Path | None = None) -> Iterator[Words]:
    """Errors of the pipeline and of the model maker as one of fantwin; yields its words, also for warnings."""
    from fantwin.twin.errors import TwinError  # noqa: PLC0415  only then twin is loaded

    words = Words(folder)
    try:
        yield words
    except (FantwinError, TwinError) as error:
        raise FantwinError(words.of(str(error))) from None

"""Log of another system, as fantwin sees it: fields with names, each with values at its own times.

To add a format, write one file with a reader and add its row to pipeline/sources/logs/formats.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S

_MOST_SHOWN = 120


class LogError(UserError):
    """A log that cannot be read: one line that says why."""


def in_one_line(error: BaseException) -> str:
    """What a library says, in one short line; of an error without a text its name."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."


@dataclass(frozen=True, eq=False)
class Series:
    """The values of a field: (n,) int64 ns, in the order of the log, and (n,) float64."""

    t_ns: Array
    values: Array

    @property
    def rate_hz(self) -> float:
        """Values a second, by the median time between two; 0 where there are fewer than two."""
        steps = np.diff(self.t_ns)
        steps = steps[steps > 0]
        return NS_PER_S / float(np.median(steps)) if len(steps) else 0.0


class LogFile(Protocol):
    """An open log, with all its numbers in memory or at hand."""

    @property
    def notes(self) -> Sequence[str]:
        """Notes on what is unusual about the log, one line each."""
        ...

    @property
    def names(self) -> Sequence[str]:
        """The names of the fields that have numbers."""
        ...

    def read(self, names: Sequence[str]) -> Mapping[str, Series]:
        """Read some fields by name. Raises LogError."""
        ...

"""File of measurements as fantwin sees it, whatever its format: columns with names, each with values at its times.

Tables, series and logs are all read into this form; `samples_of` makes samples of fans of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S

NO_TIME = np.iinfo(np.int64).min
"""a time that cannot be read, in ns"""
_MOST_SHOWN = 120


class LogError(UserError):
    """A log that cannot be read: one line that says why."""


def in_one_line(error: BaseException) -> str:
    """What a library says, in one short line; of an error without a text its name."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."


def listed(names: Sequence[str], most: int = 3) -> str:
    """The first names of a list: `a, b, c and 4 more`."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


@dataclass(frozen=True, eq=False)
class Column:
    """The values of a column.

    Attributes:
        t_ns: (n,) int64, in the order of the file, NO_TIME where it cannot be read.
        values: (n,) float64, NaN where there is none.
        unit: as the file says; empty: it does not.
        note: what else is in it, such as `3 cells with text`.
        problem: why it cannot be used; None: it can.
    """

    t_ns: Array
    values: Array
    unit: str = ""
    note: str = ""
    problem: UserError | None = None

    @property
    def rate_hz(self) -> float:
        """Values a second, by the median time between two; 0 where there are fewer than two."""
        steps = np.diff(self.t_ns[self.t_ns != NO_TIME])
        steps = steps[steps > 0]
        return NS_PER_S / float(np.median(steps)) if len(steps) else 0.0

    def has_times(self, t_ns: Array) -> bool:
        """Whether its values are of these times."""
        return self.t_ns is t_ns or np.array_equal(self.t_ns, t_ns)


class ColumnFile:
    """An open file. A reader says what it knows and reads columns.

    Attributes:
        title: what the file is, for people.
        names: of its columns.
        numbers: those with numbers, which a preview shows; None: all.
        labels: what a column is called beside its name.
        about: what the file says of itself, such as `debug_mode`.
        notes: what is unusual or left out, a line each; complete once columns have been read.
        times: how its times are written; empty: as usual for its format.
        assumed: what was assumed of its times, and the option that says otherwise.
        is_rows: whether it is a table that its user can edit: where times go back it is refused, and not read in part.
    """

    title: str = ""
    names: Sequence[str] = ()
    numbers: Sequence[str] | None = None
    labels: Mapping[str, str] = {}
    about: Mapping[str, str] = {}
    notes: Sequence[str] = ()
    times: str = ""
    assumed: tuple[str, str] | None = None
    is_rows: bool = False

    def read(self, names: Sequence[str]) -> Mapping[str, Column]:
        """Read some columns by name. Raises UserError."""
        raise NotImplementedError

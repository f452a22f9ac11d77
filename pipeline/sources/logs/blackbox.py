"""Betaflight blackbox: fields are called as in the log, such as `motor[0]` and `eRPM[0]`.

The log has electrical revolutions in hundreds a minute; here they are revolutions a minute.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fantwin.pipeline.sources.logs.log_file import LogError, Series

NS_PER_US = 1000
HUNDREDS = "eRPM["
TIME = "time"


class BlackboxFile:
    """One log of a blackbox file."""

    def __init__(self, path: Path, number: int) -> None:
        """number: of the log in the file, from 1. Raises LogError."""
        from orangebox import Parser  # noqa: PLC0415  an extra

        logging.getLogger("orangebox").setLevel(logging.ERROR)
        try:
            parser = Parser.load(str(path))
            logs = parser.reader.log_count
            if not 1 <= number <= logs:
                raise LogError(f"{path}: --log {number}: the file has logs 1 to {logs}")
            if number > 1:
                parser.set_log_index(number)
            names = list(parser.field_names)
            width = len(names)
            rows = [frame.data[:width] for frame in parser.frames() if len(frame.data) >= width]
            poles = parser.headers.get("motor_poles")
        except LogError:
            raise
        except Exception as error:
            raise LogError(f"{path}: no blackbox log that can be read: {error}") from error
        if TIME not in names or len(rows) < 2:
            raise LogError(f"{path}: log {number} has fewer than two frames with a time")
        columns = {
            name: np.array([_number(row[column]) for row in rows], np.float64) for column, name in enumerate(names)
        }
        self._t_ns = columns.pop(TIME).astype(np.int64) * NS_PER_US
        self._columns = {name: values for name, values in columns.items() if np.isfinite(values).any()}
        self.names: Sequence[str] = list(self._columns)
        self.motor_poles = poles if isinstance(poles, int) and poles > 0 else None
        self.notes: Sequence[str] = [f"log {number} of {logs} in the file; --log chooses another"] if logs > 1 else []

    def read(self, names: Sequence[str]) -> Mapping[str, Series]:
        """See LogFile."""
        return {
            name: Series(self._t_ns, self._columns[name] * (100.0 if name.startswith(HUNDREDS) else 1.0))
            for name in names
        }


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else np.nan


def open_blackbox(path: Path, number: int) -> BlackboxFile:
    """Open a blackbox log. Raises LogError."""
    return BlackboxFile(path, number)

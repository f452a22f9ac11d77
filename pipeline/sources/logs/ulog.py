"""ULog, as PX4 writes it: fields are called `topic.field`, of a further instance of a topic `topic#1.field`."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.sources.column_file import Column, ColumnFile, LogError, in_one_line

NS_PER_US = 1000
MOST_FIELDS = 10_000
"""of one topic, arrays and nested formats counted out; PX4's largest has some hundreds"""


class ULogFile(ColumnFile):
    """An open ULog."""

    def __init__(self, path: Path) -> None:
        """Raises LogError: it is no ULog."""
        from pyulog import ULog  # noqa: PLC0415  an extra

        try:
            with redirect_stdout(io.StringIO()):  # where it prints what is said below
                _refuse_endless(ULog(str(path), parse_header_only=True).message_formats)
                log = ULog(str(path))
        except Exception as error:
            raise LogError(f"{path}: no ULog that can be read: {in_one_line(error)}") from error
        self._data = {
            data.name + (f"#{data.multi_id}" if data.multi_id else ""): data.data
            for data in log.data_list
            if "timestamp" in data.data
        }
        self.names: Sequence[str] = [
            f"{topic}.{field}"
            for topic, columns in self._data.items()
            for field in columns
            if field != "timestamp" and columns[field].dtype.kind in "iuf"
        ]
        lost_s = sum(each.duration for each in log.dropouts) / 1000
        self.notes: Sequence[str] = [
            *([f"{len(log.dropouts)} dropouts of the logger, {lost_s:.3g} s together"] if log.dropouts else []),
            *(["the file is damaged: what could be read was read"] if log.file_corruption else []),
        ]

    def read(self, names: Sequence[str]) -> Mapping[str, Column]:
        """See ColumnFile."""
        found: dict[str, Column] = {}
        for name in names:
            topic, _, field = name.partition(".")
            columns = self._data[topic]
            t_ns = columns["timestamp"].astype(np.int64) * NS_PER_US
            found[name] = Column(t_ns, columns[field].astype(np.float64))
        return found


def _refuse_endless(formats: Mapping[str, Any]) -> None:
    """Raise ValueError where nested formats stand for more fields than a log has: a few bytes can name millions."""
    sizes: dict[str, int] = {}

    def size_of(name: str, nested_in: tuple[str, ...] = ()) -> int:
        if name in nested_in:
            raise ValueError(f"the format {name} contains itself")
        if name not in sizes:
            fields = formats[name].fields if name in formats else ()
            sizes[name] = sum(max(1, number) * size_of(kind, (*nested_in, name)) for kind, number, _ in fields) or 1
            if sizes[name] > MOST_FIELDS:
                raise ValueError(f"the format {name} has more than {MOST_FIELDS:,} fields")
        return sizes[name]

    for name in formats:
        size_of(name)

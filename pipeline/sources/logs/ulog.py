"""ULog, as PX4 writes it: fields are called `topic.field`, of a further instance of a topic `topic#1.field`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fantwin.pipeline.sources.logs.log_file import LogError, Series

NS_PER_US = 1000


class ULogFile:
    """An open ULog."""

    motor_poles = None

    def __init__(self, path: Path) -> None:
        """Raises LogError: it is no ULog."""
        from pyulog import ULog  # noqa: PLC0415  an extra

        try:
            log = ULog(str(path))
        except Exception as error:
            raise LogError(f"{path}: no ULog that can be read: {error}") from error
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
        self.notes: Sequence[str] = [
            *([f"{len(log.dropouts)} dropouts of the logger"] if log.dropouts else []),
            *(["the file is damaged: what could be read was read"] if log.file_corruption else []),
        ]

    def read(self, names: Sequence[str]) -> Mapping[str, Series]:
        """See LogFile."""
        found: dict[str, Series] = {}
        for name in names:
            topic, _, field = name.partition(".")
            columns = self._data[topic]
            t_ns = columns["timestamp"].astype(np.int64) * NS_PER_US
            found[name] = Series(t_ns, columns[field].astype(np.float64))
        return found


def open_ulog(path: Path, number: int) -> ULogFile:
    """Open a ULog; it has one log only. Raises LogError."""
    if number != 1:
        raise LogError(f"{path}: --log {number}: a ULog file has one log")
    return ULogFile(path)

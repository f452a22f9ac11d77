"""The formats of logs: one row each, and the only place that lists them."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from fantwin.pipeline.extras import missing_extra
from fantwin.pipeline.sources.logs.log_file import LogError, LogFile

_START_BYTES = 64


class LogFormat(NamedTuple):
    """Format of logs: how it is recognised, and what reads it.

    Attributes:
        title: what people call it.
        starts: the first bytes of such a file.
        marker: a file in the folder that such a log is; "": it is a file.
        needs: the module of the extra `logs` that reads it.
        reader: import string of what opens it, given a path.
    """

    title: str
    starts: tuple[bytes, ...]
    marker: str
    needs: str
    reader: str


LOG_FORMATS = (
    LogFormat("ULog", (b"ULog\x01\x12\x35",), "", "pyulog", "fantwin.pipeline.sources.logs.ulog:ULogFile"),
    LogFormat(
        "ROS 2 bag",
        (b"SQLite format 3\0", b"\x89MCAP0\r\n"),
        "metadata.yaml",
        "rosbags",
        "fantwin.pipeline.sources.logs.rosbag:RosbagFile",
    ),
)


def log_format(path: Path) -> LogFormat | None:
    """The format of a log by its content; None if it is none of these, such as a table.

    Raises:
        LogError: it cannot be read.
    """
    if path.is_dir():
        found = next((each for each in LOG_FORMATS if each.marker and (path / each.marker).exists()), None)
        if found is None:
            raise LogError(f"{path}: a folder, and no ROS 2 bag, which has a metadata.yaml")
        return found
    try:
        with path.open("rb") as file:
            start = file.read(_START_BYTES)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error
    return next((each for each in LOG_FORMATS if start.startswith(each.starts)), None)


def open_log(path: Path, kind: LogFormat) -> LogFile:
    """Open a log of this format.

    Raises:
        LogError: it cannot be read, or what reads it is not installed.
    """
    if problem := missing_extra(f"{path}: a {kind.title}", "logs", kind.needs):
        raise LogError(problem)
    module, _, name = kind.reader.partition(":")
    log: LogFile = getattr(import_module(module), name)(path)
    if not log.names:
        raise LogError(f"{path}: this {kind.title} has no fields with numbers; is it damaged?")
    return log

"""The formats of logs: one row each, and the only place that lists them."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from fantwin.pipeline.extras import missing_extra
from fantwin.pipeline.sources.column_file import ColumnFile, LogError
from fantwin.pipeline.sources.logs.bag_files import (
    MCAP_START,
    METADATA_FILE,
    ROS_1_START,
    SQLITE_START,
    ZSTD_START,
    files_in,
)

_START_BYTES = 1 << 16


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
        "ROS bag",
        (SQLITE_START, MCAP_START, ROS_1_START, ZSTD_START),
        METADATA_FILE,
        "rosbags",
        "fantwin.pipeline.sources.logs.rosbag:RosbagFile",
    ),
)


class OtherFormat(NamedTuple):
    """Format that is recognised and not read.

    Attributes:
        title: what people call it.
        start: of the file.
        advice: what makes a table of it, with FILE for its name.
        suffix: of a file that may begin within a log; "-": none.
    """

    title: str
    start: bytes
    advice: str
    suffix: str = "-"

    def is_of(self, path: Path, start: bytes) -> bool:
        """Whether this is its format. start: the first bytes of the file."""
        return bool(re.match(self.start, start, re.DOTALL)) or path.suffix.lower() == self.suffix


_TWO_TABLES = "write tables, to be imported together"
OTHER_FORMATS = (
    OtherFormat(
        "a blackbox log",
        rb".*?H Product:Blackbox",
        "`blackbox_decode FILE` writes a table for each flight in it",
        ".bbl",
    ),
    OtherFormat(
        "a dataflash log of ArduPilot",
        rb"\xa3\x95\x80|FMT, 128, 89,",
        f"`mavlogdump.py --format csv --types ESC FILE` and `--types RCOU` {_TWO_TABLES}",
    ),
    OtherFormat(
        "a telemetry log of MAVLink",
        rb"\x00[\x04-\x06].{6}[\xfd\xfe]",
        f"`mavlogdump.py --format csv --types ESC_TELEMETRY_1_TO_4 FILE` and `--types SERVO_OUTPUT_RAW` {_TWO_TABLES}",
    ),
    OtherFormat("a spreadsheet or a zip file", rb"PK\x03\x04|\xd0\xcf\x11\xe0", "save the sheet as CSV"),
    OtherFormat("compressed", rb"\x1f\x8b|BZh|\xfd7zXZ|7z\xbc\xaf", "decompress it first"),
    OtherFormat("an HDF5 file", rb"(MATLAB 7\.3.{100,600}?)?\x89HDF\r\n", "write its columns to a CSV file"),
    OtherFormat("a MATLAB file", rb"MATLAB 5\.0 MAT", "`writetable` in MATLAB makes a CSV file"),
    OtherFormat("a Parquet file", rb"PAR1", "`pandas.read_parquet('FILE').to_csv('FILE.csv')` makes a table"),
    OtherFormat("a measurement file (MDF)", rb"MDF |UnFinMF", "the program `asammdf` exports it as CSV"),
    OtherFormat("a TDMS file of LabVIEW", rb"TDSm", "`TdmsFile.read('FILE').as_dataframe()` of nptdms makes a table"),
    OtherFormat(
        "a database without its beginning",
        rb"(?!)",
        "`sqlite3 FILE .recover | sqlite3 FIXED.db3` may save it",
        ".db3",
    ),
)
READ_FORMATS = f"{', '.join(each.title for each in LOG_FORMATS)}, or a table as text"


def log_format(path: Path) -> LogFormat | None:
    """The format of a log by its content; None if it is none of these, such as a table.

    Raises:
        LogError: it cannot be read, or is of a format that needs to be converted.
    """
    try:
        if path.is_dir():
            return _of_folder(path)
        with path.open("rb") as file:
            start = file.read(_START_BYTES)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error
    found = next((each for each in LOG_FORMATS if start.startswith(each.starts)), None)
    other = None if found else next((each for each in OTHER_FORMATS if each.is_of(path, start)), None)
    if other:
        raise LogError(
            f"{path}: {other.title}, which is not read as it is: {other.advice.replace('FILE', path.name)} "
            f"(read are {READ_FORMATS})"
        )
    return found


def _of_folder(path: Path) -> LogFormat:
    found = next((each for each in LOG_FORMATS if each.marker and (path / each.marker).exists()), None)
    inside = [kind for file in files_in(path) if (kind := log_format(file)) and kind.marker]
    if not found and not inside:
        raise LogError(f"{path}: a folder without a ROS bag; name a file, or a folder with .mcap or .db3 files")
    return found or inside[0]


def open_log(path: Path, kind: LogFormat) -> ColumnFile:
    """Open a log of this format.

    Raises:
        LogError: it cannot be read, or what reads it is not installed.
    """
    if problem := missing_extra(f"{path}: a {kind.title}", "logs", kind.needs):
        raise LogError(problem)
    module, _, name = kind.reader.partition(":")
    log: ColumnFile = getattr(import_module(module), name)(path)
    if not log.names:
        raise LogError(
            f"{path}: no field with numbers in this {kind.title}: it ends before its data, or has texts only"
        )
    log.title = f"{kind.title}, {len(log.names)} fields"
    return log

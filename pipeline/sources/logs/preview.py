"""What a log was understood to be: its format and its fields, each with its rate and range."""

from __future__ import annotations

from pathlib import Path

from fantwin.pipeline.sources.logs.formats import LogFormat
from fantwin.pipeline.sources.logs.known_fields import known_columns
from fantwin.pipeline.sources.logs.log_file import LogFile
from fantwin.pipeline.sources.preview import Preview, column_of


def preview_of_log(path: Path, kind: LogFormat, log: LogFile) -> Preview:
    """The fields of an open log. Raises LogError."""
    notes = tuple(log.notes)  # before all topics are read together, which have times of their own
    series = log.read(log.names)
    columns = tuple(column_of(name, each.values, rate_hz=each.rate_hz) for name, each in series.items())
    options = tuple(word for option in known_columns(log.names).items() for word in option)
    return Preview(path, (f"{kind.title}, {len(columns)} fields",), columns, options=options, notes=notes)

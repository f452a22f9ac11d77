"""Files of others as samples of fans: a log, a table, or series, each by what reads it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.column_file import NO_TIME, Column, ColumnFile
from fantwin.pipeline.sources.logs.formats import log_format, open_log
from fantwin.pipeline.sources.preview import Preview, PreviewColumn, ProposedFan
from fantwin.pipeline.sources.samples_of_file import chosen_fans, samples_of, speed_unit
from fantwin.pipeline.sources.series.line_protocol import is_line_protocol, read_line_protocol
from fantwin.pipeline.sources.series.long_table import is_annotated, long_table
from fantwin.pipeline.sources.series.prometheus_range import is_prometheus, read_prometheus_range
from fantwin.pipeline.sources.series.series_file import JoinedFile
from fantwin.pipeline.sources.tables.clocks import SetBackError, time_in_words
from fantwin.pipeline.sources.tables.fan_columns import FanColumns, used_fans, with_unit
from fantwin.pipeline.sources.tables.layout import find_layout
from fantwin.pipeline.sources.tables.measured_table import Repairs, Table
from fantwin.pipeline.sources.tables.profiles import profile_of
from fantwin.pipeline.sources.tables.table_file import TableFile
from fantwin.pipeline.sources.tables.units import ELECTRICAL, ELECTRICAL_HUNDREDS, SPEED_UNITS
from fantwin.pipeline.sources.wanted import Wanted
from fantwin.schemas.units import NS_PER_S, period_in_words

_START = 4096
_USUAL_POLES = 14
"""poles of a motor that a preview does not know"""


@contextmanager
def _readable() -> Iterator[None]:
    """Raise UserError for what the system says of a file."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{error.filename or 'the file'}: cannot be read: {error.strerror}") from error


def open_file(path: Path, wanted: Wanted) -> ColumnFile:
    """A file by what reads it. A table is long if it shows it, or if what is wanted is no column of it.

    Raises:
        UserError: it cannot be read, or not as it is wanted.
    """
    if file := _log_or_series(path):
        if wanted.time or wanted.period:
            raise UsageError(f"--time and --period are for tables: {path} has its own times ({file.title})")
        return file
    layout = find_layout(path)
    table = TableFile(layout, wanted)
    speeds = {with_unit(each, table.names, SPEED_UNITS)[0] for each in wanted.speed}
    asked = speeds | set(wanted.command)
    is_there = asked <= set(table.names) and speeds.isdisjoint(wanted.command)  # of a long table, one may be both
    if not is_annotated(layout) and is_there and (asked or profile_of(table)):
        return table
    try:
        return long_table(layout, wanted) or table
    except UserError:
        if asked:
            raise
        return table  # whose preview says why


def _log_or_series(path: Path) -> ColumnFile | None:
    if kind := log_format(path):
        return open_log(path, kind)
    with path.open("rb") as stream:
        start = stream.read(_START).decode("utf-8", "replace")
    if is_prometheus(start):
        return read_prometheus_range(path)
    return read_line_protocol(path) if is_line_protocol(start) else None


@_readable()
def read_file(path: Path, wanted: Wanted) -> Table:
    """The samples of a file. A table whose times go back or repeat is read as a long one, if it is that.

    Raises:
        UserError: it cannot be read, or not as it is wanted.
    """
    file = open_file(path, wanted)
    try:
        table = samples_of(path, file, wanted)
    except SetBackError:
        if found := _as_long(path, wanted):
            return found
        raise
    is_coarse = file.is_rows and 2 * table.repairs.repeated > table.repairs.rows
    return (is_coarse and _as_long(path, wanted)) or table


def _as_long(path: Path, wanted: Wanted) -> Table | None:
    long = long_table(find_layout(path), wanted)
    return samples_of(path, long, wanted) if long else None


@_readable()
def preview_of(path: Path, wanted: Wanted) -> Preview:
    """What a file is understood to be.

    Raises:
        UserError: it cannot be read.
    """
    file = open_file(path, wanted)
    profile = profile_of(file)
    names = list(file.names if file.numbers is None else file.numbers)
    why_none = ""
    try:
        chosen = chosen_fans(path, file, wanted, profile)
    except UserError as error:
        why_none, chosen = str(error), FanColumns((), ())
    of_log = () if file.is_rows else file.notes  # once all topics are read together, there are more, on their times
    columns = file.read([*names, *(name for name in chosen.names if name not in names)])
    notes = [str(each.problem) for each in columns.values() if each.problem]
    can_import = not notes and sum(bool(np.isfinite(each.values).any()) for each in columns.values()) > 1
    notes += of_log or file.notes
    notes += [profile.note] if profile and profile.note else []
    unit = ""
    if chosen.speed:
        try:
            known = [] if wanted.speed else chosen.notes
            chosen = used_fans(path, chosen, {name: column.values for name, column in columns.items()})
            unit, _ = speed_unit(chosen, columns, profile)
            poles = wanted.poles or (_USUAL_POLES if unit.startswith(ELECTRICAL) else None)
            notes += _notes_of_import(path, replace(wanted, poles=poles), known)
        except UserError as error:
            notes.append(str(error))
    else:
        is_near = wanted.speed or (profile and profile.speeds_in(file))
        notes += [*_without_time(file, columns), *([why_none] if is_near else [])]
    title = f"{profile.title}: {file.title}" if profile else file.title
    labels = (label or speed for label, speed in zip(chosen.labels or chosen.speed, chosen.speed, strict=True))
    return Preview(
        path,
        (title, *_times_in_words(file, columns)),
        tuple(PreviewColumn.of(name, columns[name], file.labels.get(name, "")) for name in names),
        tuple(map(ProposedFan, labels, chosen.command, chosen.speed)),
        _options(wanted, chosen, unit),
        tuple(note for note in dict.fromkeys(notes) if note != file.title),
        can_import=can_import,
    )


def _notes_of_import(path: Path, wanted: Wanted, known: Sequence[str]) -> list[str]:
    """What an import says of the file, without what is known. Raises UserError."""
    table = read_file(path, wanted)
    return [note for note in (table.assumed, *table.notes) if note and note not in known]


def _without_time(file: ColumnFile, columns: Mapping[str, Column]) -> list[str]:
    """A note on rows that an import of any columns would drop."""
    is_known = next((each.t_ns != NO_TIME for each in columns.values() if file.is_rows and not each.problem), None)
    repairs = Repairs() if is_known is None else Repairs(without_time=int(np.count_nonzero(~is_known)))
    return repairs.in_words


def _times_in_words(file: ColumnFile, columns: Mapping[str, Column]) -> list[str]:
    clocks = {id(each.t_ns): each for each in columns.values()}.values()
    known = [t_ns for each in clocks if len(t_ns := each.t_ns[each.t_ns != NO_TIME])]
    if not known:
        return []
    first, last = min(int(t_ns.min()) for t_ns in known), max(int(t_ns.max()) for t_ns in known)
    steps = np.diff(known[0]) if file.is_rows else ()
    apart = f"{period_in_words(float(np.median(steps)) / NS_PER_S)} apart (median)" if len(steps) else ""
    words = (file.times, apart, f"from {time_in_words(first)} to {time_in_words(last)}")
    return [f"times: {', '.join(filter(None, words))}"]


def _options(wanted: Wanted, chosen: FanColumns, unit: str) -> tuple[str, ...]:
    """Options of the command that imports these fans."""
    if not chosen.speed:
        return ()
    poles = "POLES" if unit in (ELECTRICAL, ELECTRICAL_HUNDREDS) else ""
    said = {
        "--command": chosen.command if len(set(chosen.command)) > 1 else chosen.command[:1],
        "--speed": [f"{name}:{unit}" if unit else name for name in chosen.speed],
        "--channel": [f"{channel}={name}" for channel, of in chosen.others.items() for name in dict.fromkeys(of)],
        "--time": [wanted.time],
        "--period": [wanted.period],
        "--dates": [wanted.dates],
        "--zone": [wanted.zone],
        "--decimal": [wanted.decimal],
        "--poles": [str(wanted.poles or poles)],
    }
    return tuple(word for option, values in said.items() for value in values if value for word in (option, value))


@_readable()
def read_files(paths: Sequence[Path], wanted: Wanted) -> Table:
    """The samples of several files: parts of one run, or tables that have commands and speeds apart.

    Raises:
        UserError: one cannot be read, or they do not go together.
    """
    if len(paths) > 1 and not any(map(log_format, paths)) and not any(map(_log_or_series, paths)):
        files = [open_file(path, wanted) for path in paths]
        joined = JoinedFile(files)
        has_fans = [
            _has_fans(path, file, wanted) for path, file in zip((*paths, paths[0]), (*files, joined), strict=True)
        ]
        if has_fans[-1] and not any(has_fans[:-1]):
            return samples_of(paths[0], joined, wanted)
    return in_one([read_file(path, wanted) for path in paths])


def _has_fans(path: Path, file: ColumnFile, wanted: Wanted) -> bool:
    try:
        return bool(chosen_fans(path, file, wanted, profile_of(file)).speed)
    except UserError:
        return False


def in_one(read: Sequence[Table]) -> Table:
    """The samples of several files as of one, in the order of time; overlaps are counted.

    Raises:
        UserError: they are of other fans, or tell different things of the same time.
    """
    if len(read) == 1:
        return read[0]
    first, tables = read[0], sorted(read, key=lambda each: int(each.t_ns[0]))
    both = f"{tables[0].path} and {tables[1].path}"
    for each in read:
        if each.fans != first.fans or set(each.auxiliary) != set(first.auxiliary):
            raise UserError(f"{each.path}: {each.fans} fans, {first.path} has {first.fans}: import each by itself")
    t_ns = np.concatenate([table.t_ns for table in tables])
    starts = np.cumsum([0, *(len(table.t_ns) for table in tables)])
    reached = np.maximum.accumulate(t_ns)
    overlaps = sum(int(np.count_nonzero(t_ns[a:b] <= reached[a - 1])) for a, b in pairwise(starts[1:]))
    if overlaps and not all(table.has_dates for table in tables):
        raise UserError(f"{both} have the same times, and no dates: they are runs of their own; import each by itself")
    rows = np.argsort(t_ns, kind="stable")
    is_again = np.diff(t_ns[rows], prepend=t_ns[rows[0]] - 1) == 0
    speed = np.concatenate([table.speed_rad_s for table in tables])
    again = np.flatnonzero(is_again)
    differs = ~np.isclose(speed[rows[again]], speed[rows[again - 1]], equal_nan=True).all(axis=1)
    if differs.any():
        at_s = t_ns[rows[again[np.argmax(differs)]]] / NS_PER_S
        raise UserError(
            f"{both} have other speeds at the same time, {at_s:.3f} s: of two machines? import each by itself"
        )
    rows = rows[~is_again]
    overlap = (f"{overlaps} rows of files that overlap, {len(again)} of them twice",) if overlaps else ()
    notes = dict.fromkeys(note for each in read for note in each.remarks)
    return replace(
        first,
        t_ns=t_ns[rows],
        command=np.concatenate([table.command for table in tables])[rows],
        speed_rad_s=speed[rows],
        auxiliary={name: np.concatenate([table.auxiliary[name] for table in tables])[rows] for name in first.auxiliary},
        repairs=first.repairs.plus(*(each.repairs for each in read[1:])),
        remarks=(f"{len(read)} files in the order of time", *notes, *overlap),
    )

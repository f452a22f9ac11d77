"""Files of others as samples of fans: a log, a table, or series, each by what reads it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.logs.formats import log_format, open_log
from fantwin.pipeline.sources.logs.known_fields import known_columns
from fantwin.pipeline.sources.logs.log_file import Series
from fantwin.pipeline.sources.logs.preview import preview_of_log
from fantwin.pipeline.sources.logs.samples_of_log import read_samples
from fantwin.pipeline.sources.preview import Preview, ProposedFan, column_of
from fantwin.pipeline.sources.series.line_protocol import is_line_protocol, read_line_protocol
from fantwin.pipeline.sources.series.long_table import is_annotated, long_table
from fantwin.pipeline.sources.series.prometheus_range import is_prometheus, read_prometheus_range
from fantwin.pipeline.sources.series.series_file import SeriesFile
from fantwin.pipeline.sources.tables.clocks import SetBackError
from fantwin.pipeline.sources.tables.fan_columns import FAN_NUMBER, with_unit
from fantwin.pipeline.sources.tables.layout import Layout, find_layout
from fantwin.pipeline.sources.tables.measured_table import Table
from fantwin.pipeline.sources.tables.profiles import Profile, profile_of
from fantwin.pipeline.sources.tables.table_file import AS_FOUND, Reading, read_columns, read_table, series_in
from fantwin.pipeline.sources.tables.units import ELECTRICAL, ELECTRICAL_HUNDREDS, SPEED_UNITS
from fantwin.schemas.units import NS_PER_S

_START = 4096
_MOST_NAMED = 8


@dataclass(frozen=True)
class Wanted:
    """What a user asks of a file.

    Attributes:
        command, speed: as for `fan_columns`; both empty: those that the program that wrote the file is known to write.
        time, period: as for `read_table`.
        channels: columns, by the name of their channel.
        reading: what the file does not show.
    """

    command: Sequence[str] = ()
    speed: Sequence[str] = ()
    time: str | None = None
    period: str | None = None
    channels: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])
    reading: Reading = AS_FOUND


@dataclass(frozen=True)
class Imported:
    """Samples of a file. notes: on how it was read, beside those of the table. labels: of the fans, as far as known."""

    table: Table
    notes: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()


def read_file(path: Path, wanted: Wanted) -> Imported:
    """The samples of a file.

    Raises:
        UserError: it cannot be read, or not as it is wanted.
    """
    if kind := log_format(path):
        _require_no_times(wanted, f"a {kind.title}")
        log = open_log(path, kind)
        known = {} if wanted.command or wanted.speed else known_columns(log.names)
        commands, speeds = (
            [known[name]] if known else given
            for name, given in (("--command", wanted.command), ("--speed", wanted.speed))
        )
        if not (commands and speeds):
            raise UsageError("an import needs --command and --speed; --preview shows the fields")
        return Imported(*read_samples(path, log, commands, speeds, wanted.reading.poles, auxiliary=wanted.channels))
    if series := _series_of(path):
        return _of_series(path, series, wanted)
    layout = find_layout(path)
    is_series = is_annotated(layout) or _is_of_series(layout, wanted)
    if is_series and (series := long_table(layout, wanted.time, wanted.reading)):
        return _of_series(path, series, wanted)
    asked, notes, labels = _with_fans(path, wanted, layout)
    try:
        table = read_table(
            path,
            wanted.time,
            asked.command,
            asked.speed,
            period=wanted.period,
            auxiliary=asked.channels,
            reading=wanted.reading,
            layout=layout,
        )
    except SetBackError:
        if series := long_table(layout, wanted.time, wanted.reading):
            return _of_series(path, series, wanted)
        raise
    if 2 * table.repairs.repeated > table.repairs.rows and (series := long_table(layout, wanted.time, wanted.reading)):
        return _of_series(path, series, wanted)
    return Imported(table, notes, labels)


def preview_of(path: Path, wanted: Wanted) -> Preview:
    """What a file is understood to be.

    Raises:
        UserError: it cannot be read.
    """
    if kind := log_format(path):
        return preview_of_log(path, kind, open_log(path, kind))
    series = _series_of(path)
    if series is None:
        layout = find_layout(path)
        try:
            series = long_table(layout, wanted.time, wanted.reading)
        except UserError:
            series = None  # the preview of the table says why
        if series is None:
            return _preview_of_table(path, layout, wanted)
    profile = profile_of(series)
    columns = tuple(column_of(name, each.values, rate_hz=each.rate_hz) for name, each in series.series.items())
    fans = profile.fans_in(series.names, {}) if profile else ()
    title = f"{profile.title}, {series.title}" if profile else series.title
    return Preview(path, (title,), columns, fans, _options(fans, profile, {}, {}), series.notes)


def _preview_of_table(path: Path, layout: Layout, wanted: Wanted) -> Preview:
    profile = profile_of(layout)
    title = f"{profile.title}: {layout.in_words}" if profile else layout.in_words
    columns, times, notes = read_columns(layout, wanted.time, wanted.reading)
    fans = _fans_of(profile, layout)
    if profile and profile.note:
        notes.append(profile.note)
    units = {name: layout.unit(name) or columns[name].unit for name in columns}
    shown = tuple(
        column_of(
            name,
            np.asarray(column.values(may_be_empty=True)),
            units[name],
            note=column.texts() or layout.second_name(name),
        )
        for name, column in columns.items()
    )
    channels = profile.channels_in(layout.all_names) if profile else {}
    return Preview(path, (title, *times), shown, fans, _options(fans, profile, units, channels), tuple(notes))


def _fans_of(profile: Profile | None, layout: Layout) -> tuple[ProposedFan, ...]:
    if profile is None:
        return ()
    filled = [name for name in layout.all_names if layout.kinds[layout.index(name)]]
    labels = {
        second: first
        for first, second in zip(layout.names, layout.second_names, strict=False)
        if second and first != second
    }
    return profile.fans_in(filled, labels)


def _options(
    fans: Sequence[ProposedFan], profile: Profile | None, units: Mapping[str, str], channels: Mapping[str, str]
) -> tuple[str, ...]:
    """Options of the command that imports these fans."""
    if not fans or profile is None:
        return ()
    commands = list(dict.fromkeys(fan.command for fan in fans))
    options = [
        word for each in (commands if len(commands) == len(fans) else commands[:1]) for word in ("--command", each)
    ]
    for fan in fans:
        unit = units.get(fan.speed, "") if units.get(fan.speed, "") in SPEED_UNITS else profile.unit
        options += ["--speed", f"{fan.speed}:{unit}" if unit else fan.speed]
    if profile.unit in (ELECTRICAL, ELECTRICAL_HUNDREDS):
        options += ["--poles", "14"]
    for channel, name in channels.items():
        options += ["--channel", f"{channel}={name}"]
    return tuple(options)


def _with_fans(
    path: Path, wanted: Wanted, named: Layout | SeriesFile
) -> tuple[Wanted, tuple[str, ...], tuple[str, ...]]:
    """What is wanted, with the columns of the program that wrote the file where the user names none."""
    if wanted.command and wanted.speed:
        return wanted, (), ()
    profile = profile_of(named)
    fans = (
        _fans_of(profile, named) if isinstance(named, Layout) else profile.fans_in(named.names, {}) if profile else ()
    )
    if wanted.command or wanted.speed or profile is None or not fans:
        raise UsageError("an import needs --command and --speed; --preview shows the columns")
    commands = list(dict.fromkeys(fan.command for fan in fans))
    own = {channel: [name] for channel, name in profile.channels_in(named.all_names).items()}
    note = "; ".join(f"{fan.label}: command {fan.command!r}, speed {fan.speed!r}" for fan in fans[:_MOST_NAMED])
    more = f" and {len(fans) - _MOST_NAMED} more" if len(fans) > _MOST_NAMED else ""
    asked = replace(
        wanted,
        command=commands if len(commands) == len(fans) else commands[:1],
        speed=[fan.speed for fan in fans],
        channels={**own, **wanted.channels},
    )
    return asked, (f"columns of {profile.title}: {note}{more}",), tuple(fan.label for fan in fans)


def _of_series(path: Path, series: SeriesFile, wanted: Wanted) -> Imported:
    _require_no_times(replace(wanted, time=None), series.title)
    asked, notes, labels = _with_fans(path, wanted, series)
    _require_series(path, series, asked)
    profile = profile_of(series)
    speeds = [with_unit(each, series.names, SPEED_UNITS) for each in asked.speed]
    if profile and not any(unit for _, unit in speeds):
        unit, _ = profile.unit_of([name for name, _ in speeds], "")
        asked = replace(asked, speed=[f"{name}:{unit}" if unit else name for name, _ in speeds])
    table, of_log = read_samples(
        path, series, asked.command, asked.speed, wanted.reading.poles, auxiliary=asked.channels
    )
    return Imported(table, (series.title, *notes, *of_log), labels)


def _require_series(path: Path, series: SeriesFile, wanted: Wanted) -> None:
    """Raise UserError that names the series where one that is wanted is a column, and no series."""
    names = series.names
    asked = [*wanted.command, *(with_unit(each, names, SPEED_UNITS)[0] for each in wanted.speed)]
    unknown = [each for each in asked if each not in names and not FAN_NUMBER.search(each)]
    if unknown:
        shown = ", ".join(names[:_MOST_NAMED])
        more = f" and {len(names) - _MOST_NAMED} more; --preview shows them" if len(names) > _MOST_NAMED else ""
        example = f"--command {shlex.quote(names[-1])} --speed {shlex.quote(f'{names[0]}:rpm')}"
        raise UserError(
            f"{path}: no series {unknown[0]!r}: each row is a value of one series, and they are {shown}{more}: name "
            f"them as columns, such as {example}"
        )


def read_files(paths: Sequence[Path], wanted: Wanted) -> Imported:
    """The samples of several files: parts of one run, or tables that have commands and speeds apart.

    Raises:
        UserError: one cannot be read, or they do not go together.
    """
    if len(paths) > 1 and (joined := _joined(paths, wanted)):
        return _of_series(paths[0], joined, replace(wanted, time=None))
    return in_one(paths, [read_file(path, wanted) for path in paths])


def _joined(paths: Sequence[Path], wanted: Wanted) -> SeriesFile | None:
    """The series of tables of which none has all that is wanted; None: one has, or they are no tables."""
    if any(log_format(path) or _series_of(path) for path in paths):
        return None
    layouts = [find_layout(path) for path in paths]
    if len({layout.names for layout in layouts}) == 1 or any(map(is_annotated, layouts)):
        return None
    names = [name for layout in layouts for name in layout.all_names]
    asked = [*wanted.command, *(with_unit(each, names, SPEED_UNITS)[0] for each in wanted.speed)]
    if any(all(each in layout.all_names for each in asked) for layout in layouts if asked):
        return None
    series: dict[str, Series] = {}
    for layout in layouts:
        long = long_table(layout, wanted.time, wanted.reading)
        apart = series_in(layout, wanted.time, wanted.reading) if long is None else {}
        of_file = long.series if long else {name: Series(*each) for name, each in apart.items()}
        series = {**of_file, **series}
    found = SeriesFile(f"columns of {len(paths)} files by their times, {len(series)} series", series)
    profile = profile_of(found)
    is_known = bool(profile and profile.fans_in(found.names, {}))
    return found if (asked and any(each in series for each in asked)) or (not asked and is_known) else None


def _require_no_times(wanted: Wanted, what: str) -> None:
    if wanted.time or wanted.period:
        raise UsageError(f"--time and --period are for tables: {what} has its own times")


def _is_of_series(layout: Layout, wanted: Wanted) -> bool:
    """Whether what is wanted is no column of a table, and so perhaps a series in it."""
    names = layout.all_names
    asked = [*wanted.command, *(with_unit(each, names, SPEED_UNITS)[0] for each in wanted.speed)]
    if not asked:
        return profile_of(layout) is None
    return any(each not in names for each in asked)


def _series_of(path: Path) -> SeriesFile | None:
    with path.open("rb") as file:
        start = file.read(_START).decode("utf-8", "replace")
    if is_prometheus(start):
        return read_prometheus_range(path)
    return read_line_protocol(path) if is_line_protocol(start) else None


def in_one(paths: Sequence[Path], read: Sequence[Imported]) -> Imported:
    """The samples of several files as of one, in the order of time; overlaps are counted.

    Raises:
        UserError: they are of other fans, or tell different things of the same time.
    """
    if len(read) == 1:
        return read[0]
    first = read[0].table
    order = sorted(range(len(read)), key=lambda k: int(read[k].table.t_ns[0]))
    tables = [read[k].table for k in order]
    for path, each in zip(paths, read, strict=True):
        if each.table.fans != first.fans or set(each.table.auxiliary) != set(first.auxiliary):
            raise UserError(f"{path}: {each.table.fans} fans, {paths[0]} has {first.fans}: import each by itself")
    t_ns = np.concatenate([table.t_ns for table in tables])
    starts = np.cumsum([0, *(len(table.t_ns) for table in tables)])
    reached = np.maximum.accumulate(t_ns)
    overlaps = sum(int(np.count_nonzero(t_ns[a:b] <= reached[a - 1])) for a, b in pairwise(starts[1:]))
    if overlaps and not all(table.has_dates for table in tables):
        raise UserError(
            f"{paths[order[0]]} and {paths[order[1]]} have the same times, and no dates: they are runs of their own; "
            "import each by itself"
        )
    rows = np.argsort(t_ns, kind="stable")
    t_ns = t_ns[rows]
    command, speed = (
        np.concatenate([getattr(table, name) for table in tables])[rows] for name in ("command", "speed_rad_s")
    )
    auxiliary = {name: np.concatenate([table.auxiliary[name] for table in tables])[rows] for name in first.auxiliary}
    same = np.flatnonzero(np.diff(t_ns) == 0)
    if len(same):
        differ = ~np.isclose(speed[same], speed[same + 1], equal_nan=True).all(axis=1)
        if np.any(differ):
            at = t_ns[same[np.argmax(differ)]] / NS_PER_S
            raise UserError(
                f"{paths[order[0]]} and {paths[order[1]]} have other speeds at the same time, {at:.3f} s: of two "
                "machines? import each by itself"
            )
        keep = np.concatenate([[True], np.diff(t_ns) > 0])
        t_ns, command, speed = t_ns[keep], command[keep], speed[keep]
        auxiliary = {name: values[keep] for name, values in auxiliary.items()}
    overlap = (f"{overlaps} rows of files that overlap, {len(same)} of them twice",) if overlaps else ()
    repairs = first.repairs.plus(*(each.table.repairs for each in read[1:]))
    joined = replace(
        first,
        t_ns=t_ns,
        command=command,
        speed_rad_s=speed,
        auxiliary=auxiliary,
        repairs=repairs,
        remarks=tuple(dict.fromkeys((*(note for each in read for note in each.table.remarks), *overlap))),
    )
    notes = tuple(dict.fromkeys(note for each in read for note in each.notes))
    return Imported(joined, (f"{len(paths)} files in the order of time", *notes), read[0].labels)

"""`fantwin import`: turns measured tables, or logs of other systems, into a recording."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from glob import glob
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from fantwin.pipeline.cli.options import JsonOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.config.settings import NAME_PATTERN
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.recordings.raw_recordings import write_table
from fantwin.pipeline.sources.imported_file import preview_of, read_files
from fantwin.pipeline.sources.stand_in import FEWEST, STAND_INS, stand_in, stand_ins_of
from fantwin.pipeline.sources.tables.measured_table import Table, hold_last
from fantwin.pipeline.sources.tables.tachos import parse_tachos
from fantwin.pipeline.sources.tables.units import SPEED_UNITS
from fantwin.pipeline.sources.tacho_evidence import tacho_hints
from fantwin.pipeline.sources.wanted import Wanted
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.fan_names import FanNames, is_fan_name
from fantwin.schemas.topics import RESERVED_TRAY_NAMES
from fantwin.schemas.units import NS_PER_S, period_in_words


def import_table(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="Tables, series, or logs (ULog, ROS bag); several, or a pattern such as 'log-*.csv', become one "
            "recording.",
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="REC.mcap", help="Recording to write.")
    ] = None,
    command: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN",
            help="Command column: one for all fans, or one per fan. Repeatable. Or one pattern for all fans, for "
            "example 'actuator_outputs.output[*]'.",
        ),
    ] = None,
    speed: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN[:UNIT]",
            help="Speed column, one per fan. Units: rpm, hz, deg/s, rad/s, erpm; default: that of the file, else "
            "rad/s. Repeatable.",
        ),
    ] = None,
    time: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMN[:UNIT]",
            help="Time column, or DATE+TIME, two of them; default: found. Units: h, min, s, ms, us, ns, iso (dates).",
        ),
    ] = None,
    period: Annotated[
        str | None, typer.Option(metavar="TIME", help="Time between rows of a table without a time column, e.g. 10ms.")
    ] = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=COLUMN",
            help=f"Column of {', '.join(column.name for column in CHANNELS)}: one for all fans, or one per fan. "
            "Repeatable.",
        ),
    ] = None,
    command_from: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(STAND_INS),
            help="What stands for a command that is not in the file: the median speed of the others, or a --channel.",
        ),
    ] = None,
    tray: Annotated[str, typer.Option(help="Name of the tray in the recording.")] = "tray1",
    tacho: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND[:window_s=S,pulses=N,...]",
            help="How the speeds were measured: instantaneous (default), count, average or period, with the keys of "
            "`tacho` of a tray: one for all fans, or one per fan. Repeatable.",
        ),
    ] = None,
    poles: Annotated[int | None, typer.Option(help="Magnetic poles of a motor, for speeds in erpm.")] = None,
    dates: Annotated[
        str | None, typer.Option(metavar="dmy|mdy|ymd", help="Order of dates that the table leaves open.")
    ] = None,
    zone: Annotated[
        str | None, typer.Option(help="Time zone of dates without one, such as Europe/Berlin; default UTC.")
    ] = None,
    decimal: Annotated[
        str | None, typer.Option(metavar=".|,", help="Decimal mark of numbers that the table leaves open.")
    ] = None,
    preview: Annotated[
        bool,
        typer.Option("--preview", help="Show what was understood, and the command that imports it; write nothing."),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing recording.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Turn measured tables or logs into a recording, the data format of training, evaluation and replay.

    How a file is written is found; --preview shows it, without writing. Irregularities are counted; speeds are never
    filled in. Tachos of ordinary fans count pulses: say over which time, or see the hint.

    Example: fantwin import FILE.csv --time t:s --command u --speed y:rpm --tacho count:window_s=1 -o REC.mcap

    Example: fantwin import FLIGHT.ulg --command 'out.u[*]' --speed 'esc.rpm[*]:rpm' -o REC.mcap
    """
    if command_from is not None and (command or not speed or command_from not in STAND_INS):
        raise UsageError(f"--command-from is one of {', '.join(STAND_INS)}, with --speed and without --command")
    paths = _existing(files)
    wanted = Wanted(
        command or (),
        speed or (),
        time,
        period,
        _channels(channel or ()),
        dates or "",
        zone or "",
        decimal or "",
        poles,
    )
    if preview:
        previews = [preview_of(path, wanted) for path in paths]
        lines = (line for each in previews for line in each.lines)
        show({"files": [each.as_json for each in previews]}, *lines, json_output=json_output)
        return
    if output is None:
        raise UsageError("an import needs -o REC.mcap; --preview shows what is in the file")
    if not re.match(NAME_PATTERN, tray) or tray in RESERVED_TRAY_NAMES:
        raise UsageError(f"--tray {tray}: use letters, digits, - and _, but not {' or '.join(RESERVED_TRAY_NAMES)}")
    if output.exists() and not force:
        raise UserError(f"{output}: exists; name another file with -o, or replace it with --force")
    table = _without_command(paths, wanted, command_from) if speed and not command else read_files(paths, wanted)
    tachos = parse_tachos(tacho or (), table.fans)
    names = FanNames(tuple(label if is_fan_name(label) else "" for label in table.labels))
    write_table(table, output, tray, tachos, names)
    hints = tacho_hints(table.t_ns / NS_PER_S, table.speed_rad_s, tachos, range(table.fans), names)
    fans = "1 fan" if table.fans == 1 else f"{table.fans} fans"
    period_text = f"{period_in_words(table.median_period_s)} apart (median)"
    line = f"{output}: {len(table.t_ns)} samples of {fans} over {table.duration_s:.1f} s, {period_text}"
    found = {
        "recording": str(output),
        "samples": len(table.t_ns),
        "fans": table.fans,
        "duration_s": table.duration_s,
        "median_rate_hz": 1 / table.median_period_s,
        "speed_unit": table.speed_unit,
        "assumed": table.assumed,
        "notes": list(table.remarks),
        "hints": hints,
        "gaps": table.gaps,
        "columns": list(table.auxiliary),
        **asdict(table.repairs),
    }
    lines = (line, *(f"  {note}" for note in (table.assumed, *table.notes) if note))
    show(found, *lines, json_output=json_output)
    for hint in hints if not json_output else ():
        typer.echo(f"hint: {hint}; see --tacho", err=True)


def _without_command(paths: Sequence[Path], wanted: Wanted, name: str | None) -> Table:
    """The samples of files without a command, with what stands for it.

    Raises:
        UsageError: none was chosen.
    """
    columns = [each.rpartition(":")[0] if each.rpartition(":")[2] in SPEED_UNITS else each for each in wanted.speed]
    table = read_files(paths, replace(wanted, command=columns, has_command=False))
    found = stand_ins_of(table.speed_rad_s, table.auxiliary)
    if name is None:
        offers = "".join(f"; or {each.words(table.fans)}" for each in found)
        raise UsageError(f"an import needs --command{offers}")
    command = hold_last(stand_in(name, table.speed_rad_s, table.auxiliary))
    known = np.isfinite(command).all(axis=1)
    if name not in [each.name for each in found] or known.sum() < FEWEST:
        raise UserError(f"{paths[0]}: --command-from {name}: it is not known of all fans; give --channel, or more fans")
    (words,) = (each.words(table.fans) for each in found if each.name == name)
    return replace(
        table,
        t_ns=table.t_ns[known],
        command=command[known],
        speed_rad_s=table.speed_rad_s[known],
        auxiliary={channel: values[known] for channel, values in table.auxiliary.items()},
        remarks=(*table.remarks, f"no command is known; {words}"),
    )


def _existing(files: Sequence[Path]) -> list[Path]:
    """The files, with those that a pattern matches where the shell has left it as it is."""
    found: list[Path] = []
    for file in files:
        matches = [] if file.exists() else sorted(map(Path, glob(str(file))))  # noqa: PTH207  a pattern may be absolute
        found += matches or [file]
    return list(dict.fromkeys(found))


def _channels(given: Sequence[str]) -> dict[str, list[str]]:
    """The columns of each channel beside command and speed."""
    known = [column.name for column in CHANNELS]
    columns: dict[str, list[str]] = {}
    for text in given:
        name, equals, column = text.partition("=")
        if name not in known or not equals:
            raise UsageError(f"--channel {text}: give NAME=COLUMN; known are {', '.join(known)}")
        columns.setdefault(name, []).append(column)
    return columns

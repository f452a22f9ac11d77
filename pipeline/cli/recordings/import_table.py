"""`fantwin import`: turns a measured table, or the log of another system, into a recording."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import JsonOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.recordings.import_preview import show_previews
from fantwin.pipeline.config.settings import NAME_PATTERN
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.recordings.raw_recordings import write_table
from fantwin.pipeline.sources.logs.formats import log_format, open_log
from fantwin.pipeline.sources.logs.preview import preview_of_log
from fantwin.pipeline.sources.logs.samples_of_log import read_samples
from fantwin.pipeline.sources.tables.measured_table import Table, read_table
from fantwin.pipeline.sources.tables.tachos import parse_tachos
from fantwin.pipeline.sources.tacho_evidence import tacho_hints
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.topics import RESERVED_TRAY_NAMES
from fantwin.schemas.units import NS_PER_S


def import_table(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A text file whose first line names the columns, or a log: ULog, ROS 2 bag.",
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
            help="Speed column, one per fan. Units: rpm, hz, deg/s, rad/s (default); in a log also erpm. Repeatable.",
        ),
    ] = None,
    time: Annotated[
        str | None,
        typer.Option(metavar="COLUMN[:UNIT]", help="Time column. Units: s (default), ms, us, ns, iso (dates)."),
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
    preview: Annotated[
        bool,
        typer.Option("--preview", help="Show what was understood, and the command that imports it; write nothing."),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing recording.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Turn a measured table or a log into a recording, the data format of training, evaluation and replay.

    Irregularities (repeated times, gaps, empty cells) are counted and reported; speeds are never filled in. Tachos of
    ordinary fans count pulses: say over which time, or see the hint.

    Example: fantwin import FILE.csv --time t:s --command u --speed y:rpm --tacho count:window_s=1 -o REC.mcap

    Example: fantwin import FLIGHT.ulg --command 'out.u[*]' --speed 'esc.rpm[*]:rpm' -o REC.mcap
    """
    kind = log_format(file)
    if preview:
        if kind is None:
            raise UsageError(f"{file}: --preview is for logs; the first line of a table names its columns")
        show_previews([preview_of_log(file, kind, open_log(file, kind))], json_output=json_output)
        return
    if output is None or not command or not speed:
        what = "-o, --command and --speed" if kind is None else "-o, --command and --speed; --preview shows the fields"
        raise UsageError(f"an import needs {what}")
    if not re.match(NAME_PATTERN, tray) or tray in RESERVED_TRAY_NAMES:
        raise UsageError(f"--tray {tray}: use letters, digits, - and _, but not {' or '.join(RESERVED_TRAY_NAMES)}")
    if output.exists() and not force:
        raise UserError(f"{output}: exists; name another file with -o, or replace it with --force")
    auxiliary = _channels(channel or ())
    if kind is None:
        tachos = parse_tachos(tacho or (), len(speed))
        table, of_log = read_table(file, time, command, speed, period=period, auxiliary=auxiliary), ()
    else:
        if time or period:
            raise UsageError(f"--time and --period are for tables: a {kind.title} has its own times")
        log = open_log(file, kind)
        table, of_log = read_samples(file, log, command, speed, poles, auxiliary=auxiliary)
        tachos = parse_tachos(tacho or (), table.fans)
    notes = list(filter(None, (table.assumed, *of_log)))
    write_table(table, output, tray, tachos)
    hints = tacho_hints(table.t_ns / NS_PER_S, table.speed_rad_s, tachos, range(table.fans))
    fans = "1 fan" if table.fans == 1 else f"{table.fans} fans"
    period_s = table.median_period_s
    period = f"{f'{period_s:.3g} s' if period_s >= 1.0 else f'{period_s * 1e3:.3g} ms'} apart (median)"
    line = f"{output}: {len(table.t_ns)} samples of {fans} over {table.duration_s:.1f} s, {period}"
    lines = (line, *(f"  {note}" for note in (*notes, *table.notes)))
    show(import_summary(table, output) | {"hints": hints, "notes": notes}, *lines, json_output=json_output)
    for hint in hints if not json_output else ():
        typer.echo(f"hint: {hint}; see --tacho", err=True)


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


def import_summary(table: Table, output: Path) -> dict[str, object]:
    """The JSON output of an import."""
    return {
        "recording": str(output),
        "samples": len(table.t_ns),
        "fans": table.fans,
        "duration_s": table.duration_s,
        "median_rate_hz": 1 / table.median_period_s,
        "speed_unit": table.speed_unit,
        "assumed": table.assumed,
        "gaps": table.gaps,
        "columns": list(table.auxiliary),
        **asdict(table.repairs),
    }

"""`fantwin import`: turns a measured table into a recording."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from pydantic import ValidationError

from pipeline.cli.options import (
    CurrentOption,
    JsonOption,
    SupplyVoltageOption,
    TemperatureOption,
    auxiliary_options,
)
from pipeline.config.models import NAME_PATTERN
from pipeline.devices.measured_table import Table, read_table
from pipeline.devices.tacho_evidence import tacho_hints
from pipeline.errors import UsageError, UserError
from pipeline.recordings.reading import TACHO_KEY
from pipeline.recordings.writing import RecordingWriter
from schemas.messages import Header, Raw
from schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan, tachos_to_json
from schemas.topics import RESERVED_TRAY_NAMES, tray_key
from schemas.units import NS_PER_S

SITE = "imported"
SAMPLES_PER_MESSAGE = 100


def import_table(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.csv", help="Measured table: a text file whose first line names the columns.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="REC.mcap", help="Recording to write.")],
    command: Annotated[
        list[str], typer.Option(metavar="COLUMN", help="Command column: one for all fans, or one per fan. Repeatable.")
    ],
    speed: Annotated[
        list[str],
        typer.Option(
            metavar="COLUMN[:UNIT]",
            help="Speed column, one per fan. Units: rpm, hz, deg/s, rad/s (default). Repeatable.",
        ),
    ],
    time: Annotated[
        str | None,
        typer.Option(metavar="COLUMN[:UNIT]", help="Time column. Units: s (default), ms, us, ns, iso (dates)."),
    ] = None,
    period: Annotated[
        str | None, typer.Option(metavar="TIME", help="Time between rows of a table without a time column, e.g. 10ms.")
    ] = None,
    supply_voltage: SupplyVoltageOption = None,
    current: CurrentOption = None,
    temperature: TemperatureOption = None,
    tray: Annotated[str, typer.Option(help="Name of the tray in the recording.")] = "tray1",
    tacho: Annotated[
        Literal["instantaneous", "count", "average", "period"], typer.Option(help="How the speeds were measured.")
    ] = "instantaneous",
    pulses: Annotated[int, typer.Option(help="Pulses of a tacho per revolution.")] = 2,
    window_s: Annotated[
        list[float] | None,
        typer.Option(
            "--window",
            metavar="S",
            help="Seconds over which pulses are counted: one for all fans, or one per fan. Repeatable.",
        ),
    ] = None,
    update_s: Annotated[
        float, typer.Option("--update", metavar="S", help="Seconds between new counts. Default: the window.")
    ] = 0.0,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing recording.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Turn a measured table into a recording, the data format of training, evaluation and replay.

    Irregularities (repeated times, gaps, empty cells) are counted and reported; speeds are never filled in. Tachos of
    ordinary fans count pulses: say over which time, or see the hint.

    Example: fantwin import FILE.csv --time t:s --command u --speed y:rpm --tacho count --window 1 -o REC.mcap
    """
    if not re.match(NAME_PATTERN, tray) or tray in RESERVED_TRAY_NAMES:
        raise UsageError(f"--tray {tray}: use letters, digits, - and _, but not {' or '.join(RESERVED_TRAY_NAMES)}")
    if output.exists() and not force:
        raise UserError(f"{output}: exists; name another file with -o, or replace it with --force")
    tachos = _tachos(tacho, pulses, window_s or [0.0], update_s, len(speed))
    auxiliary = auxiliary_options(supply_voltage, current, temperature)
    table = read_table(file, time, command, speed, period=period, auxiliary=auxiliary)
    write_table(table, output, tray, tachos)
    hints = tacho_hints(table.t_ns / NS_PER_S, table.speed_rad_s, tachos, range(table.fans))
    if json_output:
        typer.echo(json.dumps(import_summary(table, output) | {"hints": hints}))
        return
    fans = "1 fan" if table.fans == 1 else f"{table.fans} fans"
    period = f"{table.median_period_s * 1e3:.3g} ms apart (median)"
    typer.echo(f"{output}: {len(table.t_ns)} samples of {fans} over {table.duration_s:.1f} s, {period}")
    for note in (*filter(None, [table.assumed]), *table.notes):
        typer.echo(f"  {note}")
    for hint in hints:
        typer.echo(f"hint: {hint}; see --tacho and --window", err=True)


def _tachos(
    kind: Literal["instantaneous", "count", "average", "period"],
    pulses: int,
    windows_s: Sequence[float],
    update_s: float,
    fans: int,
) -> tuple[Tacho, ...]:
    try:
        tachos = [Tacho(kind=kind, pulses=pulses, window_s=window_s, update_s=update_s) for window_s in windows_s]
        tacho_of_each_fan(tachos, fans)
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(f"--tacho {kind}: {first['msg'].removeprefix('Value error, ')}; see --window") from error
    except ValueError as error:
        raise UsageError(f"--window: {error}") from error
    return tuple(tachos)


def write_table(table: Table, output: Path, tray: str, tachos: tuple[Tacho, ...] = INSTANTANEOUS) -> None:
    """Write the samples of a table as raw messages; the time of receipt is the time in the table.

    Raises:
        RecordingError: it cannot be written.
    """
    metadata = {
        "made_by": f"fantwin {version('fantwin')}",
        "source": table.path.name,
        "site": SITE,
        "trays": tray,
        "speed_unit": table.speed_unit,
    }
    if tachos != INSTANTANEOUS:
        metadata[f"{TACHO_KEY}.{tray}"] = tachos_to_json(tachos)
    with RecordingWriter(output, metadata, t_ns=int(table.t_ns[0]), overwrite=True) as writer:
        for sequence, first in enumerate(range(0, len(table.t_ns), SAMPLES_PER_MESSAGE)):
            rows = slice(first, first + SAMPLES_PER_MESSAGE)
            auxiliary: dict[str, Any] = {name: values[rows] for name, values in table.auxiliary.items()}
            raw = Raw(
                header=Header("import", sequence, tray),
                fans=table.fans,
                host_receive_t_ns=table.t_ns[rows],
                command=table.command[rows],
                speed_rad_s=table.speed_rad_s[rows],
                **auxiliary,
            )
            writer.add_message(tray_key(SITE, tray, "raw"), raw, int(table.t_ns[rows][-1]))


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

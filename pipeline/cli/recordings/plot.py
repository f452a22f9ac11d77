"""`fantwin plot`: a picture of the fans of a recording beside their twins."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from fantwin.pipeline.cli.options import JsonOption, fan_numbers
from fantwin.pipeline.cli.recordings.with_scores import with_scores
from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.extras import require


def plot(
    recordings: Annotated[list[Path], typer.Argument(metavar="REC.mcap...", help="A recording, or its parts.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The picture: .png, .svg or .pdf.")] = Path(
        "bands.png"
    ),
    tray: Annotated[str | None, typer.Option(help="Which tray, if there are several.")] = None,
    fans: Annotated[
        str | None, typer.Option(help="Which fans, e.g. 2,5. Default: with alarms, and one without.")
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of speed, rpm or rad/s. Default: the recording's.")] = None,
    truth: Annotated[Path | None, typer.Option(help="Truth file of a simulated tray, with its faults (JSON).")] = None,
    json_output: JsonOption = False,
) -> None:
    """Plot measured speed, prediction, band, alarms and states of a recording.

    Topics that the recorder left out (recorder.topics) are made again first.

    Exits with 3 if the recording could not be read in full, or if making the topics again shows that data were lost.
    The plot then shows the rest.

    Example: fantwin plot runs/demo/recording.mcap --truth runs/demo/truth.json -o bands.png
    """
    require("a plot", "report", "matplotlib")
    from fantwin.pipeline.outputs.rerun.band_plot import plot_recording  # noqa: PLC0415  an extra

    if unit not in ("rpm", "rad/s", None):
        raise UsageError(f"--unit {unit}: no such unit of speed; known: rpm, rad/s")
    chosen = fan_numbers(fans)
    with Console(stderr=True).status(f"drawing {output}"), with_scores(recordings, output) as scored:
        drawn, unread = plot_recording(scored.files, output, tray=tray, fans=chosen, speed_unit=unit, truth=truth)
    damage = [*scored.damage, *unread]
    if json_output:
        typer.echo(json.dumps({"plot": str(output), "fans": drawn, "damage": damage}))
    else:
        typer.echo(f"{output}: fans {', '.join(map(str, drawn))}")
    for line in (*damage, *scored.remarks):
        typer.echo(line, err=True)
    if damage:
        raise typer.Exit(3)

"""`fantwin view`: a recording as a view file for Rerun."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from fantwin.pipeline.cli.options import JsonOption, ViewLayout
from fantwin.pipeline.cli.recordings.with_scores import with_scores
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.extras import require


def view(
    recordings: Annotated[list[Path], typer.Argument(metavar="REC.mcap...", help="A recording, or its parts.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The view file to write.")] = Path("view.rrd"),
    layout: Annotated[
        ViewLayout, typer.Option(help="all: every fan; alarms: fans that were in alarm; wear: change over days.")
    ] = ViewLayout.ALL,
    window: Annotated[float, typer.Option(min=0.1, help="Length of time shown, s.")] = 30.0,
    fleet_above: Annotated[
        int, typer.Option(min=0, help="With more fans than this, an overview and few plots are shown.")
    ] = 64,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing view file.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Turn a recording into a view file that shows what the stage `viewer` shows live.

    Topics that the recorder left out (recorder.topics) are made again first.

    Exits with 3 if the recording could not be read in full, or if making the topics again shows that data were lost.
    The view then shows the rest.

    Example: fantwin view runs/demo/recording.mcap --layout alarms -o alarms.rrd
    """
    require("a view", "view")
    from fantwin.pipeline.outputs.rerun.recorded_view import recorded_site, write_view  # noqa: PLC0415  an extra
    from fantwin.pipeline.outputs.rerun.view_of_site import ViewOptions  # noqa: PLC0415

    if output.suffix != ".rrd":
        raise UsageError(f"{output}: name a file that ends in .rrd with -o")
    if output.exists() and not force:
        raise UserError(f"{output}: exists; name another file with -o, or use --force")
    with Console(stderr=True).status(f"drawing {output}"), with_scores(recordings, output) as scored:
        site = recorded_site(scored.files)
        output.unlink(missing_ok=True)
        options = ViewOptions(layout=layout.value, window_s=window, fleet_above=fleet_above)
        damage = [*scored.damage, *write_view(site, output, options)]
    fans = sum(tray.fans for tray in site.trays)
    if json_output:
        typer.echo(json.dumps({"view": str(output), "fans": fans, "damage": damage}))
    else:
        typer.echo(f"{output}: {fans} fans")
    for line in (*damage, *scored.remarks):
        typer.echo(line, err=True)
    if damage:
        raise typer.Exit(3)

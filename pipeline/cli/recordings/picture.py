"""`fantwin picture`: a view as a PNG, drawn by a headless Rerun viewer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from fantwin.pipeline.cli.options import JsonOption, ViewLayout, fan_numbers
from fantwin.pipeline.extras import require


def picture(
    view_file: Annotated[Path, typer.Argument(metavar="VIEW.rrd", help="View file of the viewer stage.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The PNG to write.")] = Path("view.png"),
    tray: Annotated[str | None, typer.Option(help="Which tray, if there are several.")] = None,
    fans: Annotated[str | None, typer.Option(help="Which fans, e.g. 2,5. Default: the first eight.")] = None,
    at: Annotated[
        float | None, typer.Option(help="End of the picture, s after the first sample. Default: the last sample.")
    ] = None,
    window: Annotated[float, typer.Option(min=0.1, help="Length of time shown, s.")] = 30.0,
    view: Annotated[str | None, typer.Option(help="Only this view, by part of its name, e.g. 'fan 2'.")] = None,
    layout: Annotated[
        ViewLayout, typer.Option(help="all: every fan; alarms: the fans that were in alarm; wear: change over days.")
    ] = ViewLayout.ALL,
    json_output: JsonOption = False,
) -> None:
    """Draw a view file as a picture with a headless Rerun viewer (needs a Vulkan driver).

    Example: fantwin picture runs/demo/view.rrd --fans 2,5 --at 25 -o view.png
    """
    require("a picture of a view", "view")
    from fantwin.pipeline.outputs.rerun.rerun_picture import draw_picture  # noqa: PLC0415  an extra

    with Console(stderr=True).status(f"drawing {view_file}"):
        drawn = draw_picture(
            view_file, tray=tray, fans=fan_numbers(fans), at_s=at, window_s=window, view=view, layout=layout.value
        )
    output.write_bytes(drawn.png)
    if json_output:
        typer.echo(json.dumps({"picture": str(output), "views": drawn.reports}))
        return
    typer.echo(f"{output}: {', '.join(sorted(drawn.reports))}")
    for name, reports in drawn.reports.items():
        for report in reports:
            typer.echo(f"{name}: {report}", err=True)

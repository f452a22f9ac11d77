"""`fantwin view`: a recording as a view file for Rerun, or as a plot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from fantwin.pipeline.cli.options import JsonOption, ViewLayout, fan_numbers, recorded_names
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.progress import working
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.extras import require
from fantwin.pipeline.files import temporary_folder
from fantwin.pipeline.recordings.left_out import RAW, left_out
from fantwin.pipeline.recordings.run_recordings import recorded_files
from fantwin.pipeline.replay.offline.outcome import Again, score_again

PLOTS = (".png", ".svg", ".pdf")


def view(
    files: Annotated[list[Path], typer.Argument(metavar="REC.mcap...", help="A recording, or its parts.")],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="What to write: a view file .rrd for Rerun, or a plot .png, .svg or .pdf."),
    ] = Path("view.rrd"),
    layout: Annotated[
        ViewLayout, typer.Option(help="all: every fan; alarms: fans that were in alarm; wear: change over days.")
    ] = ViewLayout.ALL,
    window: Annotated[float, typer.Option(min=0.1, help="Length of time shown, s.")] = 30.0,
    tray: Annotated[str | None, typer.Option(help="Plot: which tray, if there are several.")] = None,
    fans: Annotated[
        str | None, typer.Option(help="Plot: which fans, e.g. 0,2-5. Default: with alarms, and one without.")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Plot: unit of speed, rpm or rad/s. Default: the recording's.")
    ] = None,
    truth: Annotated[Path | None, typer.Option(help="Plot: truth of a simulated tray, with its faults (JSON).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing view file.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Turn a recording into a view file for Rerun, or plot its speeds, predictions, bands, alarms and states.

    Topics that the recorder left out (recorder.topics) are made again first. An imported recording has no twin: make
    its scores with `fantwin replay REC.mcap --offline --twin TWIN.onnx -o SCORED.mcap`.

    Exits with 3 if the recording could not be read in full, or if making the topics again shows that data were lost.
    The rest is shown then.

    Example: fantwin view runs/demo/recording.mcap --layout alarms -o alarms.rrd

    Example: fantwin view runs/demo/recording.mcap --truth runs/demo/truth.json -o bands.png
    """
    is_plot, chosen = output.suffix in PLOTS, fan_numbers(fans, recorded_names(files, tray))
    if unit not in ("rpm", "rad/s", None):
        raise UsageError(f"--unit {unit}: no such unit of speed; known: rpm, rad/s")
    if output.suffix not in (".rrd", *PLOTS):
        raise UsageError(f"{output}: name a file that ends in .rrd, {', '.join(PLOTS)} with -o")
    require("a plot", "report", "matplotlib") if is_plot else require("a view", "view")
    if output.exists() and not is_plot and not force:
        raise UserError(f"{output}: exists; name another file with -o, or use --force")
    with working(f"drawing {output}"), with_scores(files, output) as scored:
        if is_plot:
            from fantwin.pipeline.outputs.rerun.band_plot import plot_recording  # noqa: PLC0415  an extra

            drawn, shown, unread = plot_recording(
                scored.files, output, tray=tray, fans=chosen, speed_unit=unit, truth=truth
            )
            result: dict[str, Any] = {"plot": str(output), "fans": drawn}
        else:
            from fantwin.pipeline.outputs.rerun.recorded_view import recorded_site, write_view  # noqa: PLC0415  an extra
            from fantwin.pipeline.outputs.rerun.rerun_sink import ViewOptions  # noqa: PLC0415

            site = recorded_site(scored.files)
            output.unlink(missing_ok=True)
            unread = write_view(site, output, ViewOptions(layout=layout.value, window_s=window))
            result = {"view": str(output), "fans": sum(each.fans for each in site.trays)}
            shown = f"{result['fans']} fans"
    damage = [*scored.damage, *unread]
    show(result | {"damage": damage}, f"{output}: {shown}", json_output=json_output)
    for line in (*damage, *scored.remarks):
        typer.echo(line, err=True)
    if damage:
        raise typer.Exit(3)


@dataclass
class WithScores:
    """Files with scores, and what making them again has found, a line each."""

    files: list[Path]
    damage: list[str] = field(default_factory=list[str])
    """what is lost or could not be read"""
    remarks: list[str] = field(default_factory=list[str])


@contextmanager
def with_scores(recordings: Sequence[Path], output: Path) -> Iterator[WithScores]:
    """The files of a recording, or in their place a temporary file with all topics, beside what is made of it: it can
    be large, and the user has chosen that disk.

    Raises:
        UserError: a recording cannot be read, or scored again.
    """
    files = recorded_files(recordings)
    if not left_out(files, ("score",)) or left_out(files, (RAW,)):
        yield WithScores(files)
        return
    with temporary_folder(output.parent) as folder:
        found = score_again(tuple(files), Again(), folder)
        lost = [f"{files[0]}: {found['lost']} samples and messages lost"] if found["lost"] else []
        versions = (f"{line}: only the same version makes the same decisions" for line in found["other_version"])
        remarks = [*(f"not scored: {problem}" for problem in found["not_scored"]), *versions]
        yield WithScores([folder / files[0].name], [*found["damage"], *lost], remarks)

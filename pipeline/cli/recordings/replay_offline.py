"""`fantwin replay --offline`: recordings scored again, and their outcome, for people or as JSON."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape

from fantwin.pipeline.cli.in_parallel import RecordingsInParallel
from fantwin.pipeline.cli.printing import table_of
from fantwin.pipeline.cli.progress import interruptible, show_part
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.files import temporary_folder
from fantwin.pipeline.recordings.dates import format_utc, has_date
from fantwin.pipeline.recordings.records import active_path
from fantwin.pipeline.recordings.run_recordings import describe, recorded_files, recordings_of
from fantwin.pipeline.replay.offline.comparison import RELATIVE
from fantwin.pipeline.replay.offline.outcome import Again, score_again, together
from fantwin.schemas.fan_names import fan_cell, fan_label
from fantwin.schemas.messages import Diagnosis
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_text import deviation_in
from fantwin.scoring.diagnosis.causes import most_probable

EXIT_DIFFERS, EXIT_CANNOT_COMPARE, EXIT_LOST = 1, 2, 3
_SHOWN = 40
"""alarms that are listed"""
_WIDEST = 100
"""characters of a line of the list"""


def run_offline(
    files: Sequence[Path], again: Again, output: Path | None, pool: RecordingsInParallel, *, json_output: bool
) -> None:
    """Score, print, and exit with 0: success, 1: failed, 3: data were lost. With `verify`: 0 equal, 1 different,
    2 nothing is comparable, 3 equal as far as it is comparable. With 4: recordings were skipped.

    files: of one or many recordings; a folder stands for those in it. output: a recording to write; of many, a folder.

    Raises:
        UserError: it failed.
    """
    began_s = time.monotonic()
    try:
        with interruptible("nothing was written"), pool:
            recordings = recordings_of(pool.map(describe, recorded_files(files), "opening recordings"))
            with written_at_the_end(output, recordings) as folder:
                scored = list(pool.map(partial(_scored, again=again, folder=folder), recordings, "scoring"))
    except UserError as error:
        if not again.verify:
            raise
        _print_not_comparable(str(error), json_output)
        raise typer.Exit(EXIT_CANNOT_COMPARE) from error
    result = together(scored, time.monotonic() - began_s)
    if json_output:
        typer.echo(json.dumps(result | pool.as_json()))
    else:
        print_result(result, output)
    if again.verify:
        found = result["verified"]
        pool.end(EXIT_DIFFERS if not found["equal"] else EXIT_LOST if found["not_comparable"] else 0)
    pool.end(EXIT_LOST if result["lost"] or result["damage"] else 0)


def _scored(files: tuple[Path, ...], again: Again, folder: Path | None) -> dict[str, Any]:
    first: dict[str, int] = {}

    def progress(tray: str, t_ns: int) -> None:
        since_s = (t_ns - first.setdefault(tray, t_ns)) / NS_PER_S
        show_part(f"{tray}: {since_s:.0f} s of the recording")

    return score_again(files, again, folder, progress)


@contextmanager
def written_at_the_end(output: Path | None, recordings: Sequence[tuple[Path, ...]]) -> Iterator[Path | None]:
    """Yields a folder for the outputs of recordings, each under the name of the first part. Those that are there at the
    end get their places: `output` is that of one recording, or the folder of several. If the work fails, none does.

    Raises:
        UserError: a place is taken, or nothing can be written there.
    """
    if output is None:
        yield None
        return
    if len(recordings) > 1 and output.suffix == ".mcap":
        raise UsageError(f"-o {output}: these are {len(recordings)} recordings: name a folder")
    is_folder = len(recordings) > 1 or output.is_dir()
    places: dict[str, Path] = {}
    for path, *_ in recordings:
        place = output / path.name if is_folder else output
        if path.name in places:
            raise UserError(f"{path}: another recording has its name, and both would be written to {place}")
        _refuse_taken(place)
        places[path.name] = place
    with temporary_folder(output if is_folder else output.parent) as folder:
        yield folder
        for path in folder.iterdir():
            _refuse_taken(places[path.name])
            path.rename(places[path.name])


def _refuse_taken(place: Path) -> None:
    for path in (place, active_path(place)):
        if path.exists():
            raise UserError(f"{path}: exists already; give another name with -o, or remove it")


def print_result(result: dict[str, Any], output: Path | None) -> None:
    """For people, what `together` gives."""
    console = Console(highlight=False, soft_wrap=True)
    console.width = min(_WIDEST, console.width) if console.is_terminal else _WIDEST
    if "recordings" in result:
        _print_recordings(console, result)
    else:
        _print_alarms(console, "alarms", result["alarms"], result["start_ns"])
    alarms = sum(len(one["alarms"]) for one in result.get("recordings", [result]))
    console.print(
        f"{alarms} alarm{'s' * (alarms != 1)} in {_duration(result['hours'])}, {result['samples']} samples, "
        f"{result['lost']} lost; {result['times_real_time']:.0f} times real time"
    )
    if line := _not_judged(result):
        console.print(line, markup=False)
    for line in dict.fromkeys(result["warnings"]):
        console.print(f"[bold yellow]warning:[/bold yellow] {escape(line)}")
    for problem in result["not_scored"]:
        console.print(f"[bold yellow]not scored:[/bold yellow] {escape(problem)}")
    if result["restarts"]:
        console.print(f"{result['restarts']} restarts of stages, replayed as recorded")
    for damage in result["damage"]:
        console.print(f"[bold yellow]damaged:[/bold yellow] {escape(damage)}")
    for line in result["other_version"]:
        console.print(f"{line}: only the same version makes the same decisions", markup=False)
    for one in result.get("recordings", [result]):
        for name in ("gained", "lost") if "what_if" in one else ():
            found = one["what_if"][name]
            where = f"{one['files'][0]}: " if "recordings" in result else ""
            console.print(f"{where}against the recording: {len(found)} alarms {name}", markup=False)
            _print_alarms(console, name, found, one["start_ns"])
    if "verified" in result:
        _print_verified(result["verified"], console)
    if output:
        console.print(f"written to {output}", markup=False)


def _not_judged(result: dict[str, Any]) -> str:
    """The share of the samples of fans that could not be judged, and why; empty: all could."""
    reasons = Counter[str]()
    for one in result.get("recordings", [result]):
        for of_tray in one["not_judged"].values():
            reasons.update(of_tray)
    if not reasons:
        return ""
    why = ", ".join(f"{reason.replace('_', ' ')} {count}" for reason, count in reasons.most_common())
    return f"not judged: {reasons.total() / (reasons.total() + result['judged']):.1%} of the samples of fans ({why})"


def _print_recordings(console: Console, result: dict[str, Any]) -> None:
    """A row for each recording, and the alarms of those that have any."""
    table = table_of(["recording"], ("time", "alarms", "lost"))
    for one in result["recordings"]:
        alarms = str(len(one["alarms"]))
        table.add_row(escape(one["files"][0]), _duration(one["hours"]), alarms, str(one["lost"]))
    console.print(table)
    room = _SHOWN
    for one in result["recordings"]:
        if one["alarms"] and room > 0:
            _print_alarms(console, f"{one['files'][0]}: alarms", one["alarms"][:room], one["start_ns"])
        room -= len(one["alarms"])
    if room < 0:
        console.print(f"and {-room} more; all with --json")


def _duration(hours: float) -> str:
    return (
        f"{hours:.3g} h" if hours >= 1.0 else f"{hours * 60:.3g} min" if hours * 60 >= 1.0 else f"{hours * 3600:.3g} s"
    )


def _print_verified(found: dict[str, Any], console: Console) -> None:
    has_scores = "score" not in found["left_out"]
    what = "samples" if has_scores else "snapshots"
    if found["equal"]:
        largest = found["largest_difference"]
        within = (
            f"numbers within {RELATIVE:g} of their size (largest difference: {largest['difference']:.2g} in "
            f"{largest['name']})"
        )
        console.print(
            f"[bold green]equal:[/bold green] {found[f'{what}_equal']} {what} and {found['alarms_equal']} alarms; all "
            f"decisions are identical, {within if largest['share'] else 'and all numbers to the last digit'}"
        )
    else:
        different, equal = found[f"{what}_different"], found[f"{what}_equal"]
        not_made = f"{found['samples_not_made']} were not replayed, " if has_scores else ""
        console.print(
            f"[bold red]DIFFERS:[/bold red] {different} of {different + equal} {what} differ, {not_made}"
            f"{found['others_different']} of grid, predictions and overview differ, {found['alarms_different']} alarms "
            "differ; the first differences:"
        )
        _print_lines(console, found["differences"])
    if not has_scores:
        console.print("scores were not recorded (recorder.topics): alarms, snapshots and overview were compared")
    if found["not_comparable"]:
        console.print(
            f"[bold yellow]not comparable:[/bold yellow] {found[f'{what}_not_comparable']} {what} and "
            f"{found['alarms_not_comparable']} alarms:"
        )
        _print_lines(console, found["not_comparable"])
    if found["samples_not_recorded"]:
        console.print(f"{found['samples_not_recorded']} replayed samples are not in the recording")


def _print_lines(console: Console, lines: Sequence[str]) -> None:
    for line in lines:
        console.print(f"  {line}", markup=False)


def _print_alarms(console: Console, title: str, alarms: Sequence[dict[str, Any]], start_ns: int) -> None:
    if not alarms:
        return
    date = f" ({format_utc(start_ns)})" if has_date(start_ns) else ""
    title = f"{title}, s since the first sample{date}"
    table = table_of(["tray"], ("fan", "raised", "cleared"), ("severity", "probable cause", "what"), title=title)
    for column in table.columns[4:6]:
        column.no_wrap = True
    for one in alarms[:_SHOWN]:
        raised = f"{(one['raised_ns'] - start_ns) / NS_PER_S:.2f}"
        cleared = "active" if one["cleared_ns"] is None else f"{(one['cleared_ns'] - start_ns) / NS_PER_S:.2f}"
        first = "\n".join(most_probable([Diagnosis(**each) for each in one["causes"]])) or "-"
        # the message also names fan and first cause; both have columns of their own, with the newest cause
        fan = one["fan"], one["name"]
        what = deviation_in(one["message"].removeprefix(f"{fan_label(*fan)}: "))
        table.add_row(one["tray"], escape(fan_cell(*fan)), raised, cleared, one["severity"], first, escape(what))
    console.print(table)
    if len(alarms) > _SHOWN:
        console.print(f"and {len(alarms) - _SHOWN} more; all with --json")


def _print_not_comparable(reason: str, json_output: bool) -> None:
    if json_output:
        typer.echo(json.dumps({"verified": None, "cannot_compare": reason}))
    Console(stderr=True, soft_wrap=True, highlight=False).print(f"[red]could not compare:[/red] {escape(reason)}")

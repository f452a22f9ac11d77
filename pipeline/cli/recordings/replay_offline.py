"""`fantwin replay --offline`: score a recording again, compare, and print the result."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn
from rich.table import Table

from pipeline.errors import UserError
from pipeline.recordings.dates import format_utc, has_date
from pipeline.replay.offline.alarm_episodes import AlarmDiff, compare_episodes, episodes
from pipeline.replay.offline.comparison import CannotCompareError
from pipeline.replay.offline.replay_input import ReplayInput, open_replay_input
from pipeline.replay.offline.rescoring import RescoredTray, rescore
from schemas.messages import Diagnosis
from schemas.units import NS_PER_S
from scoring.diagnosis.shown_causes import most_probable

EXIT_DIFFERS, EXIT_CANNOT_COMPARE, EXIT_LOST = 1, 2, 3
_SHOWN = 40
"""alarms that are listed"""
_WIDEST = 100
"""characters of a line of the list"""


def run_offline(
    files: Sequence[Path],
    *,
    config: Path | None,
    overrides: Sequence[str],
    twin: Path | None,
    output: Path | None,
    verify: bool,
    start_s: float,
    end_s: float,
    json_output: bool,
) -> None:
    """Score, print, and exit with 0: success, 1: failed, 3: data were lost. With `verify`: 0 equal, 1 different,
    2 nothing is comparable, 3 equal as far as it is comparable.

    Raises:
        UserError: it failed.
    """
    began_s = time.monotonic()
    try:
        with open_replay_input(files, config, overrides, twin, start_s, end_s) as replay_input:
            if verify and not replay_input.is_as_recorded:
                raise CannotCompareError(
                    f"{files[0]}: --verify compares with the recording: leave out --twin, -c and --set, and give a "
                    "recording that holds its configuration"
                )
            trays = _rescored(replay_input, output, verify)
            took_s = time.monotonic() - began_s
            result = _result(replay_input, trays, took_s)
    except UserError as error:
        if not verify:
            raise
        _print_not_comparable(str(error), json_output)
        raise typer.Exit(EXIT_CANNOT_COMPARE) from error
    if json_output:
        typer.echo(json.dumps(result))
    else:
        _print_result(trays, result, output)
    problems = [tray.problem for tray in trays if tray.problem]
    if problems and not verify and not any(tray.scored for tray in trays):
        raise UserError(f"{files[0]}: {'; '.join(problems)}")
    if verify:
        found = result["verified"]
        raise typer.Exit(EXIT_DIFFERS if not found["equal"] else EXIT_LOST if found["not_comparable"] else 0)
    if result["lost"] or result["damage"]:
        raise typer.Exit(EXIT_LOST)


def _rescored(replay_input: ReplayInput, output: Path | None, verify: bool) -> list[RescoredTray]:
    columns = (SpinnerColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task("reading what each stage consumed")
        first: dict[str, int] = {}

        def progress(tray: str, t_ns: int) -> None:
            since_s = (t_ns - first.setdefault(tray, t_ns)) / NS_PER_S
            shown.update(task, description=f"scoring {tray}: {since_s:.0f} s so far")

        return rescore(replay_input, output, verify, progress)


def _result(replay_input: ReplayInput, trays: Sequence[RescoredTray], took_s: float) -> dict[str, Any]:
    now = episodes(alarm for tray in trays for alarm in tray.alarms)
    scored_s = sum(tray.hours for tray in trays) * 3600
    result: dict[str, Any] = {
        "alarms": [episode.as_json() for episode in now],
        "start_ns": replay_input.first_sample_t_ns,
        "hours": sum(tray.hours for tray in trays),
        "samples": sum(tray.samples for tray in trays),
        "lost": sum(tray.lost for tray in trays),
        "not_judged": {tray.tray: dict(tray.not_judged.most_common()) for tray in trays},
        "counts": {tray.tray: dict(sorted(tray.counts.items())) for tray in trays},
        "restarts": sum(tray.plan.restarts for tray in trays),
        "damage": list(replay_input.damage.values()),
        "took_s": took_s,
        "times_real_time": scored_s / took_s if took_s else math.inf,
    }
    compared = [tray.comparison for tray in trays if tray.comparison]
    if compared:
        result["verified"] = {
            "equal": all(one.is_equal for one in compared),
            "samples_equal": sum(one.equal for one in compared),
            "samples_different": sum(one.different for one in compared),
            "samples_not_made": sum(one.not_made for one in compared),
            "samples_not_recorded": sum(one.not_recorded for one in compared),
            "alarms_equal": sum(one.alarms_equal for one in compared),
            "alarms_different": sum(one.alarms_different for one in compared),
            "alarms_not_recorded": sum(one.alarms_not_recorded for one in compared),
            "samples_not_comparable": sum(one.not_comparable for one in compared),
            "alarms_not_comparable": sum(one.alarms_not_comparable for one in compared),
            "snapshots_equal": sum(one.snapshots_equal for one in compared),
            "snapshots_different": sum(one.snapshots_different for one in compared),
            "snapshots_not_comparable": sum(one.snapshots_not_comparable for one in compared),
            "left_out": list(replay_input.metadata.left_out),
            "not_comparable": [reason for one in compared for reason in one.reasons],
            "differences": [line for one in compared for line in one.named],
        }
    elif not replay_input.is_as_recorded and any(tray.recorded_alarms for tray in trays):
        within = [
            alarm for tray in trays for alarm in tray.recorded_alarms if tray.start_ns <= alarm.t_ns <= tray.end_ns
        ]
        what_if = compare_episodes(now, episodes(within))
        result["what_if"] = _what_if(what_if)
    return result


def _what_if(found: AlarmDiff) -> dict[str, Any]:
    return {name: [episode.as_json() for episode in getattr(found, name)] for name in ("gained", "lost", "kept")}


def _print_result(trays: Sequence[RescoredTray], result: dict[str, Any], output: Path | None) -> None:
    console = Console(highlight=False, soft_wrap=True)
    console.width = min(_WIDEST, console.width) if console.is_terminal else _WIDEST
    now, start_ns = result["alarms"], result["start_ns"]
    _print_alarms(console, "alarms", now, start_ns)
    console.print(
        f"{len(now)} alarm{'s' * (len(now) != 1)} in {_duration(result['hours'])}, {result['samples']} samples, "
        f"{result['lost']} lost; "
        f"{result['times_real_time']:.0f} times real time"
    )
    for tray in trays:
        if tray.problem:
            console.print(f"[bold yellow]not scored:[/bold yellow] {escape(tray.problem)}")
    if result["restarts"]:
        console.print(f"{result['restarts']} restarts of stages, replayed as recorded")
    for damage in result["damage"]:
        console.print(f"[bold yellow]damaged:[/bold yellow] {escape(damage)}")
    if "what_if" in result:
        for name in ("gained", "lost"):
            found = result["what_if"][name]
            console.print(f"against the recording: {len(found)} alarms {name}")
            _print_alarms(console, name, found, start_ns)
    if "verified" in result:
        _print_verified(result["verified"], console)
    if output:
        console.print(f"written to {output}", markup=False)


def _duration(hours: float) -> str:
    return (
        f"{hours:.3g} h" if hours >= 1.0 else f"{hours * 60:.3g} min" if hours * 60 >= 1.0 else f"{hours * 3600:.3g} s"
    )


def _print_verified(found: dict[str, Any], console: Console) -> None:
    has_scores = "score" not in found["left_out"]
    what = "samples" if has_scores else "snapshots"
    if found["equal"]:
        console.print(
            f"[bold green]equal:[/bold green] {found[f'{what}_equal']} {what} and {found['alarms_equal']} alarms, "
            "to the bit"
        )
    else:
        different, equal = found[f"{what}_different"], found[f"{what}_equal"]
        not_made = f"{found['samples_not_made']} were not replayed, " if has_scores else ""
        console.print(
            f"[bold red]DIFFERS:[/bold red] {different} of {different + equal} {what} differ, {not_made}"
            f"{found['alarms_different']} alarms differ; the first differences:"
        )
        for line in found["differences"]:
            console.print(f"  {line}", markup=False)
    if not has_scores:
        console.print("scores were not recorded (recorder.topics): alarms and the scorers' snapshots were compared")
    if found["not_comparable"]:
        console.print(
            f"[bold yellow]not comparable:[/bold yellow] {found[f'{what}_not_comparable']} {what} and "
            f"{found['alarms_not_comparable']} alarms:"
        )
        for reason in found["not_comparable"]:
            console.print(f"  {reason}", markup=False)
    if found["samples_not_recorded"]:
        console.print(f"{found['samples_not_recorded']} replayed samples are not in the recording")


def _print_alarms(console: Console, title: str, alarms: Sequence[dict[str, Any]], start_ns: int) -> None:
    if not alarms:
        return
    date = f" ({format_utc(start_ns)})" if has_date(start_ns) else ""
    console.print(_table(f"{title}, s since the first sample{date}", alarms[:_SHOWN], start_ns))
    if len(alarms) > _SHOWN:
        console.print(f"and {len(alarms) - _SHOWN} more; all with --json")


def _table(title: str, alarms: Sequence[dict[str, Any]], start_ns: int) -> Table:
    table = Table("tray", title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("fan", "raised", "cleared"):
        table.add_column(column, justify="right")
    for column in ("severity", "probable cause"):
        table.add_column(column, no_wrap=True)
    table.add_column("what")
    for one in alarms:
        raised = f"{(one['raised_ns'] - start_ns) / NS_PER_S:.2f}"
        cleared = "active" if one["cleared_ns"] is None else f"{(one['cleared_ns'] - start_ns) / NS_PER_S:.2f}"
        first = "\n".join(most_probable([Diagnosis(**each) for each in one["causes"]])) or "-"
        # the message also names fan and first cause; both have columns of their own, with the newest cause
        what = one["message"].removeprefix(f"fan {one['fan']}: ").partition("; ")[0]
        table.add_row(one["tray"], str(one["fan"]), raised, cleared, one["severity"], first, escape(what))
    return table


def _print_not_comparable(reason: str, json_output: bool) -> None:
    if json_output:
        typer.echo(json.dumps({"verified": None, "cannot_compare": reason}))
    Console(stderr=True, soft_wrap=True, highlight=False).print(f"[red]could not compare:[/red] {escape(reason)}")

"""`fantwin replay --offline`: recordings scored again, compared, and the result of all."""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fantwin.pipeline.cli.in_parallel import RecordingsInParallel
from fantwin.pipeline.cli.printing import table_of
from fantwin.pipeline.cli.progress import interruptible, show_part
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.files import make_folder
from fantwin.pipeline.recordings.dates import format_utc, has_date
from fantwin.pipeline.recordings.records import MADE_BY_KEY, active_path, this_program
from fantwin.pipeline.recordings.run_recordings import describe, recorded_files, recordings_of
from fantwin.pipeline.replay.offline.alarm_episodes import AlarmDiff, compare_episodes, episodes
from fantwin.pipeline.replay.offline.comparison import RELATIVE, CannotCompareError
from fantwin.pipeline.replay.offline.replay_input import ReplayInput, open_replay_input
from fantwin.pipeline.replay.offline.rescoring import RescoredTray, rescore
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
                scored = list(pool.map(partial(score_again, again=again, folder=folder), recordings, "scoring"))
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
    folder = make_folder(output if is_folder else output.parent)
    try:
        unfinished = TemporaryDirectory(dir=folder, prefix=".replay-")
    except OSError as error:
        raise UserError(f"{folder}: cannot be written: {error.strerror}; name another folder with -o") from error
    with unfinished as name:
        yield Path(name)
        for path in Path(name).iterdir():
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


def _print_recordings(console: Console, result: dict[str, Any]) -> None:
    """A row for each recording, and the alarms of those that have any."""
    table = Table("recording", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("time", "alarms", "lost"):
        table.add_column(column, justify="right", no_wrap=True)
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
        console.print(
            f"[bold green]equal:[/bold green] {found[f'{what}_equal']} {what} and {found['alarms_equal']} alarms; all "
            f"decisions are identical, {_of_numbers(found['largest_difference'])}"
        )
    else:
        different, equal = found[f"{what}_different"], found[f"{what}_equal"]
        not_made = f"{found['samples_not_made']} were not replayed, " if has_scores else ""
        console.print(
            f"[bold red]DIFFERS:[/bold red] {different} of {different + equal} {what} differ, {not_made}"
            f"{found['inputs_different']} of the grid and of predictions differ, {found['alarms_different']} alarms "
            "differ; the first differences:"
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


def _of_numbers(largest: dict[str, Any]) -> str:
    if not largest["share"]:
        return "and all numbers to the last digit"
    return (
        f"numbers within {RELATIVE:g} of their size (largest difference: {largest['difference']:.2g} in "
        f"{largest['name']})"
    )


def _print_alarms(console: Console, title: str, alarms: Sequence[dict[str, Any]], start_ns: int) -> None:
    if not alarms:
        return
    date = f" ({format_utc(start_ns)})" if has_date(start_ns) else ""
    console.print(_table(f"{title}, s since the first sample{date}", alarms[:_SHOWN], start_ns))
    if len(alarms) > _SHOWN:
        console.print(f"and {len(alarms) - _SHOWN} more; all with --json")


def _table(title: str, alarms: Sequence[dict[str, Any]], start_ns: int) -> Table:
    table = table_of(["tray"], ("fan", "raised", "cleared"), ("severity", "probable cause", "what"), title=title)
    for column in table.columns[4:6]:
        column.no_wrap = True
    for one in alarms:
        raised = f"{(one['raised_ns'] - start_ns) / NS_PER_S:.2f}"
        cleared = "active" if one["cleared_ns"] is None else f"{(one['cleared_ns'] - start_ns) / NS_PER_S:.2f}"
        first = "\n".join(most_probable([Diagnosis(**each) for each in one["causes"]])) or "-"
        # the message also names fan and first cause; both have columns of their own, with the newest cause
        what = deviation_in(one["message"], one["fan"])
        table.add_row(one["tray"], str(one["fan"]), raised, cleared, one["severity"], first, escape(what))
    return table


def _print_not_comparable(reason: str, json_output: bool) -> None:
    if json_output:
        typer.echo(json.dumps({"verified": None, "cannot_compare": reason}))
    Console(stderr=True, soft_wrap=True, highlight=False).print(f"[red]could not compare:[/red] {escape(reason)}")


SUMS = ("hours", "samples", "lost", "restarts")
LISTS = ("not_scored", "damage", "other_version")
"""of a result, that those of many recordings have together"""

_COUNTS_OF_SAMPLES = ("equal", "different", "not_made", "not_recorded", "not_comparable")
_OTHER_COUNTS = (
    "inputs_different",
    *(f"alarms_{name}" for name in ("equal", "different", "not_recorded", "not_comparable")),
    *(f"snapshots_{name}" for name in ("equal", "different", "not_comparable")),
)
"""fields of a `Comparison`"""


@dataclass(frozen=True)
class Again:
    """How recordings are scored; see the options of `fantwin replay`."""

    config: Path | None = None
    overrides: tuple[str, ...] = ()
    twin: Path | None = None
    verify: bool = False
    start_s: float = 0.0
    end_s: float = math.inf


def score_again(files: tuple[Path, ...], again: Again, folder: Path | None) -> dict[str, Any]:
    """The result for one recording as JSON fields. folder: where a new recording is written, under its name.

    Raises:
        UserError: it cannot be scored, or with `verify` not be compared.
    """
    output = folder / files[0].name if folder else None
    with open_replay_input(
        files, again.config, again.overrides, again.twin, again.start_s, again.end_s
    ) as replay_input:
        if again.verify and not replay_input.is_as_recorded:
            raise CannotCompareError(
                f"{files[0]}: --verify compares with the recording: leave out --twin, -c and --set, and give a "
                "recording that holds its configuration"
            )
        trays = _rescored(replay_input, output, verify=again.verify)
        result = _result(replay_input, trays)
    if result["not_scored"] and not again.verify and not any(tray.scored for tray in trays):
        if output:
            output.unlink()
        raise UserError(f"{files[0]}: {'; '.join(result['not_scored'])}")
    return result


def together(results: Sequence[dict[str, Any]], took_s: float) -> dict[str, Any]:
    """The results of recordings as one: that of a single one as it is, those of many as `recordings`, with sums."""
    result: dict[str, Any] = dict(results[0])
    if len(results) > 1:
        result = {"recordings": list(results)}
        result |= {name: sum(one[name] for one in results) for name in SUMS}
        result |= {name: [line for one in results for line in one[name]] for name in LISTS}
        if all("verified" in one for one in results):
            result["verified"] = _verified([one["verified"] for one in results])
    scored_s = result["hours"] * 3600
    return result | {"took_s": took_s, "times_real_time": scored_s / took_s if took_s else math.inf}


def _rescored(replay_input: ReplayInput, output: Path | None, *, verify: bool) -> list[RescoredTray]:
    first: dict[str, int] = {}

    def progress(tray: str, t_ns: int) -> None:
        since_s = (t_ns - first.setdefault(tray, t_ns)) / NS_PER_S
        show_part(f"{tray}: {since_s:.0f} s so far")

    return rescore(replay_input, output, verify, progress)


def _result(replay_input: ReplayInput, trays: Sequence[RescoredTray]) -> dict[str, Any]:
    now = episodes(alarm for tray in trays for alarm in tray.alarms)
    result: dict[str, Any] = {
        "files": [str(path) for path in replay_input.paths],
        "alarms": [episode.as_json() for episode in now],
        "start_ns": replay_input.first_sample_t_ns,
        "hours": sum(tray.hours for tray in trays),
        "samples": sum(tray.samples for tray in trays),
        "lost": sum(tray.lost for tray in trays),
        "not_judged": {tray.tray: dict(tray.not_judged.most_common()) for tray in trays},
        "not_scored": [tray.problem for tray in trays if tray.problem],
        "counts": {tray.tray: dict(sorted(tray.counts.items())) for tray in trays},
        "restarts": sum(tray.plan.restarts for tray in trays),
        "damage": list(replay_input.damage.values()),
        "other_version": _other_version(replay_input),
    }
    compared = [tray.comparison for tray in trays if tray.comparison]
    if compared:
        result["verified"] = {
            "equal": all(one.is_equal for one in compared),
            **{f"samples_{name}": sum(getattr(one, name) for one in compared) for name in _COUNTS_OF_SAMPLES},
            **{name: sum(getattr(one, name) for one in compared) for name in _OTHER_COUNTS},
            "largest_difference": max(one.largest for one in compared)._asdict(),
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


def _other_version(replay_input: ReplayInput) -> list[str]:
    """A line if another version of fantwin wrote the recording."""
    made_by = replay_input.metadata.metadata.get(MADE_BY_KEY, "")
    if made_by == this_program():
        return []
    return [f"{replay_input.paths[0]}: recorded by {made_by or 'an unknown program'}, replayed by {this_program()}"]


def _what_if(found: AlarmDiff) -> dict[str, Any]:
    return {name: [episode.as_json() for episode in getattr(found, name)] for name in ("gained", "lost", "kept")}


def _verified(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Comparisons of several recordings together: lists one after another, numbers summed."""
    counts = Counter[str]()
    for one in found:
        counts.update({name: value for name, value in one.items() if isinstance(value, int) and name != "equal"})
    return {
        "equal": all(one["equal"] for one in found),
        **counts,
        "largest_difference": max((one["largest_difference"] for one in found), key=itemgetter("share")),
        "left_out": list(dict.fromkeys(topic for one in found for topic in one["left_out"])),
        "not_comparable": [line for one in found for line in one["not_comparable"]],
        "differences": [line for one in found for line in one["differences"]],
    }

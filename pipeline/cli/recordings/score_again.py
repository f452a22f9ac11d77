"""One recording scored again, in whichever process, and the results of many together."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

from fantwin.pipeline.cli.progress import show_part
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.records import MADE_BY_KEY, this_program
from fantwin.pipeline.replay.offline.alarm_episodes import AlarmDiff, compare_episodes, episodes
from fantwin.pipeline.replay.offline.comparison import CannotCompareError
from fantwin.pipeline.replay.offline.replay_input import ReplayInput, open_replay_input
from fantwin.pipeline.replay.offline.rescoring import RescoredTray, rescore
from fantwin.schemas.units import NS_PER_S

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

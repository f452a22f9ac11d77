"""Recordings scored again: the outcome of one, and of many together, as JSON fields."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.prediction.tray_twin import TrayTwin, load_tray_twin
from fantwin.pipeline.recordings.records import MADE_BY_KEY, this_program
from fantwin.pipeline.replay.offline.alarm_episodes import compare_episodes, episodes
from fantwin.pipeline.replay.offline.comparison import CannotCompareError
from fantwin.pipeline.replay.offline.replay_input import ReplayInput, open_replay_input
from fantwin.pipeline.replay.offline.rescoring import Progress, RescoredTray, rescore
from fantwin.schemas.twin_card import NOT_CALIBRATED

SUMS = ("hours", "samples", "judged", "lost", "restarts")
LISTS = ("not_scored", "damage", "other_version", "warnings")
"""of an outcome, that those of many recordings have together"""


@dataclass(frozen=True)
class Again:
    """How recordings are scored; see the options of `fantwin replay`."""

    config: Path | None = None
    overrides: tuple[str, ...] = ()
    twin: Path | None = None
    verify: bool = False
    start_s: float = 0.0
    end_s: float = math.inf


def score_again(
    files: tuple[Path, ...], again: Again, folder: Path | None, progress: Progress = lambda _tray, _t_ns: None
) -> dict[str, Any]:
    """The outcome for one recording. folder: where a new recording is written, under its name.

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
        trays = rescore(replay_input, output, again.verify, progress)
        outcome = _outcome(replay_input, trays)
        if again.twin:
            outcome["warnings"] = twin_warnings(again.twin, load_tray_twin(again.twin), trays)
    if outcome["not_scored"] and not again.verify and not any(tray.scored for tray in trays):
        if output:
            output.unlink()
        raise UserError(f"{files[0]}: {'; '.join(outcome['not_scored'])}")
    return outcome


def together(outcomes: Sequence[dict[str, Any]], took_s: float) -> dict[str, Any]:
    """The outcomes of recordings as one: that of a single one as it is, those of many as `recordings`, with sums."""
    found: dict[str, Any] = dict(outcomes[0])
    if len(outcomes) > 1:
        found = {"recordings": list(outcomes)}
        found |= {name: sum(one[name] for one in outcomes) for name in SUMS}
        found |= {name: [line for one in outcomes for line in one[name]] for name in LISTS}
        if all("verified" in one for one in outcomes):
            found["verified"] = _verified([one["verified"] for one in outcomes])
    scored_s = found["hours"] * 3600
    return found | {"took_s": took_s, "times_real_time": scored_s / took_s if took_s else math.inf}


def _outcome(replay_input: ReplayInput, trays: Sequence[RescoredTray]) -> dict[str, Any]:
    now = episodes(alarm for tray in trays for alarm in tray.alarms)
    made_by = replay_input.metadata.metadata.get(MADE_BY_KEY, "") or "an unknown program"
    versions = f"{replay_input.paths[0]}: recorded by {made_by}, replayed by {this_program()}"
    outcome: dict[str, Any] = {
        "files": [str(path) for path in replay_input.paths],
        "alarms": [episode.as_json() for episode in now],
        "start_ns": replay_input.first_sample_t_ns,
        "hours": sum(tray.hours for tray in trays),
        "samples": sum(tray.samples for tray in trays),
        "lost": sum(tray.lost for tray in trays),
        "judged": sum(tray.judged for tray in trays),
        "not_judged": {tray.tray: dict(tray.not_judged.most_common()) for tray in trays},
        "not_scored": [tray.problem for tray in trays if tray.problem],
        "counts": {tray.tray: dict(sorted(tray.counts.items())) for tray in trays},
        "restarts": sum(tray.plan.restarts for tray in trays),
        "damage": list(replay_input.damage.values()),
        "other_version": [versions] if made_by != this_program() else [],
        "warnings": [],
    }
    if compared := [tray.comparison.as_json() for tray in trays if tray.comparison]:
        outcome["verified"] = _verified(compared)
    elif not replay_input.is_as_recorded and any(tray.recorded_alarms for tray in trays):
        before = episodes(
            alarm for tray in trays for alarm in tray.recorded_alarms if tray.start_ns <= alarm.t_ns <= tray.end_ns
        )
        outcome["what_if"] = {
            name: [episode.as_json() for episode in found] for name, found in compare_episodes(now, before).items()
        }
    return outcome


def twin_warnings(name: Path | str, twin: TrayTwin, trays: Sequence[RescoredTray]) -> list[str]:
    """What speaks against the decisions of a twin: it is not calibrated, or does not follow the fans."""
    uncalibrated = f"{name} {NOT_CALIBRATED}; see `fantwin calibrate`"
    return [*([] if twin.card.calibration else [uncalibrated]), *(tray.misfit for tray in trays if tray.misfit)]


def _verified(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Comparisons of trays or of recordings together: lists one after another, numbers summed."""
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

"""`fantwin info --wear` and `fantwin status --wear`: from recordings, and from a running site over a real bus."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.runtime.stage import Core
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Message, ScorerSnapshot
from fantwin.scoring.wear.recorded_wear import shown
from fantwin.scoring.wear.trend import NS_PER_DAY
from tests.support.fantwin_command import error_of, fantwin
from tests.support.running_chain import SITE, TRAY
from tests.support.running_scorer import RunningScorer
from tests.support.small_recordings import write
from tests.support.wear_data import LOSS, START_NS, worn_snapshot

FANS, HEALTHY, WORN = 3, 0, 1
PER_DAY = -LOSS / 30.0


@pytest.fixture(scope="module")
def notes() -> list[ScorerSnapshot]:
    """The snapshots of a scorer after 15 days and after 30."""
    made = [(days, worn_snapshot(TRAY, FANS, WORN, START_NS + days * NS_PER_DAY, days)) for days in (15, 30)]
    return [replace(snapshot, header=Header("scorer-1", days, TRAY)) for days, snapshot in made]


def recording(path: Path, notes: Sequence[ScorerSnapshot]) -> Path:
    return write(path, notes, {"site": SITE}, at=attrgetter("t_ns"))


def rows(*words: object) -> dict[int, dict[str, Any]]:
    done = fantwin("status" if "-c" in words else "info", "--wear", *words, "--json")
    assert done.exit_code == 0, done.exception
    return {row["fan"]: row for row in json.loads(done.stdout)["wear"]}


def test_a_recording_reports_what_wears_and_when_its_limit_is_reached(tmp_path, notes):
    found = rows(recording(tmp_path / "r.mcap", notes))
    assert sorted(found) == list(range(FANS))
    worn = found[WORN]
    assert worn["t_ns"] == notes[-1].t_ns and 0 <= worn["t_ns"] - worn["seen_t_ns"] < NS_PER_DAY // 24
    assert (worn["parameter"], worn["unit"], worn["limit"]) == ("speed", "relative", 0.1)
    assert worn["change"] == pytest.approx(-LOSS, abs=2.0 * worn["change_std_error"])
    assert abs(worn["beside"]) < 0.02
    assert worn["per_day"]["low"] < PER_DAY < worn["per_day"]["high"] < 0.0
    earliest, likely, latest = (
        (worn["reached_t_ns"][name] - START_NS) / NS_PER_DAY for name in ("earliest", "likely", "latest")
    )
    assert earliest < 60.0 < latest and likely == pytest.approx(60.0, rel=0.15)
    assert found[HEALTHY]["reached_t_ns"] is None
    assert found[HEALTHY]["unknown_reason"]


def test_people_are_shown_a_table_that_says_when_its_values_hold(tmp_path, notes):
    done = fantwin("info", "--wear", recording(tmp_path / "r.mcap", notes))
    assert done.exit_code == 0
    lines = done.stdout.splitlines()
    assert lines[0].startswith(f"wear of {TRAY} up to ")
    (worn,) = [line for line in lines if line.lstrip().startswith(f"{WORN}  ")]
    seen_t_ns = json.loads(notes[-1].state_json)["wear"]["fans"][WORN]["seen_t_ns"]
    at = f"{datetime.fromtimestamp(seen_t_ns / 1e9):%m-%d %H:%M}"
    columns = r"-\d\.\d ± 1\.\d +[+-]\d\.\d +-0\.1\d\d ± 0\.0\d\d +in \d+ days \(\d+ to \d+\)"
    assert re.search(f"{at} +{columns}", worn)
    assert [line for line in lines if "no significant trend" in line]
    assert "% of the speed, ± 95 %, since commissioning; beside: the change of the fans beside it" in lines[-1]


def without_points(note: ScorerSnapshot, *fans: int) -> ScorerSnapshot:
    state = json.loads(note.state_json)
    for fan in fans:
        state["wear"]["fans"][fan] |= dict.fromkeys(shown(None))
    return replace(note, state_json=json.dumps(state))


def test_a_fan_without_points_is_named_below_the_table_and_a_tray_without_is_one_line(tmp_path, notes):
    path = recording(tmp_path / "r.mcap", [without_points(notes[0], HEALTHY)])
    assert set(rows(path)) == set(range(FANS)) - {HEALTHY}
    later = "a fan has its first point about an hour after commissioning"
    assert f"no data yet for fan {HEALTHY}: {later}" in fantwin("info", "--wear", path).stdout
    path = recording(tmp_path / "none.mcap", [without_points(notes[0], *range(FANS))])
    assert error_of("info", "--wear", path, "--json").startswith(f"no data yet for any fan of {TRAY}: {later}")


@pytest.mark.parametrize("state", ["no json", '{"wear": {"fans": [{}]}}'])
def test_a_recording_without_wear_is_one_line(tmp_path, notes, state):
    path = recording(tmp_path / "r.mcap", [replace(notes[0], state_json=state)])
    assert error_of("info", "--wear", path) == f"no wear in {path}: a scorer records it regularly and when it stops"


class SnapshotSender(Core):
    """Sends the snapshots it was given."""

    def __init__(self, notes: Sequence[ScorerSnapshot]) -> None:
        self._notes = list(notes)
        self.has_sent = threading.Event()

    def step(self, item: object) -> Sequence[Message]:
        return []

    def tick(self, now_ns: int) -> Sequence[Message]:
        notes, self._notes = self._notes, []
        if not notes:
            self.has_sent.set()
        return notes


def test_a_running_site_reports_the_same_and_one_whose_scorer_has_noted_nothing_says_so(
    endpoint, tmp_path, notes, monkeypatch
):
    monkeypatch.setattr("fantwin.pipeline.runtime.runner.HEALTH_PERIOD_S", 0.05)  # every command waits for the next one
    for noted in ([], notes):
        core = SnapshotSender(noted)
        scorer = RunningScorer(endpoint, core)
        try:
            assert core.has_sent.wait(20)
            if noted:
                assert rows(*scorer.words) == rows(recording(tmp_path / "r.mcap", notes))
            else:
                expected = "no scorer has recorded wear so far: it does so regularly; try again later"
                assert error_of("status", "--wear", *scorer.words) == expected
        finally:
            scorer.end()

"""`fantwin wear`: from recordings, and from a running site over a real bus."""

from __future__ import annotations

import json
import pickle
import re
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.config.loading import load_config
from pipeline.recordings.writing import RecordingWriter
from pipeline.runtime.healthy_twin import ScorerConfig
from pipeline.runtime.runner import Runner
from pipeline.runtime.stage import BuiltStage, Core, Stage
from schemas.header import Header
from schemas.messages import Message, ScorerSnapshot
from schemas.topics import tray_key
from tests.pipeline.cli.conftest import MadeOnce
from tests.scoring.wear.test_wear_monitor import (
    DAY_NS,
    GROWTH_PER_DAY,
    HEALTHY,
    LIMIT,
    WORN,
    core_for_days,
    live_through,
)
from tests.support.fantwin_command import error_of, fantwin
from tests.support.running_chain import DEMO, SITE, TRAY
from tests.support.scored_blocks import EPOCH_NS, snapshot_of

KEY = tray_key(SITE, TRAY, "snapshot")


@pytest.fixture(scope="module")
def notes(made_once: MadeOnce) -> list[ScorerSnapshot]:
    """The snapshots of a scorer after three days and after six."""

    def make(folder: Path) -> None:
        worn, noted = core_for_days(), []
        for number, (from_day, days) in enumerate(((0, 3), (3, 6))):
            assert list(live_through(worn, days, from_day, swing=0.005)) == []
            noted.append(replace(snapshot_of(worn), header=Header("scorer-1", number, TRAY)))
        (folder / "notes").write_bytes(pickle.dumps(noted))

    return pickle.loads((made_once("wear", make) / "notes").read_bytes())


def recording(path: Path, notes: Sequence[ScorerSnapshot]) -> Path:
    with RecordingWriter(path, {}) as writer:
        for memory in notes:
            writer.add_message(KEY, memory, memory.t_ns)
    return path


def rows(*words: object) -> dict[tuple[int, str], dict[str, Any]]:
    done = fantwin("wear", *words, "--json")
    assert done.exit_code == 0, done.exception
    return {(row["fan"], row["parameter"]): row for row in json.loads(done.stdout)["wear"]}


def test_a_recording_reports_what_wears_and_when_its_limit_is_reached(tmp_path, notes):
    found = rows(recording(tmp_path / "r.mcap", notes))
    assert sorted(found) == [(fan, name) for fan in (0, 1) for name in ("balance", "drag", "friction", "gain")]
    balance = found[WORN, "balance"]
    assert balance["t_ns"] == notes[-1].t_ns
    assert balance["change"] == pytest.approx(6 * GROWTH_PER_DAY, rel=0.1)
    assert balance["per_day"]["low"] < GROWTH_PER_DAY < balance["per_day"]["high"]
    assert balance["limit"] == pytest.approx(LIMIT)
    likely = (balance["reached_t_ns"]["likely"] - EPOCH_NS) / DAY_NS
    assert likely == pytest.approx(LIMIT / GROWTH_PER_DAY, rel=0.1)
    assert found[HEALTHY, "balance"]["reached_t_ns"] is None
    assert found[HEALTHY, "balance"]["unknown_reason"]


def test_parts_in_any_order_give_the_last_snapshot(tmp_path, notes):
    first, second = (recording(tmp_path / f"{k}.mcap", [note]) for k, note in enumerate(notes))
    assert rows(second, first) == rows(second)
    assert rows(first) != rows(second)


def test_people_are_shown_a_table(tmp_path, notes):
    done = fantwin("wear", recording(tmp_path / "r.mcap", notes))
    assert done.exit_code == 0
    lines = done.stdout.splitlines()
    assert lines[0].startswith(f"wear of {TRAY} up to ")
    (worn,) = [line for line in lines if line.lstrip().startswith("1  ")]
    assert re.search(r"balance +\+0.3\d+ +\+0.0\d+ ± 0.0\d+ +in 6.\d days \(", worn)
    assert not [line for line in lines if line.lstrip().startswith("drag") and "days" in line]
    assert "balance, friction: command in %; drag, gain: % of healthy" in lines[-2]


def test_before_a_trend_the_error_of_the_last_point_is_shown(tmp_path, notes):
    state = json.loads(notes[0].state_json)
    drag = state["wear"]["fans"][WORN]["parameters"]["drag"]
    drag |= {"change": 0.275, "per_day": None}
    drag["series"]["std_error"][-1] = 0.18
    early = replace(notes[0], state_json=json.dumps(state))
    path = recording(tmp_path / "r.mcap", [early])
    found = rows(path)
    assert found[WORN, "drag"]["change_std_error"] == 0.18
    trend = rows(recording(tmp_path / "later.mcap", notes))[WORN, "balance"]
    assert trend["per_day"] and trend["change_std_error"] is None
    assert re.search(r"drag +\+27.5 ± 36 +no trend yet", fantwin("wear", path).stdout)


def without_points(note: ScorerSnapshot, *fans: int) -> ScorerSnapshot:
    state = json.loads(note.state_json)
    for fan in fans:
        state["wear"]["fans"][fan]["t_ns"] = 0
        for reported in state["wear"]["fans"][fan]["parameters"].values():
            series = reported["series"]
            reported.clear()
            reported |= {"unit": "relative", "series": series}
    return replace(note, state_json=json.dumps(state))


def test_a_fan_without_points_is_named_below_the_table_and_a_tray_without_is_one_line(tmp_path, notes):
    path = recording(tmp_path / "r.mcap", [without_points(notes[0], HEALTHY)])
    assert {fan for fan, _ in rows(path)} == {WORN}
    later = "a fan has its first point some time after commissioning"
    assert f"no data yet for fan 0: {later}" in fantwin("wear", path).stdout
    path = recording(tmp_path / "none.mcap", [without_points(notes[0], HEALTHY, WORN)])
    assert error_of("wear", path, "--json").startswith(f"no data yet for any fan of {TRAY}: {later}")


@pytest.mark.parametrize("state", ["no json", '{"wear": {"fans": [{}]}}'])
def test_a_recording_without_wear_is_one_line(tmp_path, notes, state):
    path = recording(tmp_path / "r.mcap", [replace(notes[0], state_json=state)])
    assert error_of("wear", path) == f"no wear in {path}: a scorer records it regularly and when it stops"


def test_a_recording_that_cannot_be_read_in_full_is_shown_as_far_as_it_is_readable(tmp_path, notes):
    path = recording(tmp_path / "r.mcap", notes[:1])
    whole = path.read_bytes()
    with RecordingWriter(tmp_path / "truncated.mcap", {}) as writer:
        writer.add_message(KEY, notes[0], notes[0].t_ns)
        writer.flush()
        truncated = (tmp_path / "truncated.mcap.active").read_bytes()
    path.write_bytes(truncated)
    assert len(truncated) < len(whole)
    done = fantwin("wear", path, "--json")
    assert done.exit_code == 3
    assert json.loads(done.stdout)["wear"]
    assert "it is truncated" in done.stderr


class SnapshotSender(Core):
    """Sends the snapshots it was given."""

    def __init__(self, notes: Sequence[ScorerSnapshot]) -> None:
        self._notes = list(notes)

    def step(self, item: object) -> Sequence[Message]:
        return []

    def tick(self, now_ns: int) -> Sequence[Message]:
        notes, self._notes = self._notes, []
        return notes


@pytest.fixture
def site(endpoint: str, request: pytest.FixtureRequest, notes: list[ScorerSnapshot]) -> Iterator[tuple[object, ...]]:
    """A scorer in a thread; the words that lead to its bus."""
    core = SnapshotSender(notes if request.param else [])
    stage = Stage(
        name="scorer",
        about="",
        reads=("prediction", "request"),
        writes=("snapshot",),
        config=ScorerConfig,
        build=lambda _context: BuiltStage(core),
    )
    stop = threading.Event()
    words = ("-c", DEMO / "demo.toml", "--set", f"bus.endpoint='{endpoint}'")
    runner = Runner(stage, load_config(DEMO / "demo.toml", [f"bus.endpoint='{endpoint}'"]), None, stop)
    thread = threading.Thread(target=runner.run)
    thread.start()
    yield words
    stop.set()
    thread.join(20)


@pytest.mark.parametrize("site", [True], indirect=True)
def test_a_running_site_reports_the_same(site, tmp_path, notes):
    assert rows(*site) == rows(recording(tmp_path / "r.mcap", notes))


@pytest.mark.parametrize("site", [False], indirect=True)
def test_a_scorer_that_has_noted_nothing_yet_is_one_line(site):
    assert error_of("wear", *site) == "no scorer has recorded wear so far: it does so regularly; try again later"


def test_without_a_scorer_one_line_says_that_nothing_is_known(endpoint, monkeypatch):
    monkeypatch.setattr("pipeline.cli.watch.live_stages._DISCOVERY_S", 0.3)
    error = error_of("wear", "-c", DEMO / "demo.toml", "--set", f"bus.endpoint='{endpoint}'")
    assert f"wear unknown: no scorer of site '{SITE}' answers at {endpoint}" in error

"""Scorer, killed and started again: it continues from its snapshot, and never from a wrong one."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.site.alarm_book import AlarmBook
from fantwin.pipeline.tray_scoring.scorer_config import ScorerConfig
from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.pipeline.tray_scoring.snapshot_store import SnapshotStore
from fantwin.schemas.blocks import cut
from fantwin.schemas.enums import Action, FanState, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Overview, Score, ScorerSnapshot
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import is_listed, is_retained, is_silenced
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from fantwin.scoring.wear.wear_monitor import WearMonitor
from tests.support.scored_blocks import (
    EPOCH_NS,
    core_of,
    feed,
    learned,
    prediction_of,
    request_of,
    snapshot_of,
    twin_of,
    with_step,
)

HOUR = 360_000  # samples


STEP = -30.0
IN_ALARM = (FanState.ALARM, FanState.RETURNING)


def test_after_a_kill_the_samples_that_producers_still_keep_are_scored(tmp_path: Path) -> None:
    residual = with_step(6.0, 3.8, fans=3, size=2.0 * STEP)
    residual[500:, 1] += 2.0 * STEP
    whole = prediction_of(residual)
    blocks = [cut(whole, k, k + 10) for k in range(0, 600, 10)]
    unbroken, alarms = feed(core_of(3), blocks)
    killed = core_of(3, snapshot_store=SnapshotStore(tmp_path / "m"))
    feed(killed, blocks[:45])
    kept = SnapshotStore(tmp_path / "m").load()
    assert kept
    assert kept.t_ns < blocks[44].t_ns[-1], "it was not closed: the last alarm was the last note"
    successor = core_of(3)
    successor.restore(kept)
    scores, again = feed(successor, blocks[10:])
    for name in ("expected_residual_rad_s", "band_variance", "valid"):
        expected, found = (
            np.concatenate([getattr(each, name)[each.t_ns > kept.t_ns] for each in of]) for of in (unbroken, scores)
        )
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9, err_msg=name)
    later = [(each.t_ns, each.fan, each.transition) for each in alarms if each.t_ns > blocks[44].t_ns[-1]]
    assert [(each.t_ns, each.fan, each.transition) for each in again] == later != []


def test_every_alarm_and_answer_is_in_the_file_and_in_a_published_snapshot_before_it_is_emitted(tmp_path: Path) -> None:
    scorer = learned(seconds=5.0, snapshot_store=SnapshotStore(tmp_path / "m"))
    assert len(snapshot_of(scorer).state_json) < 8_300

    def noted() -> dict[str, Any]:
        memory = SnapshotStore(tmp_path / "m").load()
        assert memory and len(memory.state_json) < 60_000
        return json.loads(memory.state_json)["alarms"]["last_emitted"]["0"]

    made = scorer.step(prediction_of(np.full(100, STEP)))
    assert [type(message) for message in made] == [Score, Overview, ScorerSnapshot, Alarm]
    assert noted()["active"]
    feed(scorer, [request_of(Action.SHELVE, duration_s=60.0)])
    assert noted()["shelved_until_t_ns"] > 0


@pytest.mark.parametrize(("fans", "rest_s"), [(64, 0.0), (80, 0.4)])
def test_in_a_storm_of_alarms_a_large_tray_takes_its_snapshots_one_after_a_rest(fans: int, rest_s: float) -> None:
    scorer = learned(fans, seconds=3.0)
    taken_s: list[float] = []
    with_alarms = 0
    for block in range(14):
        residual = np.zeros((10, fans))
        residual[:, : 1 + min(block, 9)] = 3.0 * STEP  # one more fan in each block, up to one second
        made = scorer.step(prediction_of(residual, first=10 * block))
        with_alarms += any(isinstance(message, Alarm) for message in made)
        taken_s += [(each.t_ns - EPOCH_NS) / 1e9 for each in made if isinstance(each, ScorerSnapshot)]
    last = json.loads(snapshot_of(scorer).state_json)["alarms"]["last_emitted"]
    assert len(last) == 10 and with_alarms > 8
    assert len(taken_s) == with_alarms if not rest_s else np.diff(taken_s).min() >= rest_s - 1e-9
    assert taken_s[-1] > 1.0, "what is owed is taken after the rest, without another alarm"


@pytest.mark.parametrize(("period_ns", "apart_s"), [(10_000_000, 6), (1_000_000_000, 30)])
def test_without_events_there_is_a_snapshot_after_a_time_and_at_slow_rates_after_a_number_of_samples(
    period_ns: int, apart_s: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fantwin.pipeline.tray_scoring.scorer_core.SNAPSHOT_PERIOD_NS", 6 * NS_PER_S)
    monkeypatch.setattr("fantwin.pipeline.tray_scoring.scorer_core.SNAPSHOT_PERIOD_SAMPLES", 30)
    scorer, taken_ns, samples = core_of(), list[int](), NS_PER_S // period_ns
    for second in range(3 * apart_s):
        made = scorer.step(prediction_of(np.full(samples, 0.1), first=second * samples, period_ns=period_ns))
        taken_ns += [each.t_ns for each in made if isinstance(each, ScorerSnapshot)]
    assert np.diff(taken_ns).tolist() == [apart_s * NS_PER_S] * 2


def test_while_nothing_happens_a_large_tray_publishes_every_third_snapshot_and_saves_all(tmp_path: Path) -> None:
    store = SnapshotStore(tmp_path / "m")
    scorer = core_of(80, snapshot_store=store)
    published_s, saved_s = list[float](), set[float]()
    for second in range(0, 600, 5):
        made = scorer.step(replace(prediction_of(np.full((1, 80), 0.1)), t_ns=np.array([EPOCH_NS + second * NS_PER_S])))
        published_s += [(each.t_ns - EPOCH_NS) / NS_PER_S for each in made if isinstance(each, ScorerSnapshot)]
        saved = store.load()
        assert saved is not None
        saved_s.add((saved.t_ns - EPOCH_NS) / NS_PER_S)
    assert sorted(saved_s) == list(range(0, 600, 60))
    assert published_s == [0.0, 180.0, 360.0, 540.0]


@cache
def raised() -> ScorerSnapshot:
    """The last state of a fan with an acknowledged alarm, one that is shelved without one, and one with nothing."""
    scorer = learned(3, seconds=10.0)
    residual = np.zeros((100, 3))
    residual[:, 0] = STEP
    feed(scorer, [prediction_of(residual)])
    feed(scorer, [request_of(Action.ACKNOWLEDGE, 0, sequence=0, comment="ordered")])
    feed(scorer, [request_of(Action.SHELVE, 1, sequence=1, duration_s=60.0)])
    return snapshot_of(scorer)


def test_a_restarted_scorer_republishes_at_once_and_only_once_its_state_and_who_acknowledged_alarms(
    tmp_path: Path,
) -> None:
    store = SnapshotStore(tmp_path / "m")
    store.save(raised())
    successor = core_of(3, snapshot_store=store)
    memory, first, second = successor.tick(0)
    assert isinstance(memory, ScorerSnapshot) and memory.restored
    assert isinstance(first, Alarm) and isinstance(second, Alarm)
    assert [(each.fan, each.transition) for each in (first, second)] == [
        (0, Transition.REPUBLISHED),
        (1, Transition.REPUBLISHED),
    ]
    assert (first.active, first.acknowledged, first.operator_name, first.comment) == (True, True, "Ann", "ordered")
    assert (second.active, second.shelved_until_t_ns > 0) == (False, True)
    assert successor.tick(0) == []
    (score,), alarms = feed(successor, [prediction_of(np.tile([STEP, 0.0, 0.0], (10, 1)), first=100)])
    assert alarms == [] and np.isin(score.state[:, 0], IN_ALARM).all()


def standing_of(emitted: Sequence[Any]) -> list[CurrentAlarm]:
    """How the alarms stand for who has followed them from `raised` on."""
    former = core_of(3).restore(raised())
    messages = [*(("former", each) for each in former), *(("successor", each) for each in emitted)]
    book = AlarmBook()
    for number, (producer, message) in enumerate(messages):
        if isinstance(message, Alarm):
            book.add(replace(message, header=Header(producer, number, "tray1")))
    return book.all()


@pytest.mark.parametrize("is_learned", [False, True])
def test_operator_settings_outlive_a_snapshot_of_another_twin_and_wear_one_of_a_learned_twin_and_health_says_so(
    is_learned: bool,
) -> None:
    before = core_of(3)
    before.restore(raised())
    before.tray.wear = WearMonitor(3, 600.0)
    for day in range(2):
        at_ns = EPOCH_NS + (day - 2) * 86_400 * NS_PER_S
        before.tray.wear.update(at_ns, np.ones(3, np.bool_), lambda: (np.full(3, -0.08), np.full(3, 0.007)))
    successor = core_of(3, sha256="another", is_learned=is_learned)
    memory, *emitted = successor.restore(snapshot_of(before))
    assert isinstance(memory, ScorerSnapshot) and memory.restored
    why = f"the snapshot is of {'the previous' if is_learned else 'another'} twin"
    assert successor.counters()["snapshots_of_another_twin"] == 1 and why in successor.problem()
    acknowledged, shelved = standing_of(emitted)
    assert (is_retained(acknowledged.newest), acknowledged.newest.message) == (False, "fan 0: no alarm")
    assert (is_silenced(shelved.newest), shelved.newest.message) == (True, "fan 1: no alarm, shelved")
    assert successor.step(request_of(Action.SHELVE, 1, sequence=1, duration_s=60.0)) == [], "it was answered"
    (score,), _ = feed(successor, [prediction_of(np.zeros((1, 3)), first=100)])
    assert (score.state == FanState.NORMAL).all() and not score.expected_residual_rad_s.any()
    wear = successor.tray.wear
    assert (wear.state == before.tray.wear.state) == is_learned
    assert not any(wear.has_shift), "what the model says of the fans from now on joins what was measured"
    _, (unshelved,) = feed(successor, [request_of(Action.UNSHELVE, 1, sequence=2)])
    assert unshelved.transition == Transition.UNSHELVED
    feed(successor, [prediction_of(np.zeros((1, 3)), first=6098)])
    assert why in successor.problem()
    feed(successor, [prediction_of(np.zeros((2, 3)), first=6099)])
    assert successor.problem() == ""


def restored(first: int, producer: str, *, is_replayed: bool) -> tuple[ScorerCore, list[Any]]:
    """A successor of `raised`, which began at sample -1000 and ended at 100, and its output for its first block."""
    successor = core_of(3, is_replayed=is_replayed)
    successor.restore(raised())
    return successor, list(successor.step(prediction_of(np.zeros((20, 3)), first=first, producer=producer)))


@pytest.mark.parametrize("is_replayed", [False, True], ids=["live", "replay"])
@pytest.mark.parametrize(
    ("first", "producer", "is_of_before"),
    [
        (-HOUR, "integrator-1", False),  # at a slow rate that may be of long ago
        (200, "integrator-2", False),
        (50, "integrator-2", True),
        (-1000, "integrator-2", True),  # of a live site, all that was kept; of a replay, the same recording once more
        (-HOUR, "integrator-2", True),  # of a live site, that at a slow rate; of a replay, another recording
    ],
)
def test_only_a_replay_of_earlier_samples_makes_a_snapshot_be_discarded(
    first: int, producer: str, is_of_before: bool, is_replayed: bool
) -> None:
    successor, messages = restored(first, producer, is_replayed=is_replayed)
    is_discarded = is_of_before and is_replayed
    assert successor.counters().get("snapshots_of_other_times", 0) == is_discarded
    scores = [message for message in messages if isinstance(message, Score)]
    if is_discarded:
        assert (scores[0].state == FanState.NORMAL).all()
    else:
        assert not scores or scores[0].t_ns[0] > prediction_of(np.zeros(1), first=99).t_ns[0]
    successor.step(prediction_of(np.zeros((20, 3)), first=-2 * HOUR, producer="integrator-3"))
    assert successor.counters().get("snapshots_of_other_times", 0) == is_discarded, "only the first one can tell"


@pytest.mark.parametrize("twin", ["twin", "another"])
def test_row_13_a_snapshot_that_is_ahead_of_a_clock_that_was_set_back_keeps_no_fan_from_being_judged(
    tmp_path: Path, twin: str
) -> None:
    store = SnapshotStore(tmp_path / "scorer.snapshot")
    store.save(raised())
    day = 24 * 3600 * 100
    made = prediction_of(np.zeros((20, 3)), first=-day, producer="integrator-new")
    successor = core_of(3, sha256=twin, snapshot_store=store, started_t_ns=int(made.t_ns[0]))
    assert [len(message.t_ns) for message in successor.step(made) if isinstance(message, Score)] == [20]
    assert not successor.counters().get("repeated")


@pytest.mark.parametrize("twin", ["twin", "another"])
def test_samples_that_come_again_to_the_core_of_the_next_twin_are_not_scored_again(twin: str) -> None:
    before = core_of(3)
    feed(before, [prediction_of(np.zeros((100, 3)))])
    (snapshot,) = (each for each in before.last_snapshot() if isinstance(each, ScorerSnapshot))
    successor = ScorerCore(
        3,
        "rad/s",
        ScorerConfig(),
        twin_of(3, sha256=twin),
        started_t_ns=EPOCH_NS - 10 * NS_PER_S,
        continues=snapshot,
        is_learned=True,
    )
    (score,), _ = feed(successor, [prediction_of(np.zeros((40, 3)), first=80, producer="integrator-2")])
    assert len(score.t_ns) == 20 and "set back" not in successor.problem()


def test_alarms_of_a_discarded_snapshot_are_no_longer_current() -> None:
    successor = core_of(3, is_replayed=True)
    republished = successor.restore(raised())
    assert [is_listed(each.newest) for each in standing_of(republished)] == [True, True]
    later = successor.step(prediction_of(np.zeros((20, 3)), first=-HOUR, producer="integrator-2"))
    emitted = [message for message in later if isinstance(message, Alarm)]
    assert [alarm.transition for alarm in emitted] == [Transition.REPUBLISHED] * 2
    assert [is_listed(each.newest) for each in standing_of([*republished, *later])] == [False, False]
    assert [is_listed(each.newest) for each in standing_of(later)] == [False, False], "nothing was republished"


# requests that come again


def test_a_request_that_was_answered_is_not_answered_again_after_a_restart_of_the_latest_producers() -> None:
    successor = core_of(3)
    successor.restore(raised())
    for sequence, action in enumerate((Action.ACKNOWLEDGE, Action.SHELVE)):
        assert successor.step(request_of(action, sequence, sequence=sequence, duration_s=60.0)) == []
    assert successor.counters()["requests_repeated"] == 2
    _, (answer,) = feed(successor, [request_of(Action.UNSHELVE, 1, sequence=2)])
    assert answer.transition == Transition.UNSHELVED
    for number in range(100):
        _, (other,) = feed(successor, [request_of(Action.SHELVE, 1, producer=f"visitor-{number}", duration_s=9.0)])
        assert other.transition == Transition.SHELVED
    known = json.loads(snapshot_of(successor).state_json)["alarms"]["answered"]
    assert list(known) == [f"visitor-{number}" for number in range(36, 100)]


def test_a_full_disk_is_reported_and_stops_nothing(tmp_path: Path) -> None:
    scorer = core_of(snapshot_store=SnapshotStore(tmp_path / "gone" / "m"))
    (tmp_path / "gone").write_text("a file where there was a folder")
    scores, _ = feed(scorer, [prediction_of(np.zeros(10))])
    assert len(scores) == 1
    assert "cannot save " in scorer.problem()

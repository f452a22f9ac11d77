"""One list of claims over every class that keeps a snapshot, from the alarms of a fan up to the scorer of a tray.

It is run on messages, cut anywhere, and a new one continues from the snapshot: its outputs and its state are those of a
run that was not cut. A snapshot that is damaged, or of another tray, is refused whole.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.schemas.blocks import cut
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.enums import Action, FanState, Transition
from fantwin.schemas.fields import columns
from fantwin.schemas.messages import Alarm, Prediction, Score, ScorerSnapshot
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.scoring.alarms.alarm_state import DATA_LOST_AFTER_NS
from fantwin.scoring.alarms.alarms_of_tray import AlarmsOfTray, Decided
from fantwin.scoring.as_commanded.against_command import AgainstCommand
from fantwin.scoring.saved import as_json, from_json
from tests.support.scored_blocks import core_of, prediction_of, request_of

FANS, BLOCK = 3, 20
EVERY_NS = DATA_LOST_AFTER_NS // 2


OF_EVENTS = ("RAISED", "ACKNOWLEDGED", "MARKED_FALSE", "SHELVED", "OUT_OF_SERVICE", "COMMISSIONING")


def in_blocks(whole: Prediction, size: int = BLOCK) -> list[Prediction]:
    ends = [*range(0, len(whole.t_ns), size), len(whole.t_ns)]
    return [cut(whole, *each) for each in pairwise(ends)]


def eventful() -> list[Any]:
    """Faults of some tenths of a second, another for each fan, a gap, and what operators ask meanwhile."""
    rng, k = np.random.default_rng(1), np.arange(900)[:, np.newaxis]
    residual = rng.normal(0, 1, (900, FANS)) + np.where(k % 300 > 240, [-90.0, 0.0, 0.0], 0.0)
    extra = rng.normal(0, 0.1, (900, FANS)) + np.where(k % 200 > 150, [0.0, 8.0, 0.0], 0.0)
    valid = np.ones((900, FANS), np.bool_)
    valid[480:520, 2] = False
    items: list[Any] = in_blocks(prediction_of(residual, valid, balance=extra))
    asked: list[tuple[int, Action, int, dict[str, Any]]] = [
        (14, Action.ACKNOWLEDGE, -1, {"comment": "ordered"}),
        (18, Action.FALSE_ALARM, 0, {"comment": "a door was open"}),
        (20, Action.SHELVE, 1, {"duration_s": 1.0}),
        (24, Action.OUT_OF_SERVICE, 2, {}),
        (30, Action.COMMISSION, 2, {}),
    ]
    for number, (place, action, fan, more) in enumerate(asked):
        items.insert(place + number, request_of(action, fan, sequence=number, **more))
    return items


def days() -> list[Any]:
    """Ten seconds of each hour, at another speed of the fans; the friction of the last one grows."""
    blocks = []
    for hour in range(4):
        rng = np.random.default_rng(hour)
        noise = rng.normal(0.0, 0.3, (500, FANS))
        made = prediction_of(noise, balance=0.01 * hour * np.eye(FANS)[-1] + noise / 50.0, period_ns=20_000_000)
        blocks.append(replace(made, t_ns=made.t_ns + hour * 3600 * 10**9))
    return blocks


def decisions() -> list[Any]:
    """What is decided of fans at some times: alarms that come and go, and times at which nothing is known."""
    rng = np.random.default_rng(4)
    active, judged = rng.random((2, 200, FANS)) > 0.3
    return [
        Decided(number * EVERY_NS, one, two, np.where(two, 1 + number % 2, 0), np.full(FANS, number), EVERY_NS)
        for number, (one, two) in enumerate(zip(judged, active, strict=True))
    ]


def stops() -> list[Any]:
    """Fans that are stopped and started, one of which stands still and one of which runs on."""
    k = np.arange(1200)[:, np.newaxis]
    command = np.broadcast_to(np.where(k % 400 < 250, 60.0, 0.0), (1200, FANS))
    speed = np.broadcast_to(np.where(k % 400 < 250, 300.0, 0.0), (1200, FANS)).copy()
    speed[100:400, 0], speed[200:900, 1] = 0.0, 300.0
    made = prediction_of(speed - 300.0, period_ns=50_000_000)
    return in_blocks(replace(made, command=command))


OF_SMALL_EVIDENCE = ("score", "statistic", "state")
"""columns that tell of evidence below half of an alarm, which no snapshot keeps"""


def scored(core: ScorerCore, item: Any) -> list[Any]:
    """Scores, rounded, and alarms but for what is said of their causes."""
    made: list[Any] = []
    for message in core.step(item):
        if isinstance(message, Score):
            names = [n for n, column in columns(Score).items() if not column.optional and n not in OF_SMALL_EVIDENCE]
            made += [repr(np.round(np.asarray(getattr(message, name), float), 6).tolist()) for name in names]
            made.append((message.state >= FanState.ALARM).tolist())
        elif isinstance(message, Alarm) and message.transition != Transition.DIAGNOSED:
            made.append(repr((message.fan, message.transition, message.t_ns, message.request, message.stale)))
    return made


def state_of(core: ScorerCore) -> Any:
    (snapshot,) = core.last_snapshot()
    state = json.loads(snapshot.state_json)
    return [state["alarms"]["conditions"], state["alarms"].get("answered")]


@dataclass(frozen=True)
class Kind:
    """new: for a number of fans. items: what one is given. take: its outputs for an item. save: its state, as it is in
    a snapshot. restored: one that continues from that. state: to be compared."""

    new: Callable[[int], Any]
    items: Callable[[], list[Any]]
    take: Callable[[Any, Any], Any]
    save: Callable[[Any], Any]
    restored: Callable[[Any], Any]
    state: Callable[[Any], Any]


def scorer(items: Callable[[], list[Any]], **settings: Any) -> Kind:
    def save(core: ScorerCore) -> ScorerSnapshot:
        (snapshot,) = core.last_snapshot()
        return decode(ScorerSnapshot, encode(snapshot))

    def restored(snapshot: ScorerSnapshot) -> ScorerCore:
        core = core_of(FANS, **settings)
        assert core.restore(snapshot)
        return core

    return Kind(lambda fans: core_of(fans, **settings), items, scored, save, restored, state_of)


SCORERS = {"scorer": scorer(eventful), "scorer over days": scorer(days)}
CONDITIONS = TypeAdapter(AlarmsOfTray)
STANDSTILL = Standstill(turning_command=20.0, standing_below_rad_s=50.0, off_command=0.0, start_s=1.0, coast_s=4.0)


def against_command(fans: int = FANS) -> AgainstCommand:
    return AgainstCommand(STANDSTILL, [Tacho()] * fans)


def judged(one: AgainstCommand, item: Prediction) -> Any:
    one.take(item)
    return one.active.tolist(), one.score.tolist(), one.kind.tolist()


def against_restored(saved: Any) -> AgainstCommand:
    one = against_command()
    one.restore(from_json(json.loads(saved)))
    return one


PARTS = {
    "alarm conditions": Kind(
        AlarmsOfTray.begin,
        decisions,
        lambda one, item: repr(one.update(item)),
        CONDITIONS.dump_json,
        CONDITIONS.validate_json,
        CONDITIONS.dump_json,
    ),
    "fans against their command": Kind(
        against_command,
        stops,
        judged,
        lambda one: json.dumps(as_json(one.arrays())),
        against_restored,
        lambda one: as_json(one.arrays()),
    ),
}
KINDS = SCORERS | PARTS


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Samples that are no numbers are part of the runs."""
    with np.errstate(all="ignore"):
        yield


def played(kind: Kind, items: Sequence[Any], cuts: Container[int] = ()) -> tuple[list[Any], Any]:
    """The outputs, and the last state. Before each item in `cuts` a new one continues."""
    one, outputs = kind.new(FANS), []
    for number, item in enumerate(items):
        if number in cuts:
            one = kind.restored(kind.save(one))
        outputs.append(kind.take(one, item))
    return outputs, kind.state(one)


@pytest.mark.parametrize("name", KINDS)
def test_one_that_is_cut_anywhere_goes_on_as_if_it_had_not_been(name: str) -> None:
    kind = KINDS[name]
    items = kind.items()
    whole, state = played(kind, items)
    assert len({repr(each) for each in whole}) > len(items) / 4, "something happens"
    assert name != "scorer" or [each for each in OF_EVENTS if f"<Transition.{each}:" not in repr(whole)] == []
    # no snapshot keeps evidence below half of an alarm: one that is cut while it grows may be some bins late
    cuts = {len(items) // 2} if name in SCORERS else range(1, len(items))
    assert played(kind, items, cuts) == (whole, state), cuts


def damaged(state: dict[str, Any]) -> Iterator[Any]:
    """A state without one of its parts, or with something else in its place."""
    yield from ({}, [], None, 7)
    for key, value in state.items():
        yield {other: each for other, each in state.items() if other != key}
        yield state | {key: 7}
        if isinstance(value, list):
            yield state | {key: value[:-1]}


def damaged_arrays(kept: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Arrays without one of them, or one of another number of fans, or with a value that none has."""
    whole = from_json(kept)
    for name, array in whole.items():
        yield as_json({other: each for other, each in whole.items() if other != name})
        if FANS in array.shape:
            yield as_json(whole | {name: np.take(array, [0, 1], axis=array.shape.index(FANS))})
    wrong = {"_kind": 99, "_decision.alarms.fans": 99, "_decision.model.mean": np.nan, "_period_ns": -1}
    for name, value in wrong.items():
        yield as_json(whole | {name: np.full_like(whole[name], value)})


def not_understood(state: dict[str, Any]) -> Iterator[str]:
    """Texts of which a scorer can read no state, or none of such fans."""
    whole, alarms, wear = json.dumps(state), state["alarms"], state["wear"]
    yield from ("", "[]", "{}", '{"arrays": 1}', "[" * 100_000, whole[:-20])
    yield from map(json.dumps, damaged(state))
    yield from (json.dumps(state | {"alarms": each}) for each in (7, alarms | {"stood": [False]}))
    yield from (json.dumps(state | {"alarms": alarms | {"conditions": each}}) for each in damaged(alarms["conditions"]))
    yield from (json.dumps(state | {"wear": each}) for each in damaged(wear))
    yield from (json.dumps(state | {"arrays": each}) for each in damaged_arrays(state["arrays"]))
    last = next(iter(alarms["last_emitted"].values()))
    for name, entry in {"last_emitted": last, "due_t_ns": [1]}.items():
        yield json.dumps(state | {"alarms": alarms | {name: alarms[name] | {"99": entry}}})
    for name in ("severity", "transition", "feedback", "statistic"):
        unknown = alarms["last_emitted"] | {str(last["fan"]): last | {name: 99}}
        yield json.dumps(state | {"alarms": alarms | {"last_emitted": unknown}})
    conditions = alarms["conditions"]["conditions"]
    for one in ({"severity": 99}, {"shelved_until_t_ns": 1 << 63}):
        first = {"alarm_state": conditions[0].get("alarm_state", {}) | one}
        yield json.dumps(
            state | {"alarms": alarms | {"conditions": alarms["conditions"] | {"conditions": [first, *conditions[1:]]}}}
        )


def of_fans(item: Prediction, fans: int) -> Prediction:
    """The same of the first fans only."""
    names = [name for name, column in columns(Prediction).items() if "fans" in column.shape]
    return replace(item, fans=fans, **{name: getattr(item, name)[..., :fans] for name in names})


@pytest.mark.parametrize("fans", [FANS, FANS - 1])
def test_a_scorer_that_cannot_read_its_snapshot_says_so_and_starts_as_a_new_one(fans: int) -> None:
    kind = SCORERS["scorer"]
    items = kind.items()
    before, new = kind.new(FANS), kind.new(fans)
    for item in items[:30]:
        kind.take(before, item)
    snapshot = kind.save(before)
    again = [of_fans(item, fans) for item in items[:1]]
    expected = [kind.take(new, item) for item in again]
    texts = not_understood(json.loads(snapshot.state_json)) if fans == FANS else [snapshot.state_json]
    for text in texts:
        successor = kind.new(fans)
        assert successor.restore(replace(snapshot, state_json=text)) == []
        assert successor.counters()["snapshots_not_understood"] == 1, text[:200]
        assert "the snapshot cannot be read" in successor.problem() and "\n" not in successor.problem()
        assert [kind.take(successor, item) for item in again] == expected

"""One list of claims over every class that keeps a snapshot, from the alarms of a fan up to the scorer of a tray.

It is run on messages, cut anywhere, and a new one continues from the snapshot: its outputs and its state are those of a
run that was not cut. A snapshot that is damaged, or of another tray, is refused whole.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from fantwin.pipeline.replay.offline import comparison
from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.schemas.blocks import cut
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.enums import Action, InvalidReason
from fantwin.schemas.fields import columns
from fantwin.schemas.messages import Alarm, Prediction, Score, ScorerSnapshot
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import DATA_LOST_AFTER_NS
from fantwin.scoring.alarms.alarms_of_tray import AlarmsOfTray, Decided
from fantwin.scoring.as_commanded.against_command import AgainstCommand
from fantwin.scoring.model import decision
from fantwin.scoring.saved import as_json, from_json
from tests.support.scored_blocks import EPOCH_NS, core_of, prediction_of, request_of

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
    valid[480:520, 2] = valid[580:600, 0] = False
    items: list[Any] = in_blocks(prediction_of(residual, valid, balance=extra))
    asked: list[tuple[int, Action, int, dict[str, Any]]] = [
        (14, Action.ACKNOWLEDGE, -1, {"comment": "ordered"}),
        (18, Action.FALSE_ALARM, 0, {"comment": "a door was open"}),
        (20, Action.SHELVE, 1, {"duration_s": 1.0}),
        (24, Action.OUT_OF_SERVICE, 2, {}),
        (29, Action.COMMISSION, 0, {}),
    ]
    for number, (place, action, fan, more) in enumerate(asked):
        items.insert(place + number, request_of(action, fan, sequence=number, **more))
    return items


HAPPENINGS = (
    *("nothing", "faults", "no faults", "another speed", "off", "unsteady", "stands still", "wrong readings"),
    *("repeats", "missing readings", "no reading", "no sample", "no free run", "unknown conditions"),
    *("gap", "hour", "rate", "request", "request"),
)
REASONS = {
    "missing readings": InvalidReason.NO_SPEED,
    "no reading": InvalidReason.NO_SPEED,
    "no sample": InvalidReason.GAP,
    "no free run": InvalidReason.WARMING_UP,
    "unknown conditions": InvalidReason.CONDITIONS_UNKNOWN,
}


def disturbed(seed: int) -> list[Any]:
    """Some seconds in which something else happens to some of the fans, then others, and what operators ask."""
    rng, items = np.random.default_rng(seed), list[Any]()
    t_ns, period_ns, speed, share = EPOCH_NS, 100_000_000, 300.0, np.zeros(FANS)
    for number in range(36):
        happens = rng.choice(HAPPENINGS) if number > 3 else "nothing"
        fans, size = rng.random(FANS) < 0.5, int(rng.integers(5, 30))
        if happens == "request":
            action, seconds = Action(int(rng.integers(1, 9))), float(rng.choice([0.0, 5.0, 60.0]))
            fan = int(rng.integers(-1, FANS))
            items.append(request_of(action, fan, sequence=number, duration_s=seconds, comment=f"note {number}"))
            continue
        t_ns += {"gap": int(rng.integers(2, 900)) * period_ns, "hour": 3600 * NS_PER_S}.get(happens, 0)
        period_ns = int(rng.choice([50_000_000, 100_000_000])) if happens == "rate" else period_ns
        speed = rng.uniform(100.0, 390.0) if happens == "another speed" else speed
        share = {"faults": fans * rng.uniform(-0.3, 0.05, FANS), "no faults": np.zeros(FANS)}.get(happens, share)
        noise = rng.normal(0.0, 1.0, (2, size, FANS)) * np.where(fans & (happens == "unsteady"), 9.0, 1.0)
        some = fans & (rng.random((size, FANS)) < {"missing readings": 0.4, "wrong readings": 0.1}.get(happens, 1.0))
        reading = speed * (1.0 + share) + 4.0 * noise[0]
        reading[some & (happens in ("off", "stands still"))] = 0.0
        reading[some & (happens == "wrong readings")] *= 2.0
        is_unknown = some & (happens in REASONS)
        is_missing = is_unknown & (happens != "no free run")
        reason = np.where(is_unknown, REASONS.get(happens, InvalidReason.NONE), np.uint8(0))
        made = prediction_of(reading - 300.0, ~is_unknown, balance=noise[1] / 2.0 - 40.0 * share, period_ns=period_ns)
        whole = replace(
            made,
            t_ns=(t_ns // period_ns + np.arange(size)) * period_ns,
            command=np.where(some & (happens == "off"), 0.0, made.command),
            measured_speed_rad_s=np.where(is_missing, np.nan, reading),
            predicted_speed_rad_s=np.where(is_unknown & (happens != "missing readings"), np.nan, speed),
            invalid_reason=reason.astype(np.uint8),
            reading_missing=is_missing,
            reading_repeated=some & (happens == "repeats"),
            supply_voltage_v=np.full((size, FANS), 12.0, np.float32),
        )
        t_ns = int(whole.t_ns[-1]) + period_ns
        items += in_blocks(whole, int(rng.integers(3, BLOCK)))
    return items


def stuck() -> list[Any]:
    """Fans whose tachos show one reading while they slow down, and another while they are stopped."""
    second = np.arange(1200)[:, np.newaxis] // 10
    noise = np.random.default_rng(1).normal(0.0, 2.0, (120, FANS))[second[:, 0]]
    is_off = np.broadcast_to(second >= 70, noise.shape)
    residual = np.where(second < 40, noise, 0.0) - np.where(is_off, 150.0, 0.0)
    made = prediction_of(residual, ~is_off, period_ns=100_000_000)
    return in_blocks(
        replace(
            made,
            command=np.where(is_off, 0.0, made.command),
            measured_speed_rad_s=300.0 + residual,
            predicted_speed_rad_s=np.where(second < 40, 300.0, np.full(noise.shape, 200.0)),
            invalid_reason=np.where(is_off, np.uint8(InvalidReason.STOPPED), np.uint8(0)),
        )
    )


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


def scored(core: ScorerCore, item: Any) -> list[dict[str, Any]]:
    """Scores and alarms, with all that they say."""
    made = [asdict(each) for each in core.step(item) if isinstance(each, Score | Alarm)]
    return [each | {"header": None} for each in made]


def state_of(core: ScorerCore) -> Any:
    (snapshot,) = (each for each in core.last_snapshot() if isinstance(each, ScorerSnapshot))
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
        *_, snapshot = core.last_snapshot()
        return decode(ScorerSnapshot, encode(snapshot))

    def restored(snapshot: ScorerSnapshot) -> ScorerCore:
        core = core_of(FANS, **settings)
        assert core.restore(snapshot)
        return core

    return Kind(lambda fans: core_of(fans, **settings), items, scored, save, restored, state_of)


CONDITIONS = TypeAdapter(AlarmsOfTray)
STANDSTILL = Standstill(turning_command=20.0, standing_below_rad_s=50.0, off_command=0.0, start_s=1.0, coast_s=4.0)
COUNTS = Tacho(kind="count", window_s=1.0)
SCORERS = {
    "scorer": scorer(eventful),
    "scorer of stuck tachos": scorer(stuck, tachos=(COUNTS,)),
    "scorer of disturbed fans with different tachos": scorer(
        partial(disturbed, 2),
        tachos=(Tacho(), COUNTS, Tacho(kind="average", window_s=0.3)),
        standstill=STANDSTILL,
    ),
}


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


def apart(one: Any, other: Any) -> list[str]:
    """The places in which two nested values differ by more than rounding."""
    return list(comparison.differences(one, other, lambda _: None))


@pytest.fixture
def all_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Snapshots keep the evidence of all fans, not only where it is large, and numbers may differ by rounding."""
    monkeypatch.setattr(decision, "KEPT_FROM", -np.inf)
    for name in ("RELATIVE", "SPEED_RAD_S", "OTHERS"):
        monkeypatch.setattr(comparison, name, 1e-4)


@pytest.mark.usefixtures("all_evidence")
@pytest.mark.parametrize("name", KINDS)
def test_one_that_is_cut_anywhere_goes_on_as_if_it_had_not_been(name: str) -> None:
    kind = KINDS[name]
    items = kind.items()
    whole = played(kind, items)
    assert len({repr(each) for each in whole[0]}) > len(items) / 4, "something happens"
    assert name != "scorer" or [each for each in OF_EVENTS if f"<Transition.{each}:" not in repr(whole)] == []
    cut_anywhere = played(kind, items, range(1, len(items)))
    assert apart(whole, cut_anywhere) == []


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
        assert apart([kind.take(successor, item) for item in again], expected) == []

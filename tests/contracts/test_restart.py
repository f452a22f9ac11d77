"""One list of claims over every class that keeps a snapshot, from a filter of a speed up to the scorer of a tray.

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

from pipeline.runtime.healthy_twin import ScorerConfig, limits_in_force
from schemas.blocks import cut
from schemas.codec import decode, encode
from schemas.enums import Action, Transition
from schemas.fields import columns
from schemas.messages import Alarm, Prediction, Score, ScorerSnapshot
from scoring.alarms.fan_condition import ConditionSettings
from scoring.alarms.tray_conditions import TrayConditions
from scoring.detectors.motion import HealthyMotion
from scoring.fan_scorer import FanScorer
from scoring.samples import samples_of
from stages.scorer import RESTORE_ERRORS, ScorerCore
from tests.stages.test_scorer import eventful_prediction
from tests.support.score_alone import by_score, scores_alone
from tests.support.scored_blocks import CALIBRATION, LIVELY, STEP_NS, core_of, prediction_of, request_of

FANS, BLOCK = 3, 20
SMOOTHED_ONLY = LIVELY | {
    "speed": {"baseline": {"commissioning_limit_sigmas": 0.0}},
    "balance": {"baseline": {"commissioning_limit_sigmas": 0.0}},
    "detectors": {f"{source}_smoothed": {"limit": 4.0} for source in ("speed", "balance")}
    | {"sensor": CALIBRATION["detectors"]["sensor"]},
}
SHORT = {"baseline_s": 0.1, "on_delay_s": 0.03, "off_delay_s": 0.05}


def in_blocks(whole: Prediction, size: int = BLOCK) -> list[Prediction]:
    ends = [*range(0, len(whole.t_ns), size), len(whole.t_ns)]
    return [cut(whole, *each) for each in pairwise(ends)]


def eventful() -> list[Any]:
    """Faults of some tenths of a second, another for each fan, a gap, and what operators ask meanwhile."""
    rng, k = np.random.default_rng(1), np.arange(900)[:, np.newaxis]
    residual = rng.normal(0, 1, (900, FANS)) + np.where(k % 300 > 240, [40.0, 0.0, 0.0], 0.0)
    extra = rng.normal(0, 0.1, (900, FANS)) + np.where(k % 200 > 150, [0.0, 8.0, 0.0], 0.0)
    valid = np.ones((900, FANS), np.bool_)
    valid[480:520, 2] = False
    items: list[Any] = in_blocks(prediction_of(residual, valid, balance=extra))
    asked: list[tuple[int, Action, int, dict[str, Any]]] = [
        (14, Action.ACKNOWLEDGE, -1, {"comment": "ordered"}),
        (18, Action.FALSE_ALARM, 0, {"comment": "a door was open"}),
        (20, Action.SHELVE, 1, {"duration_s": 1.0}),
        (24, Action.SUPPRESS, 2, {}),
        (30, Action.COMMISSION, 2, {}),
    ]
    for number, (place, action, fan, more) in enumerate(asked):
        items.insert(place + number, request_of(action, fan, sequence=number, **more))
    return items


def restless() -> list[Any]:
    return in_blocks(eventful_prediction(3, 400, 0.1))


def days() -> list[Any]:
    """15 s of each hour, at another speed of the fans; the friction of the last one grows."""
    blocks = []
    for hour in range(12):
        rng = np.random.default_rng(hour)
        noise = rng.normal(0.0, 0.3, (750, FANS))
        made = prediction_of(noise, balance=0.01 * hour * np.eye(FANS)[-1] + noise / 50.0, period_ns=20_000_000)
        blocks.append(replace(made, t_ns=made.t_ns + hour * 3600 * 10**9))
    return blocks


def ratios() -> list[Any]:
    """Ratios to the limit that raise, hold and return, and samples that are not valid."""
    made = np.random.default_rng(4).choice([0.1, 0.8, 1.2, 1.6, np.nan], (400, FANS)).repeat(4, axis=0)
    return [(first, made[first : first + BLOCK]) for first in range(0, len(made), BLOCK)]


def movements() -> list[Any]:
    rng = np.random.default_rng(3)
    command, predicted, speed = (rng.uniform(0.1, 1.0, (400, FANS)) * size for size in (1.0, 200.0, 200.0))
    predicted[rng.random(predicted.shape) < 0.05] = np.nan
    return [tuple(each[first : first + 7] for each in (command, predicted, speed)) for first in range(0, 400, 7)]


def judged(conditions: TrayConditions, item: tuple[int, Any]) -> Any:
    first, score = item
    result = conditions.update(*scores_alone((first + np.arange(len(score))) * STEP_NS, STEP_NS, score))
    return result.state.tolist(), repr(result.events), result.too_short


def scored(core: ScorerCore, item: Any) -> list[Any]:
    """Scores to the bit, and alarms but for what the last seconds say of their causes: a snapshot has no samples."""
    made: list[Any] = []
    for message in core.step(item):
        if isinstance(message, Score):
            names = [name for name, column in columns(Score).items() if not column.optional]
            made.append([(name, getattr(message, name).tobytes()) for name in names])
        elif isinstance(message, Alarm) and message.transition != Transition.DIAGNOSED:
            of_last_cause = ("residual_rad_s", "score", "torque_balance_command") if message.request else ()
            made.append(repr(replace(message, causes=(), message="", **dict.fromkeys(of_last_cause, 0.0))))
    return made


def state_of(core: ScorerCore) -> Any:
    (snapshot,) = core.last_snapshot()
    state = json.loads(snapshot.state_json)
    return [state["scorer"], state["alarms"]["conditions"], state["alarms"]["answered"], state["wear"]]


@dataclass(frozen=True)
class Kind:
    """new: for a number of fans. items: what one is given. take: its outputs for an item. state: to be compared."""

    new: Callable[[int], Any]
    items: Callable[[], list[Any]]
    take: Callable[[Any, Any], Any]
    save: Callable[[Any], Any] = lambda one: json.loads(json.dumps(one.snapshot(), allow_nan=False))
    state: Callable[[Any], Any] = lambda one: one.snapshot()


def scorer(items: Callable[[], list[Any]], **settings: Any) -> Kind:
    def save(core: ScorerCore) -> ScorerSnapshot:
        (snapshot,) = core.last_snapshot()
        return decode(ScorerSnapshot, encode(snapshot))

    return Kind(lambda fans: core_of(fans, **settings), items, scored, save, state_of)


SCORERS = {
    "scorer": scorer(eventful, calibration=SMOOTHED_ONLY, **SHORT),
    "scorer of all detectors": scorer(restless, calibration=LIVELY, not_judged_s=0.1, **SHORT),
    "scorer without a calibration": scorer(restless, **SHORT),
    "scorer over days": scorer(days, calibration=CALIBRATION, off_delay_s=1.0),
}
CONDITIONS = ConditionSettings(5 * STEP_NS, by_score(10 * STEP_NS), confirming=True)
PARTS = {
    "statistics": Kind(
        lambda fans: FanScorer(fans, limits_in_force(ScorerConfig.model_validate(SHORT), LIVELY)),
        restless,
        lambda one, item: [(name, each.tobytes()) for name, each in vars(one.update(samples_of(item))).items()],
    ),
    "alarm conditions": Kind(lambda fans: TrayConditions(fans, CONDITIONS), ratios, judged),
    "motion of healthy fans": Kind(
        HealthyMotion, movements, lambda one, item: one.update(*item, STEP_NS / 1e9).tobytes()
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
            successor = kind.new(FANS)
            successor.restore(kind.save(one))
            one = successor
        outputs.append(kind.take(one, item))
    return outputs, kind.state(one)


@pytest.mark.parametrize("name", KINDS)
def test_one_that_is_cut_anywhere_goes_on_as_if_it_had_not_been(name: str) -> None:
    kind = KINDS[name]
    items = kind.items()
    whole, state = played(kind, items)
    assert len({repr(each) for each in whole}) > len(items) / 2, "something happens"
    for cuts in (range(1, len(items)), {len(items) // 3}, {len(items) // 2}):
        assert played(kind, items, cuts) == (whole, state), cuts


def test_these_runs_raise_and_clear_alarms_answer_operators_and_measure_wear() -> None:
    """Else the claims would be of little."""
    emitted = repr(played(SCORERS["scorer"], eventful())[0])
    wanted = ("RAISED", "CLEARED", "ACKNOWLEDGED", "MARKED_FALSE", "SHELVED", "SUPPRESSED", "COMMISSIONING")
    assert [each for each in wanted if f"<Transition.{each}:" not in emitted] == []
    (*_, wear) = played(SCORERS["scorer over days"], days())[1]
    assert all(len(fan["parameters"]["friction"]["series"]["t_ns"]) > 3 for fan in wear["fans"])


def damaged(state: Any) -> Iterator[Any]:
    """A snapshot without one of its parts, or with something else in its place."""
    yield from ({}, [], None, "x")
    needed = {key: value for key, value in state.items() if key != "command_unit"}  # which is for people
    for key, value in needed.items():
        yield {other: each for other, each in state.items() if other != key}
        yield state | {key: "x"}
        if isinstance(value, list):
            yield state | {key: value[:-1]}


class Wear:
    """What a scorer knows of wear, as a part of its own."""

    def __init__(self, fans: int) -> None:
        self.core = core_of(fans, calibration=CALIBRATION, off_delay_s=1.0)
        self.snapshot, self.restore = self.core.tray.wear.snapshot, self.core.tray.wear.restore


REFUSING = PARTS | {"wear": Kind(Wear, days, lambda one, item: one.core.step(item))}


@pytest.mark.parametrize("name", REFUSING)
def test_a_part_refuses_a_damaged_or_foreign_snapshot_and_keeps_its_state(name: str) -> None:
    kind = REFUSING[name]
    items = kind.items()[:4]
    one, foreign = kind.new(FANS), kind.new(FANS + 1)
    for item in items:
        kind.take(one, item)
    before = json.dumps(kind.state(one))
    for state in (kind.save(foreign), *damaged(kind.save(one))):
        with pytest.raises(RESTORE_ERRORS):
            one.restore(state)
        assert json.dumps(kind.state(one)) == before, state


def not_understood(state: dict[str, Any]) -> Iterator[str]:
    """Texts of which a scorer can read no alarms."""
    whole, alarms = json.dumps(state), state["alarms"]
    yield from ("", "[]", "{}", '{"scorer": 1}', "[" * 100_000, whole[:-20])
    yield json.dumps({name: each for name, each in state.items() if name != "alarms"})
    yield json.dumps({name: each for name, each in state.items() if name != "input_producer"})
    for broken in damaged(alarms):
        yield json.dumps(state | {"alarms": broken})
    of_no_fan = {"last_emitted": next(iter(alarms["last_emitted"].values())), "due": [0], "onset_t_ns": 0}
    for name, value in of_no_fan.items():
        part = alarms if name == "last_emitted" else alarms["diagnoser"]
        part[name]["99"] = value
        yield json.dumps(state)
        del part[name]["99"]


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
    again = [of_fans(item, fans) for item in items[:8]]
    expected = [kind.take(new, item) for item in again]
    texts = not_understood(json.loads(snapshot.state_json)) if fans == FANS else [snapshot.state_json]
    for text in texts:
        successor = kind.new(fans)
        assert successor.restore(replace(snapshot, state_json=text)) == []
        assert successor.counters()["snapshots_not_understood"] == 1, text[:200]
        assert "the snapshot cannot be read" in successor.problem()
        assert [kind.take(successor, item) for item in again] == expected

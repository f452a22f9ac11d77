"""scoring.diagnosis.diagnoser: when a fan is diagnosed, on which samples, and that blocks make no difference."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.enums import Transition
from schemas.messages import Diagnosis
from scoring.diagnosis.diagnoser import Diagnoser
from scoring.diagnosis.shown_causes import FALLING, MIN_PROBABILITY
from tests.support.scored_blocks import (
    CALIBRATION,
    NEEDED,
    TWIN_SPEED,
    balance_of_a_fan,
    commissioned,
    core_of,
    feed,
    prediction_of,
)

S = 1_000_000_000
STEP_NS = 10_000_000
EPOCH_NS = 1_700_000_000 * S
Floats = NDArray[np.float64]


def times(samples: int, first: int = 0) -> NDArray[np.int64]:
    return EPOCH_NS + (first + np.arange(samples, dtype=np.int64)) * STEP_NS


def loaded(samples: int, from_s: float, torque: float = 20.0, seed: int = 1) -> tuple[Floats, Floats]:
    """Commands and speeds (n, 1) of a fan at a held speed that needs more command from some time on."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(samples) * STEP_NS / 1e9
    command = NEEDED + torque * (t_s >= from_s) + rng.normal(0, 0.1, samples)
    return command[:, np.newaxis], (TWIN_SPEED + rng.normal(0, 0.3, samples))[:, np.newaxis]


def fed(samples: int, block: int, from_s: float = 10.0, keep: slice = slice(None)) -> Diagnoser:
    command, speed = (column[keep] for column in loaded(samples, from_s))
    t_ns = times(samples)[keep]
    diagnoser = Diagnoser([balance_of_a_fan()])
    for k in range(0, len(t_ns), block):
        rows = slice(k, k + block)
        diagnoser.take(t_ns[rows], STEP_NS, command[rows], speed[rows], np.zeros_like(speed[rows]))
    return diagnoser


def test_a_fan_that_needs_more_command_at_a_held_speed_is_diagnosed() -> None:
    diagnoser = fed(1300, 100)
    at = int(times(1300)[-1])
    diagnoser.raised(0, at, EPOCH_NS + 10 * S)
    causes = diagnoser.diagnose(0, at)
    assert min(cause.probability for cause in causes) >= MIN_PROBABILITY, "less probable ones are not listed"
    assert sum(cause.probability for cause in causes) > 0.7
    probabilities = {cause.cause: cause.probability for cause in causes}
    assert sum(probabilities.get(name, 0.0) for name in ("drag_down", "sensor_stuck", "sensor_dropout")) < 0.05
    assert [cause.probability for cause in causes] == sorted((c.probability for c in causes), reverse=True)
    assert all(cause.evidence for cause in causes)


@pytest.mark.parametrize("keep", [slice(None), np.r_[0:600, 650:1300]], ids=["whole", "with a gap"])
def test_blocks_of_any_size_are_diagnosed_the_same(keep) -> None:
    found = []
    for block in (7, 5000):
        diagnoser = fed(1300, block, keep=keep)
        diagnoser.raised(0, EPOCH_NS + 11 * S, EPOCH_NS + 10 * S)
        found.append([diagnoser.diagnose(0, EPOCH_NS + at) for at in (12 * S, 13 * S - STEP_NS)])
    assert found[0] == found[1]


def test_only_the_last_seconds_affect_a_diagnosis() -> None:
    whole, late = fed(11_000, 10, from_s=109.0), fed(11_000, 10, from_s=109.0, keep=slice(1400, None))
    at = int(times(11_000)[-1])
    for diagnoser in (whole, late):
        diagnoser.raised(0, at, EPOCH_NS + 109 * S)
    assert whole.diagnose(0, at) == late.diagnose(0, at)


def test_the_known_offset_of_a_fan_is_no_fault() -> None:
    command, speed = loaded(1600, 0.0)
    diagnoser = Diagnoser([balance_of_a_fan()])
    diagnoser.take(times(1600), STEP_NS, command, speed, np.full_like(speed, 20.0))
    diagnoser.raised(0, EPOCH_NS + 15 * S, EPOCH_NS + 14 * S)
    assert diagnoser.diagnose(0, EPOCH_NS + 15 * S)[0].cause == "cannot_tell"


def test_a_fan_is_diagnosed_again_after_twice_as_long_each_time_and_each_once() -> None:
    for block in (1, 30, 2000):
        diagnoser = Diagnoser([balance_of_a_fan()] * 2)
        diagnoser.raised(1, EPOCH_NS, EPOCH_NS)
        found = []
        for k in range(0, 2000, block):
            rows = times(min(block, 2000 - k), k)
            found += [(k + row, fan) for row, fan in diagnoser.due(rows)]
        assert found == [(100, 1), (200, 1), (400, 1), (800, 1), (1600, 1)]


def test_a_successor_continues_with_the_pending_diagnoses() -> None:
    diagnoser = fed(1300, 100)
    diagnoser.raised(0, EPOCH_NS + 12 * S, EPOCH_NS + 10 * S)
    successor = Diagnoser([balance_of_a_fan()])
    successor.restore(json.loads(json.dumps(diagnoser.snapshot())))
    assert successor.due(times(2000, 1200)) == diagnoser.due(times(2000, 1200))


def test_a_silent_line_is_not_taken_for_a_tacho_that_drops_out() -> None:
    core = commissioned(core_of(calibration=CALIBRATION))
    rng = np.random.default_rng(2)
    shift = np.full(500, 5.0) + rng.normal(0, 0.1, 500)
    valid = np.ones(500, np.bool_)
    valid[50:150] = False
    _, alarms = feed(core, [prediction_of(rng.normal(0, 0.3, 500), valid, balance=shift)])
    diagnosed = [alarm for alarm in alarms if alarm.transition == Transition.DIAGNOSED]
    assert diagnosed
    assert "sensor_dropout" not in {cause.cause for alarm in diagnosed for cause in alarm.causes}


def test_a_fan_that_turns_again_keeps_the_cause_for_which_it_did_not_turn() -> None:
    causes = {name: Diagnosis(cause=name, probability=0.6) for name in ("no_power", "blocked", "gain_down")}
    diagnoser = Diagnoser([balance_of_a_fan()])
    for later, earlier, is_news in (
        ("gain_down", "no_power", False),
        ("no_power", "gain_down", True),
        ("no_power", "blocked", True),
    ):
        assert diagnoser.says_more([causes[later]], [causes[earlier]]) == is_news


def test_a_cause_named_while_a_fan_slowed_down_may_be_wrong_and_is_confirmed_when_it_stands() -> None:
    falling, standing = (Diagnosis(cause="no_power", probability=0.9, parameter=each) for each in (FALLING, "command"))
    weak = Diagnosis(cause="gain_down", probability=0.9)
    diagnoser = Diagnoser([balance_of_a_fan()])
    assert diagnoser.says_more([standing], [falling])
    assert diagnoser.says_more([weak], [falling]), "it slowed down to another speed"
    assert not diagnoser.says_more([weak], [standing]), "it turns again"

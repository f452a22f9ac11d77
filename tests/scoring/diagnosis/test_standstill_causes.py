"""scoring.diagnosis.standstill_causes: a blocked fan and one without power, whatever its tacho."""

from __future__ import annotations

import numpy as np
import pytest

from fantwin.scoring.diagnosis.standstill_causes import BEGUN, Fall, Standing, standstill_causes

AT_ONCE_S, RESTS = 0.03, 0.08
"""time constant of a rotor that is held; share of the speed below which a reading is of a fan at rest"""
PHASES = np.linspace(0.0, 1.0, 8, endpoint=False)
COASTS_S = np.array([0.8, 1.3, 2.0, 4.0])


def shown(constant_s: float, coasts_s: float, held_s: float, phase: float) -> Fall:
    """What a tacho shows of an exponential fall that begins at a phase of a reading, each a mean over held_s."""
    ends_s = held_s * np.arange(1.0, np.ceil(8.0 * constant_s / held_s) + 3.0)
    after_s = np.maximum(np.concatenate(([0.0], ends_s)) - phase * held_s, 0.0)
    turned = np.diff(np.concatenate(([0.0], ends_s)) - after_s + constant_s * -np.expm1(-after_s / constant_s))
    shares = turned / held_s
    lasted_s = held_s * shares[(shares < BEGUN) & (shares > RESTS)]
    return Fall(float(lasted_s.sum()), float(lasted_s[1:].sum()), coasts_s, held_s)


def probabilities(fall: Fall) -> dict[str, float]:
    return {each.cause: each.probability for each in standstill_causes(Standing.CAME_TO_REST, fall)}


def right_first(cause: str, held_in_coasts: float) -> float:
    """Share of falls, over tachos, phases and fans, of which the cause is named first."""
    hits = []
    for coast_s in COASTS_S:
        for factor in (0.75, 0.9, 1.0, 1.15, 1.4):
            constant_s = coast_s * factor if cause == "no_power" else AT_ONCE_S
            held_s = held_in_coasts * coast_s
            hits += [
                max(found, key=found.__getitem__) == cause
                for found in (probabilities(shown(constant_s, coast_s, held_s, phase)) for phase in PHASES)
            ]
    return float(np.mean(hits))


@pytest.mark.parametrize(
    ("held_in_coasts", "least"), [(0.02, 0.99), (0.1, 0.99), (0.3, 0.99), (0.5, 0.99), (0.8, 0.99), (1.0, 0.95)]
)
def test_a_blocked_fan_and_one_without_power_are_told_apart_by_how_long_they_ran_on(held_in_coasts, least) -> None:
    assert right_first("no_power", held_in_coasts) >= least
    assert right_first("blocked", held_in_coasts) >= least


def test_a_tacho_that_is_slower_than_a_coast_tells_nothing() -> None:
    for lasted in np.linspace(0.0, 3.75, 9):
        assert max(probabilities(Fall(float(lasted), 0.0, 0.5, 5.0)).values()) < 0.5


def test_a_longer_fall_never_makes_a_blocked_rotor_likelier_than_no_power() -> None:
    for held_s in (0.02, 0.1, 0.5, 1.0):
        found = [probabilities(Fall(float(each), float(each), 1.3, held_s)) for each in np.linspace(0.0, 6.0, 120)]
        ratio = [each.get("no_power", 0.0) - each.get("blocked", 0.0) for each in found]
        assert ratio[0] < 0.0 < ratio[-1]
        assert np.count_nonzero(np.diff(np.sign(ratio))) == 1, held_s


def test_a_fall_at_once_may_be_the_tachos_and_its_length_is_in_the_words() -> None:
    first, second = standstill_causes(Standing.CAME_TO_REST, Fall(0.04, 0.01, 1.3, 0.1), 25.0)
    assert (first.cause, second.cause) == ("blocked", "no_tacho")
    assert first.probability == pytest.approx(0.6, abs=0.02)
    assert (
        first.evidence
        == "does not turn although commanded to 25; it ran on for 0.0 s, without power it would for 1.3 s"
    )
    assert (first.parameter, first.change, first.unit) == ("command", 25.0, "command")


@pytest.mark.parametrize(
    ("standing", "causes", "words"),
    [
        (Standing.CAME_TO_REST, ["blocked", "no_power", "no_tacho"], "does not turn although commanded to turn"),
        (Standing.NOT_STARTED, ["blocked", "no_power", "no_tacho"], "has not started although commanded to turn"),
        (Standing.NO_READING, ["no_tacho", "no_power"], "gives no reading although commanded to turn"),
        (Standing.KEEPS_SPEED, ["still_driven", "windmilling"], "keeps its speed although its command stops it"),
        (Standing.COASTS_TOO_LONG, ["still_driven", "windmilling"], "turns although its command stops it"),
        (Standing.TURNED_AGAIN, ["still_driven", "windmilling"], "turns again although its command stops it"),
    ],
)
def test_what_is_not_seen_leaves_the_priors(standing, causes, words) -> None:
    found = standstill_causes(standing, None)
    assert [each.cause for each in found] == causes
    assert {each.evidence for each in found} == {words}
    assert sum(each.probability for each in found) == pytest.approx(1.0, abs=0.06)

"""scoring.diagnosis.what_would_tell: the command that would tell a cause, or where to look at a standing fan."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from fantwin.scoring.diagnosis.steady_fan import SteadyFan
from fantwin.scoring.diagnosis.what_would_tell import KNOWN_SOON, Advice, SeenSinceOnset

FAN = SteadyFan(viscous=2e-4, drag=3e-6, friction=0.04, top_rad_s=500.0)
SEEN = SeenSinceOnset(20.0, 300.0, 300.0, FAN.needed(300.0), FAN.needed(300.0), is_standing=False)


def advised(advice: Advice, seen: SeenSinceOnset = SEEN) -> float:
    found = re.fullmatch(
        r"why: move the command to (\S+) V for ten seconds, and back", advice.added_to("why", seen, FAN)
    )
    assert found
    return float(found[1])


def test_the_command_makes_the_fan_a_third_slower_or_faster_where_that_would_not_turn_it() -> None:
    assert advised(Advice("V")) == pytest.approx(FAN.needed(200.0), rel=0.05)
    assert advised(Advice("V", lowest_command=0.3)) == pytest.approx(FAN.needed(400.0), rel=0.05)
    assert advised(Advice("V", lowest_command=0.3, highest_command=0.5)) == 0.5
    weak = replace(SEEN, lowest_command=2.0 * SEEN.lowest_command)
    assert advised(Advice("V"), weak) == pytest.approx(2.0 * FAN.needed(200.0), rel=0.05), "of the command it takes now"


def test_nothing_is_advised_where_no_other_command_is_known_or_more_comes_by_itself() -> None:
    at_its_only_one = Advice("V", lowest_command=0.3, highest_command=SEEN.highest_command)
    assert at_its_only_one.added_to("why", SEEN, FAN) == "why"
    assert Advice("V").added_to("why", replace(SEEN, lowest_rad_s=float("nan")), FAN) == "why"
    assert Advice("V").added_to("why", replace(SEEN, age_s=1.0), FAN) == f"why: {KNOWN_SOON}"


def test_a_fan_that_stands_should_turn_or_gets_a_command_that_turns_it() -> None:
    stands = replace(SEEN, lowest_rad_s=0.0, highest_rad_s=0.0, is_standing=True)
    assert Advice("duty/255", lowest_command=30.0).added_to("why", replace(stands, highest_command=113.0), FAN) == (
        "why: at 113 duty/255 it should turn: see whether it is free to turn and has power"
    )
    idle = replace(stands, highest_command=0.0)
    assert Advice("", 0.15).added_to("why", idle, FAN) == "why: it does not turn: move the command to 0.30"

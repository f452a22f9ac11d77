"""scoring.diagnosis.ranked_causes: the command that would tell a cause."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from fantwin.scoring.diagnosis.ranked_causes import Advice, SeenSinceOnset, SteadyFan

FAN = SteadyFan(viscous=2e-4, drag=3e-6, friction=0.04, top_rad_s=500.0)
SEEN = SeenSinceOnset(300.0, 300.0, FAN.needed(300.0), FAN.needed(300.0))


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


def test_nothing_is_advised_where_no_other_command_is_known() -> None:
    at_its_only_one = Advice("V", lowest_command=0.3, highest_command=SEEN.highest_command)
    assert at_its_only_one.added_to("why", SEEN, FAN) == "why"
    assert Advice("V").added_to("why", replace(SEEN, lowest_rad_s=float("nan")), FAN) == "why"

"""scoring.diagnosis.ranked_causes: sizes with intervals, when no cause is named first, and when there is news."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from fantwin.schemas.messages import Diagnosis
from fantwin.scoring.diagnosis import ranked_causes
from fantwin.scoring.diagnosis.causes import CAUSES, ROWS, WHAT_TO_DO, CauseRow, Size, advice, likely_causes
from fantwin.scoring.diagnosis.ranked_causes import (
    Advice,
    CauseWords,
    PossibleCause,
    SeenSinceOnset,
    SteadyFan,
    says_more,
)
from fantwin.scoring.model.faults import FAULTS

FAN = SteadyFan(viscous=2e-4, drag=3e-6, friction=0.04, top_rad_s=500.0)
OF_OWN_DRIVE = replace(FAN, has_own_drive=True)
MOVED = SeenSinceOnset(200.0, 400.0, 0.2, 0.6)
HELD = replace(MOVED, lowest_rad_s=398.0)


def words(*causes: PossibleCause, has_supply: bool = False, fan: SteadyFan = FAN, seen: SeenSinceOnset = MOVED):
    return CauseWords(Advice("%"), has_supply).of(causes, seen, fan)


def sure(cause: str, change: float, std: float) -> PossibleCause:
    return PossibleCause(cause, 1.0, change, std)


def slower(gain: float = 1.0, drag: float = 1.0, torque: float = 0.0) -> float:
    """Share of the top speed that a fan with a fault loses under the command of the top speed."""
    balance = [FAN.drag * drag, FAN.viscous, FAN.friction + torque - gain * FAN.needed(FAN.top_rad_s)]
    return float(np.roots(balance).real.max()) / FAN.top_rad_s - 1.0


AT_TOP = FAN.needed(FAN.top_rad_s)


@pytest.mark.parametrize(
    ("cause", "low", "true", "high", "evidence"),
    [
        ("drag_up", {"drag": 1.20}, {"drag": 1.24}, {"drag": 1.28}, "drag +24 % (95 %: 20 to 28)"),
        ("drag_down", {"drag": 0.66}, {"drag": 0.7}, {"drag": 0.74}, "drag -30 % (95 %: -34 to -26)"),
        ("gain_down", {"gain": 0.84}, {"gain": 0.88}, {"gain": 0.92}, "gain -12 % (95 %: -16 to -8)"),
        (
            "friction_up",
            {"torque": 0.04 * AT_TOP},
            {"torque": 0.05 * AT_TOP},
            {"torque": 0.06 * AT_TOP},
            "friction +5 % of the torque at full speed (95 %: 4 to 6)",
        ),
        (
            "external_torque",
            {"torque": 0.09 * AT_TOP},
            {"torque": 0.1 * AT_TOP},
            {"torque": 0.11 * AT_TOP},
            "torque against the rotation +10 % of the torque at full speed (95 %: 9 to 11)",
        ),
    ],
)
def test_a_share_of_the_speed_is_said_as_the_change_of_the_parameter_that_makes_the_fan_so_slow(
    cause, low, true, high, evidence
) -> None:
    std = abs(slower(**high) - slower(**low)) / 2.0 / 1.96
    (found,) = words(sure(cause, slower(**true), std))
    assert found.evidence == evidence
    assert found.change == pytest.approx(
        sum(true.values()) / (AT_TOP if "torque" in true else 1.0) - ("torque" not in true)
    )
    assert found.parameter and evidence.startswith(found.parameter)


@pytest.mark.parametrize(
    ("cause", "change", "std", "evidence", "unit"),
    [
        ("slow_change", -0.012, 0.001, "speed -1.2 % (95 %: -1.4 to -1.0)", "relative"),
        ("sensor_scaling", -0.3, 0.01, "speed reading -30 % (95 %: -32 to -28)", "relative"),
        ("sensor_dropout", 0.99, 0.02, "99 % of the readings are missing (95 %: 95 to 100)", "share"),
        (
            "unsteady",
            3.1,
            0.2,
            "its speed varies 3.1 times as much as that of a healthy fan (95 %: 2.7 to 3.5)",
            "times",
        ),
        ("sensor_stuck", 1.0, 0.05, "its reading stays the same although the speed should change", "relative"),
        ("sensor_dropout", 0.38, float("nan"), "38 % of the readings are missing", "share"),
        ("slow_change", -0.12, float("nan"), "speed -12 %", "relative"),
    ],
)
def test_other_sizes_are_in_their_own_words(cause, change, std, evidence, unit) -> None:
    (found,) = words(sure(cause, change, std))
    assert (found.evidence, found.unit) == (evidence, unit)


def test_a_fan_that_controls_its_speed_by_itself_has_no_torque_to_speak_of() -> None:
    for cause in ("drag_up", "friction_up", "gain_down", "external_torque"):
        (found,) = words(sure(cause, -0.12, 0.01), fan=OF_OWN_DRIVE)
        assert (found.evidence, found.parameter) == ("speed -12 % (95 %: -14 to -10)", "speed")
    (found,) = words(sure("drag_up", -0.12, 0.01), fan=replace(FAN, drag=0.0))
    assert found.parameter == "speed", "a twin without drag does not know what a share of it is"


def test_no_cause_is_named_first_that_is_less_probable_than_60_per_cent() -> None:
    two = [PossibleCause("drag_up", 0.45, -0.1, 0.01), PossibleCause("friction_up", 0.4, -0.1, 0.01)]
    rest = PossibleCause("gain_down", 0.15, -0.1, 0.01)
    found = words(rest, *two)
    assert [each.cause for each in found] == ["cannot_tell", "drag_up", "friction_up", "gain_down"]
    assert found[0].probability == pytest.approx(0.55), "of being wrong"
    assert found[0].evidence.startswith(
        "cannot tell yet: more drag and more friction explain it alike: move the command"
    )
    assert words(*two, rest, seen=HELD)[0].evidence.startswith(
        "cannot tell yet: the speed has changed too little since the alarm began: move the command to "
    )
    clear = words(replace(two[0], probability=0.6), replace(two[1], probability=0.3), replace(rest, probability=0.1))
    assert [each.cause for each in clear] == ["drag_up", "friction_up"], "what is below 15 % is not listed"
    many = [PossibleCause(f"cause_{number}", 0.1, -0.1, 0.01) for number in range(10)]
    assert len(words(*many)) == 11, "the first is listed, and what is as probable"
    assert words() == ()


def test_a_measured_supply_leaves_less_drive_half_of_its_prior() -> None:
    causes = (PossibleCause("gain_down", 0.6, -0.1, 0.01), PossibleCause("drag_up", 0.4, -0.1, 0.01))
    assert [each.cause for each in words(*causes)] == ["gain_down", "drag_up"]
    known = words(*causes, has_supply=True)
    assert [(each.cause, round(each.probability, 3)) for each in known] == [
        ("cannot_tell", 0.429),
        ("drag_up", 0.571),
        ("gain_down", 0.429),
    ]
    assert known[2].evidence.endswith(", beyond the supply voltage, which is measured")
    assert "supply" not in known[1].evidence


def test_another_order_or_a_tenth_of_probability_is_news() -> None:
    def said(**causes: float) -> list[Diagnosis]:
        return [Diagnosis(cause=cause, probability=probability) for cause, probability in causes.items()]

    before = said(drag_up=0.6, friction_up=0.4)
    assert not says_more(said(drag_up=0.65, friction_up=0.35), before)
    assert says_more(said(drag_up=0.71, friction_up=0.29), before)
    assert says_more(said(friction_up=0.51, drag_up=0.49), before)
    assert says_more(said(drag_up=0.6), before)
    assert says_more(before, ())
    assert says_more(said(blocked=0.6), before)
    assert not says_more(before, said(blocked=0.6, no_tacho=0.3)), "a fan that turns again shows the end of its fault"


def test_every_fault_of_the_model_has_words_and_advice() -> None:
    for cause in {fault.cause for fault in FAULTS} | {"unsteady", "slow_change", "sensor_dropout"}:
        assert CAUSES[cause] and WHAT_TO_DO[cause], cause
        assert words(sure(cause, -0.1, 0.01))[0].evidence, cause


def test_a_new_fault_is_a_row_and_is_named_even_without_one(monkeypatch: pytest.MonkeyPatch) -> None:
    toy = sure("toy_fault", -0.12, 0.01)
    (found,) = words(toy)
    assert found.evidence == "speed -12 % (95 %: -14 to -10)"
    assert (likely_causes([found]), advice([found])) == ("toy_fault", "")
    monkeypatch.setattr(ranked_causes, "ROWS", (*ROWS, CauseRow("toy_fault", "a toy", "play", Size.READING)))
    assert words(toy)[0].evidence == "speed reading -12 % (95 %: -14 to -10)"


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


def test_in_a_loop_people_move_the_set_point_and_are_told_where_its_controller_can_give_no_more() -> None:
    in_loop = replace(FAN, is_closed_loop=True)
    assert (
        Advice("V").added_to("why", SEEN, in_loop) == "why: change its set-point by a third for ten seconds, and back"
    )
    fault, held = sure("drag_up", -0.1, 0.01), replace(SEEN, lowest_command=0.9, highest_command=0.9)
    at_limit = "its command stays at the limit: its controller can give no more"
    for fan, highest, seen, is_said in (
        (in_loop, 0.9, held, True),
        (FAN, 0.9, held, False),
        (in_loop, 0.95, held, False),
        (in_loop, 0.9, replace(held, lowest_command=0.89), False),
    ):
        (first,) = CauseWords(Advice("V", highest_command=highest), has_supply=False).of([fault], seen, fan)
        assert first.evidence.startswith("drag +") and first.evidence.endswith(at_limit) == is_said

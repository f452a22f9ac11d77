"""Which causes of an alarm are said to be likely: all that are about as probable as the first."""

from __future__ import annotations

import pytest

from fantwin.schemas.messages import Diagnosis
from fantwin.scoring.diagnosis.causes import (
    CANNOT_TELL,
    advice,
    less_likely,
    likely_causes,
    likely_evidence,
    likely_with_share,
    most_probable,
)


def causes(*named: tuple[str, float]) -> list[Diagnosis]:
    return [Diagnosis(cause=name, probability=share, evidence=f"of {name}") for name, share in named]


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ([("blocked", 0.4), ("no_power", 0.4), ("no_tacho", 0.2)], "blocked or no power, 40 % each"),
        ([("blocked", 0.45), ("no_power", 0.35), ("no_tacho", 0.2)], "blocked, 45 %, or no power, 35 %"),
        ([("blocked", 0.46), ("no_power", 0.35), ("no_tacho", 0.19)], "blocked, 46 %"),
        ([("blocked", 0.34), ("no_power", 0.33), ("no_tacho", 0.33)], None),
        ([("of_a_newer_version", 0.9), ("no_power", 0.1)], "of_a_newer_version, 90 %"),
        ([(CANNOT_TELL, 1.0)], "cannot tell yet"),
        ([], ""),
    ],
)
def test_all_causes_are_named_that_are_about_as_probable_as_the_first(found, words):
    said = likely_with_share(causes(*found))
    three = "blocked, 34 %, or no power, 33 %, or no signal of the tacho, 33 %"
    assert said == (three if words is None else words)


def test_names_advice_and_evidence_are_those_of_all_likely_causes():
    tie = causes(("blocked", 0.4), ("no_power", 0.4), ("no_tacho", 0.2))
    assert likely_causes(tie) == "blocked or no power"
    assert advice(tie) == "switch it off, then see what blocks the rotor; or look at its supply, fuse and plug"
    assert likely_evidence(tie) == "of blocked; of no_power"
    assert [each.cause for each in less_likely(tie)] == ["no_tacho"]
    assert most_probable(tie) == ["blocked 40 %", "no power 40 %"]
    same = causes(("sensor_stuck", 0.5), ("sensor_dropout", 0.5))
    assert advice(same) == "look at the tacho and its cable", "said once"

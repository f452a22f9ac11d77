"""scoring.wear.wear_monitor: what is said in words."""

from __future__ import annotations

from fantwin.scoring.wear.slow_change import is_of_slow_change, limit_ahead, own_change, shared_change

HOUR_NS = 3600 * 10**9


def test_the_notices_are_told_from_other_notes() -> None:
    alone = own_change(2, -0.0512, 30 * HOUR_NS, None)
    assert alone == "fan 2: speed -5.1 % in 30 h: see fantwin wear"
    beside = own_change(0, 0.04, 12 * 24 * HOUR_NS, -0.002)
    assert beside == "fan 0: speed +4.0 % in 12 days, the fans beside it -0.2 %: see fantwin wear"
    shared = shared_change(-0.042)
    assert shared == (
        "most fans turn 4 % slower than when they were commissioned: the air, the supply, or a filter in front of them "
        "all"
    )
    assert all(is_of_slow_change(note) for note in (alone, beside, shared))
    assert not is_of_slow_change("98.0 % of the fans' samples judged")


def test_a_limit_ahead_names_the_first_fan_its_days_and_the_others() -> None:
    line = limit_ahead(3, [], -0.001, [4.2, 2.6, 6.1])
    assert line == "fan 3 is wearing: it will have lost 10 % of its speed in about 4 days (3 to 6); inspect it"
    line = limit_ahead(3, [1, 5], 0.001, [1.2, 0.0, 2.0])
    assert line == "fan 3 is wearing: it will turn 10 % faster in about 1 day (0 to 2); inspect it, and fan 1, 5"
    assert "it turns faster by about 10 % of its speed; i" in limit_ahead(0, [], 0.1, [0.0, 0.0, 0.0])
    assert "speed within a day; inspect it" in limit_ahead(0, [], -0.001, [0.3, 0.0, 2.0])

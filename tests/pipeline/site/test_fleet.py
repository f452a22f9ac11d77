"""What is known about the fans of a site now: states, groups, and the worst ones."""

from __future__ import annotations

from typing import Any

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.site.fleet import NORMAL_LEVELS, SHOWN_CLASSES, FanGroup, Fleet
from fantwin.schemas.enums import FanState, InvalidReason, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Score
from tests.support import made_messages
from tests.support.score_data import START_NS

SECOND_NS = 1_000_000_000
GAP = (FanState.UNKNOWN, InvalidReason.GAP)


def newest(tray: str, t_ns: int, *fans: tuple[Any, ...]) -> Score:
    """A score of one sample; each fan: its state, and its score, or the reason why it has none."""
    states = [fan[0] for fan in fans]
    valid = [state != FanState.UNKNOWN for state in states]
    reasons = [0 if ok else fan[1] for ok, fan in zip(valid, fans, strict=True)]
    scores = [fan[1] if ok else np.nan for ok, fan in zip(valid, fans, strict=True)]
    columns = {"state": states, "valid": valid, "invalid_reason": reasons, "score": scores}
    return made_messages.filled(Score, 1, len(fans), header=Header("p", 0, tray), period_ns=1, t_ns=t_ns, **columns)


def alarm(tray: str, fan: int, onset_t_ns: int, **changes: Any) -> Alarm:
    return made_messages.alarm(fan, onset_t_ns, tray, **{"transition": Transition.RAISED, **changes})


class Site:
    """Fans of some trays; their samples come at once."""

    def __init__(self, **trays: int) -> None:
        self.fleet = Fleet([TrayConfig(name=name, fans=fans) for name, fans in trays.items()])
        self.add_alarm, self.silence = self.fleet.add_alarm, self.fleet.silence

    def update(self, score: Score) -> None:
        self.fleet.update(score.header.tray, score, 0.0)

    def names(self, most: int = 99) -> list[str]:
        return [f"{each.fan} {each.state}" for each in self.fleet.every_fan()[:most]]

    def classes(self) -> list[str]:
        return [SHOWN_CLASSES[number].name for number in self.fleet.classes()]


def test_a_raised_alarm_shows_at_once_and_lasts_until_its_message_says_otherwise() -> None:
    site = Site(a=2)
    site.update(newest("a", START_NS, (FanState.NORMAL, 0.2), (FanState.NORMAL, 0.9)))
    site.add_alarm(alarm("a", 0, START_NS))
    assert site.names() == ["a/0 alarm", "a/1 normal"] and site.classes()[0] == "alarm"
    site.update(newest("a", START_NS + 1, (FanState.STOPPED, 0.0), (FanState.NORMAL, 0.9)))
    assert site.names() == ["a/0 alarm, now stopped by its command", "a/1 normal"]
    site.update(newest("a", START_NS + 1, GAP, (FanState.NORMAL, 0.9)))
    assert site.names()[0] == "a/0 alarm, unknown: samples are missing"
    site.silence("a", START_NS + 1)
    assert site.names() == ["a/0 alarm, silent", "a/1 silent"]
    site.add_alarm(alarm("a", 0, START_NS, active=False, transition=Transition.CLEARED))
    assert site.names() == ["a/0 silent", "a/1 silent"] and site.fleet.alarms() == []


def test_the_worst_come_first_and_those_not_judged_last() -> None:
    site = Site(a=4, b=4)
    site.add_alarm(alarm("b", 1, START_NS, shelved_until_t_ns=START_NS + 1))
    site.update(newest("a", START_NS, (FanState.NORMAL, 0.9), (FanState.ALARM, 1.5), GAP, (FanState.STOPPED, 0.0)))
    site.update(
        newest("b", START_NS, (FanState.SUSPECT, 1.1), (FanState.ALARM, 9.0), (FanState.RETURNING, 2.5), (1, np.nan))
    )
    assert site.names() == [
        "b/2 returning",
        "a/1 alarm",
        "b/0 suspect",
        "b/1 alarm (silenced)",
        "a/0 normal",
        "a/3 stopped",
        "b/3 normal",
        "a/2 unknown: samples are missing",
    ]
    assert [str(fan) for fan in site.fleet.alarms()] == ["b/2", "a/1"], "a silenced alarm asks for no attention"
    counts = {FanGroup.ALARM: 2, FanGroup.SILENCED: 1, FanGroup.SUSPECT: 1, FanGroup.NOT_JUDGED: 1}
    assert site.fleet.counts() == counts | {FanGroup.AT_REST: 1, FanGroup.NORMAL: 2}


def test_a_state_is_since_its_first_sample_and_an_alarm_since_its_onset() -> None:
    site = Site(a=2)
    for second, state in enumerate((FanState.NORMAL, FanState.SUSPECT, FanState.SUSPECT, FanState.ALARM)):
        site.update(newest("a", START_NS + second * SECOND_NS, (state, 1.0), (FanState.NORMAL, 0.0)))
    first, second = site.fleet.every_fan()
    assert (first.since_t_ns, second.since_t_ns) == (START_NS + 3 * SECOND_NS, START_NS)
    site.add_alarm(alarm("a", 0, START_NS + 5))
    assert site.fleet.every_fan()[0].since_t_ns == START_NS + 5


def test_a_cell_shows_the_state_and_how_near_the_score_is_to_the_limit() -> None:
    states = [*((FanState.NORMAL, score) for score in (0.0, 0.5, 0.99, 7.0, np.nan)), (99, 0.0)]
    site = Site(a=len(states), b=len(FanState), c=1)
    site.update(newest("a", START_NS, *states))
    site.update(newest("b", START_NS, *((state, 0) for state in FanState)))
    shown = site.classes()
    nearest = f"normal, score {1 - 1 / NORMAL_LEVELS:.1f} to 1.0"
    assert shown[:6] == ["normal, score 0.0 to 0.2", "normal, score 0.4 to 0.6", nearest, nearest, shown[0], shown[5]]
    assert shown[5] == "unknown state" and shown[-1] == "silent"
    of_states = [state.words for state in FanState]
    of_states[FanState.NORMAL] = shown[0]
    of_states[FanState.ALARM], of_states[FanState.RETURNING] = "alarm", shown[6 + FanState.RETURNING]
    assert shown[6:-1] == of_states

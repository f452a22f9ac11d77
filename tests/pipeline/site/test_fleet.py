"""What is known about a fleet now: states, the worst fans, and the fans that are not judged."""

from __future__ import annotations

from typing import Any

import numpy as np

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.site.fleet import NORMAL_LEVELS, Fleet, class_names
from fantwin.schemas.enums import FanState, InvalidReason, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Score
from tests.support import made_messages
from tests.support.score_data import START_NS

SECOND_NS = 1_000_000_000
GAP = (FanState.UNKNOWN, InvalidReason.GAP)


def newest(tray: str, t_ns: int, *fans: tuple[Any, ...]) -> Score:
    """A score of one sample; each fan: its state, and its score, or the reason why it has none."""
    judged = [fan[0] != FanState.UNKNOWN for fan in fans]
    return Score(
        header=Header("p", 0, tray),
        fans=len(fans),
        period_ns=1,
        t_ns=np.array([t_ns]),
        state=np.array([[fan[0] for fan in fans]], np.uint8),
        invalid_reason=np.array([[0 if ok else fan[1] for ok, fan in zip(judged, fans, strict=True)]], np.uint8),
        score=np.array([[fan[1] if ok else np.nan for ok, fan in zip(judged, fans, strict=True)]], np.float32),
    )


def alarm(tray: str, fan: int, onset_t_ns: int, **changes: Any) -> Alarm:
    return made_messages.alarm(fan, onset_t_ns, tray, **{"transition": Transition.RAISED, **changes})


def fleet_of(**trays: int) -> Fleet:
    return Fleet([TrayConfig(name=name, fans=fans) for name, fans in trays.items()])


def names(fleet: Fleet, most: int = 99) -> list[str]:
    return [f"{each.fan} {each.state}" for each in fleet.worst(most)]


def test_a_raised_alarm_shows_at_once_and_the_next_sample_says_more() -> None:
    fleet = fleet_of(a=2)
    fleet.update(newest("a", START_NS, (FanState.NORMAL, 0.2), (FanState.NORMAL, 0.9)))
    fleet.add_alarm(alarm("a", 0, START_NS))
    assert names(fleet) == ["a/0 alarm", "a/1 normal"]
    assert class_names()[fleet.classes()[0]] == "alarm" and fleet.counts()["in alarm"] == 1
    fleet.update(newest("a", START_NS + 1, (FanState.NORMAL, 0.2), (FanState.NORMAL, 0.9)))
    assert names(fleet) == ["a/1 normal", "a/0 normal"]
    fleet.add_alarm(alarm("a", 1, START_NS, transition=Transition.REPUBLISHED))
    assert names(fleet) == ["a/1 normal", "a/0 normal"], "what is sent again for late joiners is no news"


def test_the_worst_come_first_and_those_not_judged_are_left_out() -> None:
    fleet = fleet_of(a=4, b=4)
    fleet.add_alarm(alarm("b", 1, START_NS, shelved_until_t_ns=START_NS + 1))
    fleet.update(newest("a", START_NS, (FanState.NORMAL, 0.9), (FanState.ALARM, 1.5), GAP, (FanState.STOPPED, 0.0)))
    fleet.update(
        newest("b", START_NS, (FanState.SUSPECT, 1.1), (FanState.ALARM, 9.0), (FanState.RETURNING, 2.5), (1, np.nan))
    )
    assert names(fleet) == [
        "b/2 returning",
        "a/1 alarm",
        "b/0 suspect",
        "b/1 alarm (silenced)",
        "a/0 normal",
        "a/3 stopped",
        "b/3 normal",
    ]
    assert names(fleet, 2) == names(fleet)[:2]
    assert [str(fan) for fan in fleet.alarms()] == ["b/2", "a/1"], "a silenced alarm asks for no attention"
    assert fleet.counts() == {"in alarm": 3, "suspect": 1, "not judged": 1}


def test_a_state_is_since_its_first_sample_and_an_alarm_since_its_onset() -> None:
    fleet = fleet_of(a=2)
    for second, state in enumerate((FanState.NORMAL, FanState.SUSPECT, FanState.SUSPECT, FanState.ALARM)):
        fleet.update(newest("a", START_NS + second * SECOND_NS, (state, 1.0), (FanState.NORMAL, 0.0)))
    first, second = fleet.worst(2)
    assert (first.since_t_ns, second.since_t_ns) == (START_NS + 3 * SECOND_NS, START_NS)
    fleet.add_alarm(alarm("a", 0, START_NS + 5))
    assert fleet.worst(1)[0].since_t_ns == START_NS + 5


def test_an_alarm_whose_samples_are_not_judged_stays_an_alarm_until_its_message_says_otherwise() -> None:
    fleet = fleet_of(a=1)
    fleet.update(newest("a", START_NS, (FanState.ALARM, 3.0)))
    fleet.update(newest("a", START_NS + 1, GAP))
    assert fleet.counts()["in alarm"] == 0, "a viewer that has no message of it cannot know"
    fleet.add_alarm(alarm("a", 0, START_NS))
    assert names(fleet) == ["a/0 alarm, unknown: gap"] and fleet.counts()["not judged"] == 0
    fleet.silence("a", START_NS + 1)
    assert names(fleet) == ["a/0 alarm, silent"]
    fleet.add_alarm(alarm("a", 0, START_NS, active=False, transition=Transition.CLEARED))
    assert names(fleet) == [] and fleet.counts()["not judged"] == 1


def test_what_a_judged_sample_says_counts_more_than_an_old_message() -> None:
    fleet = fleet_of(a=1)
    fleet.add_alarm(alarm("a", 0, START_NS))
    fleet.update(newest("a", START_NS, (FanState.NORMAL, 0.1)))
    assert fleet.alarms() == []


def test_an_alarm_of_a_fan_that_the_tray_does_not_have_changes_no_other() -> None:
    fleet = fleet_of(a=1, b=1)
    fleet.add_alarm(alarm("a", 1, START_NS))
    fleet.update(newest("b", START_NS, GAP))
    assert fleet.alarms() == []


def test_a_cell_shows_the_state_and_how_near_the_score_is_to_the_limit() -> None:
    states = [*((FanState.NORMAL, score) for score in (0.0, 0.5, 0.99, 7.0, np.nan)), (99, 0.0)]
    fleet = fleet_of(a=len(states), b=len(FanState), c=1)
    fleet.update(newest("a", START_NS, *states))
    fleet.update(newest("b", START_NS, *((state, 0) for state in FanState)))
    shown = [class_names()[number] for number in fleet.classes()]
    nearest = f"normal, score {1 - 1 / NORMAL_LEVELS:.1f} to 1.0"
    assert shown[:6] == ["normal, score 0.0 to 0.2", "normal, score 0.4 to 0.6", nearest, nearest, shown[0], shown[5]]
    assert shown[5] == "unknown state" and shown[-1] == "silent"
    of_states = [state.words for state in FanState]
    of_states[FanState.NORMAL] = shown[0]
    assert shown[6:-1] == of_states


def test_fans_that_are_not_judged_are_grouped_by_reason_the_most_frequent_first() -> None:
    fleet = fleet_of(a=2, b=2, c=3)
    fleet.update(newest("a", START_NS + 7, GAP, (FanState.NORMAL, 0.0)))
    fleet.update(newest("b", START_NS + 5, GAP, GAP))
    groups = [(group.reason, group.fans, group.trays, group.since_t_ns) for group in fleet.unscored()]
    assert groups[0][:2] in (("silent", 3), ("unknown: gap", 3))
    assert set(map(repr, groups)) == {
        repr(("silent", 3, ["c"], 0)),
        repr(("unknown: gap", 3, ["a", "b"], START_NS + 5)),
    }

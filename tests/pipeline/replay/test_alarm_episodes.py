"""pipeline.replay.offline.alarm_episodes: alarms from raised to cleared, across all messages in between."""

from __future__ import annotations

import json
from typing import Any

from fantwin.pipeline.replay.offline.alarm_episodes import Episode, compare_episodes, episodes
from fantwin.schemas.enums import Feedback, Severity, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Diagnosis

DRAG, GAIN = Diagnosis(cause="drag_up", probability=0.6), Diagnosis(cause="gain_down", probability=0.9)


def alarm(
    t_ns: int, transition: Transition = Transition.RAISED, *, fan: int = 0, tray: str = "a", **more: Any
) -> Alarm:
    fields: dict[str, Any] = {"active": transition != Transition.CLEARED, "severity": Severity.WARNING, "onset_t_ns": 5}
    fields |= {"residual_rad_s": float(t_ns), "residual_std_rad_s": 1.0, "message": transition.name.lower()}
    return Alarm(header=Header("p", 0, tray), fan=fan, t_ns=t_ns, transition=transition, **fields | more)


def one(*alarms: Alarm) -> Episode:
    (episode,) = episodes(alarms)
    return episode


def test_an_episode_lasts_from_raised_to_cleared_with_the_highest_severity_and_the_latest_values() -> None:
    episode = one(
        alarm(10, causes=(DRAG,), torque_balance_command=3.0),
        alarm(11, Transition.DIAGNOSED, causes=(GAIN, DRAG)),
        alarm(12, Transition.SEVERITY, severity=Severity.ALARM),
        alarm(13, Transition.ACKNOWLEDGED, request="o/1"),
        alarm(10, Transition.REPUBLISHED),  # after a restart
        alarm(20, Transition.CLEARED),
    )
    assert (episode.raised_ns, episode.cleared_ns, episode.onset_ns) == (10, 20, 5)
    assert (episode.severity, episode.causes) == ("alarm", (GAIN, DRAG))
    assert (episode.residual_rad_s, episode.torque_balance_command, episode.message) == (10.0, 3.0, "raised")


def test_an_unknown_residual_is_null_and_not_zero() -> None:
    document = json.loads(json.dumps(one(alarm(10, residual_rad_s=0.0, torque_balance_command=2.5)).as_json()))
    assert document["cleared_ns"] is None
    assert (document["residual"], document["torque_balance"]) == (None, 2.5)
    document = one(alarm(10, residual_rad_s=-1e-9, torque_balance_command=0.0)).as_json()
    assert (document["residual"], document["torque_balance"]) == (-1e-9, None)


def test_an_alarm_raised_again_by_a_scorer_without_a_snapshot_continues_its_episode() -> None:
    episode = one(alarm(10), alarm(15, onset_t_ns=14), alarm(30, Transition.CLEARED, onset_t_ns=14))
    assert (episode.raised_ns, episode.onset_ns, episode.cleared_ns) == (10, 5, 30)


def test_episodes_are_per_fan_and_tray_in_order_of_time() -> None:
    found = episodes([alarm(30), alarm(10, fan=1), alarm(20, tray="b"), alarm(40, Transition.CLEARED, fan=1)])
    assert [(e.tray, e.fan, e.raised_ns, e.cleared_ns) for e in found] == [
        ("a", 1, 10, 40),
        ("b", 0, 20, None),
        ("a", 0, 30, None),
    ]


def test_an_alarm_is_in_both_lists_where_the_same_fans_overlap() -> None:
    before = episodes([alarm(10), alarm(20, Transition.CLEARED), alarm(50, onset_t_ns=45)])
    now = episodes([alarm(12), alarm(30, Transition.CLEARED), alarm(11, fan=1)])
    found = compare_episodes(now, before)
    assert [e.fan for e in found["gained"]] == [1]
    assert [e.raised_ns for e in found["kept"]] == [12]
    assert [e.raised_ns for e in found["lost"]] == [50]


def marked(t_ns: int, transition: Transition, meant_t_ns: int, comment: str = "", **more: Any) -> Alarm:
    return alarm(
        t_ns, transition, active=False, marked_onset_t_ns=meant_t_ns, operator_name="ann", comment=comment, **more
    )


def test_feedback_belongs_to_the_alarm_that_it_names_and_the_last_word_counts() -> None:
    first, second = episodes(
        [
            alarm(10),
            alarm(20, Transition.CLEARED),
            alarm(40, onset_t_ns=35),
            alarm(50, Transition.CLEARED, onset_t_ns=35),
            marked(60, Transition.MARKED_TRUE, 5, onset_t_ns=35),
            marked(60, Transition.MARKED_FALSE, 35, "first", onset_t_ns=35, feedback=Feedback.FALSE_ALARM),
            marked(70, Transition.MARKED_FALSE, 5, "a door", onset_t_ns=35),
            marked(70, Transition.MARKED_TRUE, 5, fan=1, onset_t_ns=35),
        ]
    )
    assert (first.feedback, first.feedback_by, first.feedback_reason) == (Feedback.FALSE_ALARM, "ann", "a door")
    assert (second.feedback, second.feedback_reason) == (Feedback.FALSE_ALARM, "first")
    assert (first.raised_ns, first.cleared_ns, second.raised_ns) == (10, 20, 40), "feedback is no part of an alarm"


def test_an_episode_of_two_alarms_of_which_one_was_true_is_not_learned_from() -> None:
    joined = one(
        alarm(10),
        alarm(30, onset_t_ns=25),
        alarm(40, Transition.CLEARED, onset_t_ns=25),
        marked(50, Transition.MARKED_TRUE, 5, "worn", onset_t_ns=25),
        marked(60, Transition.MARKED_FALSE, 25, "a door", onset_t_ns=25),
    )
    assert (joined.feedback, joined.feedback_reason) == (Feedback.TRUE_ALARM, "worn")

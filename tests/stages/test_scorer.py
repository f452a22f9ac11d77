"""Scorer: what it decides on the samples of a tray, what it emits, and that cuts into messages make no difference."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.schemas.blocks import cut
from fantwin.schemas.enums import Action, FanState, InvalidReason, Severity, Statistic, Transition
from fantwin.schemas.fan_names import FanNames
from fantwin.schemas.messages import Alarm, Prediction, ScorerSnapshot
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.unseen_error import UnseenError
from tests.support import scored_blocks
from tests.support.scored_blocks import (
    EPOCH_NS,
    SECOND,
    SIGMA,
    STEP,
    STEP_NS,
    TIME_CONSTANT_S,
    core_of,
    feed,
    noise_of,
    prediction_of,
    request_of,
    with_step,
)
from tests.support.uncertainty_tables import by_speed

NORMAL, SUSPECT, ALARM, RETURNING = FanState.NORMAL, FanState.SUSPECT, FanState.ALARM, FanState.RETURNING


learned = partial(scored_blocks.learned, seconds=10.0)


def samples(t_ns: int) -> int:
    return (t_ns - EPOCH_NS) // STEP_NS


def transitions(alarms: Iterable[Alarm]) -> list[Transition]:
    return [alarm.transition for alarm in alarms if alarm.transition != Transition.DIAGNOSED]


# alarms


def test_an_alarm_says_when_its_fault_began_what_it_takes_and_how_large_it_is_in_the_unit_of_the_tray() -> None:
    core = learned(unit="rpm")
    (score,), alarms = feed(core, [prediction_of(with_step(5.0, 2.0))])
    raised, *later = alarms
    assert (raised.transition, raised.statistic) == (Transition.RAISED, Statistic.DEVIATION)
    assert (raised.active, raised.fan, raised.acknowledged) == (True, 0, False)
    assert abs(samples(raised.onset_t_ns) - 200) <= 40
    assert samples(raised.t_ns) <= 300
    found = alarms[-1]
    assert found.residual_rad_s == pytest.approx(STEP, abs=4.0 * found.residual_std_rad_s)
    assert 0.0 < found.residual_std_rad_s < 0.3 * abs(STEP)
    shown = -raised.residual_rad_s * 60.0 / (2.0 * np.pi)
    assert raised.message.startswith(f"fan 0: {shown:.0f} rpm slower than when healthy (± ")
    assert {each.transition for each in later} <= {Transition.SEVERITY, Transition.DIAGNOSED}
    assert later[-1].severity == Severity.ALARM
    assert (score.state[:190, 0] != ALARM).all() and score.state[-1, 0] in (ALARM, RETURNING)


def test_each_message_begins_with_the_name_of_its_fan_and_carries_it_also_after_the_fan_got_another_one() -> None:
    core = learned(2, names=FanNames(("CPU", "rear top")))
    asked = [request_of(Action.ACKNOWLEDGE, fan=1), request_of(Action.UNSHELVE, fan=0, sequence=1)]
    _, alarms = feed(core, [prediction_of(with_step(5.0, 2.0, fans=2, fan=1)), *asked])
    assert {each.transition for each in alarms} >= {Transition.RAISED, Transition.ACKNOWLEDGED, Transition.REFUSED}
    for each in alarms:
        assert each.fan_name == each.label.partition(" (")[0] == ("CPU", "rear top")[each.fan]
        assert each.message == f"{each.label}: {each.about}" and not each.about.startswith(("fan", each.fan_name))
    silent = prediction_of(np.zeros((11 * SECOND, 2)), np.zeros((11 * SECOND, 2), np.bool_), first=500)
    core.step(silent)
    assert core.problem().startswith("CPU (fan 0), rear top (fan 1) are not scored: ")
    renamed = core_of(2, names=FanNames(("CPU", "front")))
    republished = [each for each in renamed.restore(scored_blocks.snapshot_of(core)) if isinstance(each, Alarm)]
    assert [each.message for each in republished] == ["front (fan 1): the alarm continues from before the restart"]


def test_before_an_alarm_the_score_is_at_most_one_and_a_fan_is_suspect_above_a_half() -> None:
    core = learned(4)
    residual = noise_of(9 * SECOND, 4)
    residual -= np.array([0.0, 1.2, 1.8, 2.4]) * np.arange(9 * SECOND)[:, np.newaxis] / SECOND
    (score,), alarms = feed(core, [prediction_of(residual)])
    is_before = ~np.isin(score.state, (ALARM, RETURNING))
    assert (score.score[is_before] <= 1.0).all()
    np.testing.assert_array_equal(score.state[is_before] == SUSPECT, score.score[is_before] > 0.5)
    assert {int(state) for state in score.state[is_before]} == {NORMAL, SUSPECT}
    assert (score.score[score.state == ALARM] >= 1.0).all()
    assert {alarm.fan for alarm in alarms} == {1, 2, 3}
    assert "SUSPECT" in {FanState(int(state)).name for state in score.state[:, 3]}, "it is said beforehand"


def test_an_alarm_clears_once_when_the_fan_has_been_healthy_for_ten_seconds() -> None:
    core = learned()
    residual = with_step(16.5, 1.0, size=1.5 * STEP)
    residual[3 * SECOND :, 0] -= 1.5 * STEP
    (score,), alarms = feed(core, [prediction_of(residual)])
    changes = [each for each in transitions(alarms) if each != Transition.SEVERITY]
    assert changes == [Transition.RAISED, Transition.CLEARED]
    cleared = next(alarm for alarm in alarms if alarm.transition == Transition.CLEARED)
    assert 13.0 <= samples(cleared.t_ns) / SECOND < 16.0
    assert cleared.onset_t_ns == alarms[0].onset_t_ns
    assert cleared.message == "fan 0: back to normal"
    assert (score.state[7 * SECOND : 13 * SECOND, 0] == RETURNING).all() and score.state[-1, 0] == NORMAL


def test_samples_that_are_not_valid_change_nothing_and_the_alarm_becomes_stale_until_there_are_new_ones() -> None:
    core = learned()
    feed(core, [prediction_of(with_step(2.5, 1.0))])
    nothing = prediction_of(np.zeros(12 * SECOND), np.zeros(12 * SECOND, np.bool_), first=250)
    (score,), alarms = feed(core, [nothing])
    assert (score.state == FanState.UNKNOWN).all() and (score.invalid_reason == InvalidReason.GAP).all()
    assert np.isnan(score.score).all()
    assert transitions(alarms) == [Transition.DATA_LOST]
    assert alarms[0].active and alarms[0].stale
    residual = noise_of(SECOND, seed=3) + STEP
    _, alarms = feed(core, [prediction_of(residual, first=250 + 12 * SECOND)])
    assert transitions(alarms) == [Transition.DATA_RESTORED]
    assert not alarms[0].stale


def test_fans_do_not_affect_one_another() -> None:
    made = []
    for size in (0.0, STEP):
        core = learned(3)
        (score,), alarms = feed(core, [prediction_of(with_step(3.5, 1.0, fans=3, fan=2, size=size))])
        made.append((score, {alarm.fan for alarm in alarms}))
    (healthy, none), (beside, faulty) = made
    assert (none, faulty) == (set(), {2})
    for name in ("score", "state", "expected_residual_rad_s"):
        np.testing.assert_array_equal(getattr(beside, name)[:, :2], getattr(healthy, name)[:, :2])


@pytest.mark.parametrize(
    ("fans", "faulty", "said"),
    [
        (4, (1, 2, 3, 4), [0, 0, 2, 3]),
        (4, (1, 2, -3), [0, 0, 0]),
        (6, (1, 2, 3, 4), [0, 0, 0, 3]),
    ],
)
def test_an_alarm_says_when_most_fans_of_the_tray_have_similar_ones(
    fans: int, faulty: tuple[int, ...], said: list[int]
) -> None:
    core = learned(fans)
    residual = noise_of(round(5.5 * SECOND), fans)
    for number, fan in enumerate(faulty):
        since_s = np.arange(len(residual)) / SECOND - (1 + number)
        residual[:, abs(fan) - 1] += math.copysign(STEP, -fan) * -np.expm1(-since_s.clip(0.0) / TIME_CONSTANT_S)
    _, alarms = feed(core, [prediction_of(residual)])
    raised = [alarm.message for alarm in alarms if alarm.transition == Transition.RAISED]
    words = "; {} other fans of the tray have the same: see what they share (supply, air)"
    assert [next((n for n in (2, 3) if words.format(n) in each), 0) for each in raised] == said


@pytest.mark.parametrize(("rate_hz", "within_s"), [(1, 3.0), (10, 1.0), (400, 1.0)])
def test_at_any_rate_of_the_grid_a_healthy_fan_raises_nothing_and_a_step_of_ten_per_cent_is_an_alarm(
    rate_hz: int, within_s: float
) -> None:
    core = core_of(fans=2)
    residual = noise_of(33 * rate_hz, 2)
    residual[30 * rate_hz :] += STEP
    _, alarms = feed(core, [prediction_of(residual, period_ns=NS_PER_S // rate_hz)])
    raised_s = [(alarm.t_ns - EPOCH_NS) / NS_PER_S - 30.0 for alarm in alarms if alarm.transition == Transition.RAISED]
    assert len(raised_s) == 2
    assert 0.0 < min(raised_s) <= max(raised_s) <= within_s


def test_a_fault_that_a_speed_loop_hides_is_found_in_the_torque_balance_while_the_free_run_is_not_known() -> None:
    core = learned()
    extra = np.where(np.arange(4 * SECOND) < SECOND, 0.0, 6.0) + 0.1 * noise_of(4 * SECOND)[:, 0]
    young = prediction_of(noise_of(4 * SECOND), balance=extra)
    young.valid[:] = False
    young.invalid_reason[:] = InvalidReason.WARMING_UP
    (score,), alarms = feed(core, [young])
    raised = alarms[0]
    assert (raised.transition, raised.statistic) == (Transition.RAISED, Statistic.DEVIATION)
    assert SECOND <= samples(raised.t_ns) < 3 * SECOND
    assert raised.torque_balance_command == pytest.approx(6.0, abs=3.0 * raised.torque_balance_std_command)
    assert 0.0 < raised.torque_balance_std_command < 2.0 and raised.residual_rad_s == 0.0
    assert "takes " in raised.message and " % more than when healthy (± " in raised.message
    assert score.valid.all()


def test_a_tacho_that_gives_no_readings_is_found_and_a_silent_line_is_none() -> None:
    nothing = np.zeros(4 * SECOND, np.bool_)
    dead = prediction_of(np.zeros(4 * SECOND), nothing)
    dead.invalid_reason[:] = InvalidReason.NO_SPEED
    _, alarms = feed(learned(), [dead])
    assert alarms[0].statistic == Statistic.MISSING_READINGS
    assert alarms[0].message.startswith("fan 0: the tacho loses readings; a tacho that drops out")
    _, alarms = feed(learned(), [prediction_of(np.zeros(4 * SECOND), nothing)])
    assert alarms == []


# requests


def acknowledged(core: ScorerCore, **more: Any) -> list[Any]:
    return [m for m in core.step(request_of(Action.ACKNOWLEDGE, **more)) if not isinstance(m, ScorerSnapshot)]


def test_an_answer_names_its_request_and_the_sample_after_which_it_was_given() -> None:
    core = learned()
    feed(core, [prediction_of(with_step(2.0, 1.0))])
    (answer,) = acknowledged(core, producer="operator-7", sequence=3, comment="seen")
    assert (answer.transition, answer.acknowledged, answer.active) == (Transition.ACKNOWLEDGED, True, True)
    assert (answer.request, answer.operator_name, answer.comment) == ("operator-7/3", "Ann", "seen")
    assert samples(answer.t_ns) == 199
    (again,) = acknowledged(core, producer="operator-8")
    assert again.transition == Transition.REFUSED
    assert again.message == "fan 0: refused: it is acknowledged already"
    assert core.counters()["requests"] == 2
    (early,) = acknowledged(core_of())
    assert (early.transition, early.t_ns) == (Transition.REFUSED, 0), "before any sample"


def test_commissioning_forgets_the_fan_that_it_is_asked_for_and_ends_its_alarm() -> None:
    core = learned(2)
    both = noise_of(2 * SECOND, 2) + 0.6 * STEP
    _, alarms = feed(core, [prediction_of(both)])
    assert transitions(alarms) == [Transition.RAISED] * 2
    _, (answer,) = feed(core, [request_of(Action.COMMISSION, fan=1)])
    assert (answer.fan, answer.transition) == (1, Transition.COMMISSIONING)
    (score,), alarms = feed(core, [prediction_of(noise_of(4 * SECOND, 2, seed=2) + 0.6 * STEP, first=2 * SECOND)])
    assert [(alarm.fan, alarm.transition) for alarm in alarms if alarm.transition != Transition.DIAGNOSED] == [
        (1, Transition.CLEARED)
    ]
    assert samples(alarms[0].t_ns) <= 2 * SECOND + 10
    assert score.expected_residual_rad_s[-1, 1] == pytest.approx(0.6 * STEP, abs=6.0)
    assert abs(score.expected_residual_rad_s[-1, 0]) < 6.0


def parts(whole: Prediction, marks: Iterable[int]) -> list[Prediction]:
    return [cut(whole, *part) for part in pairwise(marks)]


# other output


def test_a_score_carries_all_that_a_viewer_draws_and_a_prediction_that_is_no_number_has_none() -> None:
    prediction = prediction_of(np.array([0.0, 7.9, 8.1, -8.1, 0.0]))
    prediction.predicted_speed_rad_s[4] = prediction.torque_balance_command[4] = np.nan
    (score,), _ = feed(learned(), [prediction])
    np.testing.assert_allclose(score.lower_bound_rad_s[:4], 300 - 8.0)
    np.testing.assert_allclose(score.upper_bound_rad_s[:4], 300 + 8.0)
    np.testing.assert_allclose(score.band_variance, 64.0)
    np.testing.assert_allclose(score.residual_rad_s[:4, 0], [0.0, 7.9, 8.1, -8.1])
    assert score.outside[:, 0].tolist() == [False, False, True, True, False]
    assert score.valid[:, 0].tolist() == [True] * 4 + [False]
    assert score.state[4, 0] == FanState.UNKNOWN


def test_an_alarm_has_the_time_of_the_sample_that_raised_it_also_where_a_second_has_one_sample() -> None:
    residual = np.where(np.arange(60)[:, np.newaxis] < 30, 0.0, -150.0)
    core, blocks = learned(), parts(prediction_of(residual, period_ns=NS_PER_S), range(61))
    found = ((block, feed(core, [block])[1]) for block in blocks)
    block, raised = next((block, alarms) for block, alarms in found if alarms)
    assert [each.t_ns for each in raised] == block.t_ns.tolist()


def test_repeated_samples_are_dropped_and_counted() -> None:
    residual = with_step(4.0, 1.0)
    core = learned()
    _, alarms = feed(core, [prediction_of(residual[:300]), prediction_of(residual[:300]), prediction_of(residual)])
    _, once = feed(learned(), [prediction_of(residual)])
    assert [alarm.t_ns for alarm in alarms] == [alarm.t_ns for alarm in once] != []
    assert core.counters()["repeated"] == 600


def test_row_13_predictions_that_have_gone_back_for_good_are_reported_until_there_are_new_ones() -> None:
    core = learned()
    feed(core, [prediction_of(np.zeros(500), first=-360_000)])
    assert core.problem() == "", "a producer that was restarted catches up"
    feed(core, [prediction_of(np.zeros(500), first=-359_500)])
    assert core.problem().startswith("predictions are 3590 s older than those before and not judged")
    feed(core, [prediction_of(np.zeros(10))])
    assert core.problem() == ""


def test_another_number_of_fans_is_lost_and_reported_until_the_right_one_comes() -> None:
    core = core_of(fans=2)
    assert core.step(prediction_of(np.zeros((5, 3)))) == []
    assert core.counters()["lost_wrong_fan_count"] == 5
    assert core.problem() == "predictions of 3 fans, [[tray]] says fans = 2: correct one of them"
    feed(core, [prediction_of(np.zeros((1, 2)))])
    assert core.problem() == ""


def unjudged(seconds: float, why: Sequence[InvalidReason], first_s: float = 0.0) -> Prediction:
    """Fans that are judged where `why` is NONE, five samples a second."""
    valid = np.tile([reason == InvalidReason.NONE for reason in why], (round(seconds * 5), 1))
    prediction = prediction_of(np.zeros(valid.shape), valid, first=round(first_s * 5), period_ns=NS_PER_S // 5)
    prediction.invalid_reason[:] = np.array(why, np.uint8)
    return prediction


def test_fans_long_without_a_score_are_reported_with_the_reason_and_a_first_warm_up_after_a_minute() -> None:
    core = core_of(fans=4)
    why = [InvalidReason.NONE, InvalidReason.NO_SPEED, InvalidReason.OUT_OF_RANGE, InvalidReason.NO_SPEED]
    feed(core, [unjudged(1, [InvalidReason.NONE] * 4, first_s=-1), unjudged(9.8, why)])
    assert core.problem() == ""
    feed(core, [unjudged(0.2, why, first_s=9.8)])
    assert core.problem() == (
        "fan 2 is not scored: the command is outside the twin's range, or a value is not a number, for 10 s or more; "
        "fans 1, 3 are not scored: no speed, for 10 s or more"
    )
    feed(core, [unjudged(0.2, [InvalidReason.NONE] * 4, first_s=10)])
    assert core.problem() == ""
    feed(core, [unjudged(1, [InvalidReason.WARMING_UP] * 4, first_s=1000)])
    assert core.problem() == "", "a silent line does not count"
    core = core_of()
    feed(core, [unjudged(59.8, [InvalidReason.WARMING_UP])])
    assert core.problem() == ""
    feed(core, [unjudged(0.2, [InvalidReason.WARMING_UP], first_s=59.8)])
    assert "fan 0 is not scored: the twin is warming up" in core.problem()


def test_the_unseen_error_of_a_twin_widens_the_band_and_what_a_fan_may_do_there() -> None:
    table = by_speed((0.0, 600.0), (0.0, 100.0), ((20.0, 20.0), (20.0, 20.0)), 0.0)
    everywhere = UnseenError(table, None, np.array([0.05]), np.array([0.0002]))
    raised = []
    for unseen, std in ((None, 0.0), (everywhere, 20.0)):
        moves = prediction_of(noise_of(6 * SECOND))
        speeds_up = np.clip(np.arange(6 * SECOND) - 2.0 * SECOND, 0.0, SECOND)[:, np.newaxis]
        moves.predicted_speed_rad_s[:] += 0.6 * speeds_up
        moves.measured_speed_rad_s[:] += 0.4 * speeds_up
        scores, alarms = feed(learned(unseen_error=unseen), [moves])
        half_rad_s = (scores[0].upper_bound_rad_s - scores[0].lower_bound_rad_s) / 2.0
        np.testing.assert_allclose(half_rad_s, 2.0 * np.hypot(SIGMA, std))
        raised.append(Transition.RAISED in transitions(alarms))
    assert raised == [True, False]

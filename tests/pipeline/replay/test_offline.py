"""Offline replay: the same decisions, whatever was killed; and a difference is detected.

On the machine that made a recording, the same operations run on the same samples: there the numbers are equal to the
bit as well.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.records import Attachment

from fantwin.pipeline.recordings.metadata import CONFIGURATION
from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.pipeline.recordings.records import RecordReader
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.pipeline.replay.offline.rescoring import rescore
from fantwin.schemas.blocks import join
from fantwin.schemas.enums import Action, FanState, Severity, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S
from tests.support.killed_site import CHAIN, Site
from tests.support.offline_replay import alarms_of, changed, made_equal, recorded, verified, without
from tests.support.twin_files import write_twin


def test_requests_of_operators_are_replayed_at_the_same_samples(tmp_path):
    site = Site(tmp_path, 1, raw_samples=4, calibrated=True)
    site.run(210)
    site.ask(Action.ACKNOWLEDGE, 0)
    site.ask(Action.SHELVE, 0, duration_s=1.0)
    site.run(30)
    site.ask(Action.COMMISSION, 1)
    site.run(400)
    path = site.finished()
    transitions = {alarm.transition for alarm in alarms_of(path)}
    wanted = {Transition.RAISED, Transition.ACKNOWLEDGED, Transition.SHELVED, Transition.UNSHELVED}
    assert {*wanted, Transition.COMMISSIONING} <= transitions
    tray = verified(path)
    assert made_equal(tray) > 550
    assert tray.comparison and tray.comparison.counts["alarms_equal"] == len(alarms_of(path))
    unasked = verified(without(path, lambda entry: entry.topic == "request")).comparison
    assert unasked and not unasked.is_equal, "the requests are what made the difference"


def test_a_site_that_was_presented_by_a_replay_began_without_its_snapshot_and_so_does_a_replay_of_that(tmp_path):
    live = Site(tmp_path, seed=3, raw_samples=4)
    live.kill("twin_integrator")  # its successor has another name than the first of the next site
    live.run(400)
    live.finished()
    site = Site(tmp_path, seed=4, raw_samples=4, is_replayed=True)
    site.run(300)
    path = site.finished()
    restored, scores = recorded(path, "snapshot")[0], recorded(path, "score")
    assert restored.restored
    assert scores[-1].t_ns[-1] < restored.t_ns, "all its samples are from before that snapshot"
    assert made_equal(verified(path)) == sum(len(score.t_ns) for score in scores) > 250


def test_with_another_setting_a_session_continues_from_the_replayed_state_of_the_one_before(scorer_killed):
    with open_replay_input([scorer_killed], None, ("scorer.alarm_share=9.0",), None) as replay_input:
        (tray,) = rescore(replay_input, None, verify=False)
    for alarms, severity in ((tray.recorded_alarms, Severity.ALARM), (tray.alarms, Severity.WARNING)):
        (republished,) = [alarm for alarm in alarms if alarm.transition == Transition.REPUBLISHED and alarm.active]
        assert republished.severity == severity
    assert tray.counts["snapshots_of_another_twin"] == 0


def test_an_alarm_that_was_never_raised_is_found(undisturbed):
    first = next(alarm for alarm in recorded(undisturbed, "alarm") if isinstance(alarm, Alarm))
    path = without(undisturbed, lambda entry: entry.topic == "alarm" and entry.message.header.sequence == 0)
    found = verified(path).comparison
    assert found and not found.is_equal and found.counts["alarms_different"] == 1
    assert first.message in found.named[0] and "none recorded" in found.named[0]


def test_scores_that_no_stage_made_are_found(short, tmp_path):

    def later(entry):
        if entry.topic != "score" or entry.message.header.sequence != 40:
            return entry.message
        return replace(entry.message, t_ns=entry.message.t_ns + np.array([0, 1, 0, 0]))

    found = verified(changed(short, tmp_path / "later.mcap", later)).comparison
    assert found and found.counts["samples_not_made"] == 1 and found.counts["samples_not_recorded"] == 1


def test_the_overview_has_every_second_also_where_the_scorer_was_killed_and_a_replay_makes_it_again(
    scorer_killed, tmp_path
):
    score, overview = (
        join([replace(each, header=Header()) for each in found])
        for found in [recorded(scorer_killed, "score"), recorded(scorer_killed, "overview")]
    )
    residual = np.where(score.valid, score.residual_rad_s, np.nan)
    seconds = np.unique(score.t_ns // NS_PER_S)
    assert len(seconds) == 4 and len({each.header.producer for each in recorded(scorer_killed, "overview")}) == 2
    for second in seconds:
        samples, rows = score.t_ns // NS_PER_S == second, overview.t_ns // NS_PER_S == second
        for extreme, values in (
            (np.fmin.reduce, overview.lowest_residual_rad_s),
            (np.fmax.reduce, overview.highest_residual_rad_s),
        ):
            assert np.allclose(extreme(residual[samples]), extreme(values[rows]), 1e-6, 1e-4, equal_nan=True)
    with open_replay_input([scorer_killed], None, (), None) as replay_input:
        rescore(replay_input, tmp_path / "whole.mcap", verify=True)
    whole = join([replace(each, header=Header()) for each in recorded(tmp_path / "whole.mcap", "overview")])
    assert np.isin(seconds, whole.t_ns // NS_PER_S).all()

    def higher(entry):
        if entry.topic != "overview" or entry.message.header.sequence != 1:
            return entry.message
        return replace(entry.message, highest_score=entry.message.highest_score * 1.001)

    assert made_equal(verified(scorer_killed))
    found = verified(changed(scorer_killed, tmp_path / "higher.mcap", higher)).comparison
    assert found and not found.is_equal and found.counts["others_different"] and "highest_score" in found.named[0]


def test_parts_that_overlap_are_one_recording(tmp_path):
    site = Site(tmp_path, seed=9, raw_samples=4)
    site.run(200)
    site.kill("scorer")
    site.run(200)
    path = site.finished()
    first = without(path, lambda entry: entry.message.header.sequence >= 55)
    second = without(path, lambda entry: entry.message.header.sequence < 45)
    assert made_equal(verified(first, second)) >= 399


DATA = Path(__file__).parents[2] / "support" / "data"


@pytest.mark.parametrize("damaged", ["content", "length"])
def test_a_damaged_configuration_is_not_silently_replaced_by_defaults(tmp_path, damaged):
    (configuration,) = (
        record
        for record in RecordReader(DATA / "golden.mcap")
        if isinstance(record.parsed, Attachment) and record.parsed.name == CONFIGURATION
    )
    content = bytearray((DATA / "golden.mcap").read_bytes())
    content[configuration.offset + 8 if damaged == "length" else configuration.end - 50] ^= 0x40
    path = tmp_path / "r.mcap"
    path.write_bytes(content)
    twin = write_twin(tmp_path / "twin.onnx", fans=2)
    with (
        pytest.raises(RecordingError, match="its configuration is missing, and may be damaged: name one with -c"),
        open_replay_input([path], None, (), twin),
    ):
        pass


def test_the_golden_recording_is_decided_as_it_was():
    tray = verified(DATA / "golden.mcap")
    assert tray.plan.restarts == 2, "two stages were killed while it was made"
    assert made_equal(tray, share=1.0) > 400, "it was made on another processor"
    assert tray.comparison and tray.comparison.counts["alarms_equal"] >= 2


def test_a_recorded_snapshot_is_restored_and_its_replay_is_equal():
    """An active alarm was acknowledged, a fan shelved and another one out of service in golden-restart.mcap when their
    scorer was killed and restored from its snapshot."""
    tray = verified(DATA / "golden-restart.mcap")
    assert [session.snapshot is not None for session in tray.plan.last] == [False, True] and tray.plan.restarts == 1
    assert made_equal(tray, share=1.0) > 250
    assert tray.comparison and tray.comparison.counts["alarms_equal"] == 7
    restored = [alarm for alarm in tray.alarms if alarm.transition == Transition.REPUBLISHED]
    operators = {
        alarm.fan: (alarm.acknowledged, alarm.shelved_until_t_ns > 0, alarm.out_of_service) for alarm in restored
    }
    assert operators == {0: (True, False, False), 1: (True, True, False), 2: (True, False, True)}
    assert not tray.counts["snapshots_of_another_twin"] and not tray.counts["snapshots_not_understood"]


def test_row_13_after_a_step_of_the_clock_the_samples_that_are_counted_are_those_that_are_compared(tmp_path):
    site = Site(tmp_path, seed=3)
    site.run(100)
    site.now_ns -= 3600 * 10**9
    site.run(220)  # more than are kept and consumed again: all of these are of the new time
    for stage in CHAIN:
        site.kill(stage)
    site.run(100)
    tray = verified(site.finished())
    found = tray.comparison
    assert found and found.counts["samples_different"] == found.counts["samples_not_made"] == 0
    assert (
        tray.samples == found.counts["samples_equal"] == sum(len(score.t_ns) for score in recorded(site.path, "score"))
    )
    assert tray.lost == 0


def test_row_13_alarms_stand_where_the_clock_of_the_stages_before_was_set_back_and_a_replay_decides_the_same(tmp_path):
    site = Site(tmp_path, seed=1, raw_samples=4, calibrated=True)
    site.run(200)
    site.restart_source()
    for stage in CHAIN:
        site.kill(stage)
    site.set_clock_back(3600)  # after the scorer has started, on another host
    site.now_ns += NS_PER_S // 10
    site.tick()
    site.run(50)
    found = verified(site.finished()).comparison
    alarms = alarms_of(site.path)
    last = {alarm.fan: alarm for alarm in alarms}
    assert last and all(alarm.active for alarm in last.values())
    assert found and found.is_equal, found
    judged = [alarm for alarm in alarms if alarm.transition != Transition.REPUBLISHED]
    assert found.counts["alarms_equal"] == len(judged) > 0, (
        "its successor has judged nothing, so there is nothing to replay"
    )


@pytest.mark.parametrize("set_back_s", [2, 3600])
def test_row_13_a_site_restarted_after_its_clock_was_set_back_goes_on_with_what_it_learned_and_its_alarms(
    tmp_path, set_back_s
):
    site = Site(tmp_path, seed=1, raw_samples=4, calibrated=True)
    site.run(200)
    site.set_clock_back(set_back_s)
    site.restart_source()
    for stage in CHAIN:
        site.kill(stage)
    core = site.stages["scorer"].core
    assert core
    site.tick()
    site.run(110)
    assert f"the snapshot is {set_back_s} s ahead of the samples" in core.problem()
    site.run(80)
    tray = verified(site.finished())
    before, after = [
        [s for s in recorded(site.path, "score") if s.header.producer == p.producer] for p in tray.plan.last
    ]
    assert after[0].t_ns[0] < before[-1].t_ns[-1], "it is judged at once"
    states = np.concatenate([score.state for score in after])
    assert not (states[:100, 0] == FanState.NORMAL).any()
    raised, republished, *_ = alarms_of(site.path)
    assert (raised.transition, republished.transition) == (Transition.RAISED, Transition.REPUBLISHED)
    assert republished.active and republished.onset_t_ns < site.now_ns
    assert made_equal(tray) == sum(len(score.t_ns) for score in recorded(site.path, "score"))
    assert tray.comparison and tray.comparison.counts["alarms_equal"] == len(alarms_of(site.path))

"""Offline replay of recordings that lack something: what is there is compared, and what is missing is named."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.pipeline.replay.offline.comparison import CannotCompareError
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.pipeline.replay.offline.rescoring import rescore
from tests.support.killed_site import Site
from tests.support.offline_replay import changed, made_equal, recorded, verified, verified_in_part, without


def test_row_14_a_session_cannot_be_reproduced_without_the_snapshot_it_began_with(scorer_killed):
    found = verified_in_part(without(scorer_killed, lambda entry: entry.topic == "snapshot"))
    assert found.counts["samples_equal"] >= 211
    (reason,) = found.reasons
    assert re.fullmatch("tray1: the first messages of scorer-.* were not recorded", reason)


def test_row_14_scores_before_raw_messages_that_the_recorder_never_got_are_compared(tmp_path):
    site = Site(tmp_path, seed=3, raw_samples=4)
    site.run(148)
    site.records = False
    site.run(12)
    site.records = True
    site.run(150)
    found = verified_in_part(site.finished())
    assert found.counts["samples_equal"] >= 147
    (reason,) = found.reasons
    assert re.fullmatch("tray1: after .*Z: the recording lacks 3 raw messages that were scored", reason)


def test_row_14_scores_before_raw_messages_that_are_missing_at_the_end_are_compared(short):
    path = without(short, lambda entry: entry.topic == "raw" and entry.message.header.sequence >= 70)
    found = verified_in_part(path)
    assert found.counts["samples_equal"] >= 275
    assert "lacks 5 raw messages" in found.reasons[0]


def test_row_14_the_last_raw_message_of_a_killed_acquisition_may_have_reached_the_resampler_only(tmp_path):
    site = Site(tmp_path, seed=4, raw_samples=4)
    site.run(150)
    killed, last = site.source.producer, site.source.published["raw"] - 1
    site.restart_source()
    site.kill("resampler")
    site.run(100)

    def is_last(entry):
        header = entry.message.header
        return entry.topic == "raw" and (header.producer, header.sequence) == (killed, last)

    found = verified_in_part(without(site.finished(), is_last))
    assert found.counts["samples_equal"] >= 140
    assert found.counts["samples_not_comparable"]
    assert "lacks 1 raw messages" in found.reasons[0]


@pytest.mark.parametrize("stage", ["resampler", "scorer"])
def test_row_14_a_session_that_fell_into_a_pause_of_the_recorder_leaves_the_rest_comparable(tmp_path, stage):
    site = Site(tmp_path, seed=4, raw_samples=4)
    site.run(150)
    site.records = False
    site.run(20)
    site.kill(stage)  # the session that follows is recorded nowhere
    site.run(20)
    site.kill(stage)
    site.run(5)
    site.records = True
    site.run(100)
    found = verified_in_part(site.finished())
    assert found.counts["samples_equal"] >= 140
    assert found.counts["samples_not_comparable"] >= 90
    assert found.reasons


@pytest.mark.parametrize("stage", ["resampler", "scorer"])
def test_row_14_a_session_without_any_recorded_output_leaves_the_rest_comparable(tmp_path, stage):
    site = Site(tmp_path, seed=4, raw_samples=4)
    site.run(150)
    site.kill(stage)
    producer = site.stages[stage].producer
    site.run(20)
    site.kill(stage)
    site.run(100)
    found = verified(without(site.finished(), lambda entry: entry.message.header.producer == producer)).comparison
    assert found and found.is_equal and found.counts["samples_equal"] >= 140, found
    assert bool(found.counts["samples_not_comparable"]) == bool(found.reasons)


@pytest.mark.parametrize(
    ("is_there", "error", "why"),
    [
        (lambda entry: entry.topic != "raw", RecordingError, "no raw samples"),
        (lambda entry: entry.topic == "raw", CannotCompareError, "nothing to compare with"),
        (
            lambda entry: entry.topic != "raw" or entry.message.header.sequence >= 10,
            CannotCompareError,
            "lacks 10 raw messages",
        ),
        (lambda entry: entry.message.header.sequence >= 40, CannotCompareError, "the parts before it"),
    ],
    ids=["no raw", "raw alone", "row 14: not the first raw", "from the middle"],
)
def test_a_recording_of_which_nothing_can_be_compared_says_why(short, is_there, error, why):
    with pytest.raises(error, match=why):
        verified(without(short, lambda entry: not is_there(entry)))


def test_messages_of_a_killed_stage_that_the_recorder_never_got_are_made_again(tmp_path):
    site = Site(tmp_path, seed=4, raw_samples=4)
    site.run(150)
    integrator = site.stages["twin_integrator"].producer
    sent = site.stages["twin_integrator"].published["prediction"]
    site.kill("twin_integrator")
    site.run(150)

    def is_lost(entry):
        header = entry.message.header
        return entry.topic == "prediction" and header.producer == integrator and header.sequence >= sent - 3

    path = without(site.finished(), is_lost)
    assert made_equal(verified(path)) == sum(len(score.t_ns) for score in recorded(path, "score"))


def test_an_alarm_after_the_last_recorded_score_is_no_difference(undisturbed):
    raised = recorded(undisturbed, "alarm")[0]

    def is_later(entry):
        is_made = entry.topic in ("grid", "prediction", "score")
        return entry.message.t_ns[-1] > raised.t_ns if is_made else entry.topic == "alarm"

    found = verified(without(undisturbed, is_later)).comparison
    assert found and found.is_equal
    assert found.counts["alarms_not_recorded"] > 0 and found.counts["samples_not_recorded"] > 0


def test_grids_of_a_session_that_are_nowhere_leave_nothing_to_compare(short):
    no_grid = without(short, lambda entry: entry.topic == "grid")
    with pytest.raises(CannotCompareError, match="nothing to compare with"):
        verified(no_grid)
    with open_replay_input([no_grid], None, (), None) as replay_input:
        (tray,) = rescore(replay_input, None, verify=False)
    assert tray.scored > 200


def test_samples_that_never_reached_a_resampler_before_its_first_output_are_no_difference(tmp_path):
    site = Site(tmp_path, seed=5, raw_samples=4)
    site.run(150)
    site.restart_source()
    site.kill("resampler")
    site.run(5)  # it does not know the rate of its line yet
    site.loses(3)
    site.run(150)
    (reason,) = verified_in_part(site.finished()).reasons
    assert "raw messages never reached resampler" in reason


def test_an_undecodable_alarm_costs_that_alarm_only(undisturbed):
    alarms = recorded(undisturbed, "alarm")
    with open_replay_input([undisturbed], None, (), None) as replay_input:
        envelopes = list(replay_input.envelopes("tray1", ("grid", "prediction", "score", "alarm")))
        first = next(n for n, envelope in enumerate(envelopes) if envelope.topic == "alarm")
        envelopes[first] = replace(envelopes[first], payload=b"\xff\xff")
        replay_input.envelopes = lambda tray, topics: iter(envelopes)  # type: ignore[method-assign]
        _, found, why_not_verified = replay_input.read_plan("tray1")
    assert not why_not_verified and len(found) == len(alarms) - 1
    assert "cannot be decoded: 1" in next(iter(replay_input.damage.values()))


@pytest.mark.parametrize("topic", ["grid", "prediction"])
def test_a_recording_that_lacks_intermediate_messages_is_still_compared(integrator_killed, tmp_path, topic):
    holes = changed(
        integrator_killed,
        tmp_path / "holes.mcap",
        lambda entry: None if entry.topic == topic and 20 <= entry.message.header.sequence < 23 else entry.message,
    )
    assert made_equal(verified(holes)) > 290


@pytest.mark.parametrize("recording", ["integrator_killed", "scorer_killed", "undisturbed"])
def test_a_recording_that_lacks_nothing_is_compared_to_its_end(recording, request):
    with open_replay_input([request.getfixturevalue(recording)], None, (), None) as replay_input:
        plan, _, why_not_verified = replay_input.read_plan("tray1")
    assert not why_not_verified
    assert [session.limit for sessions in plan.sessions.values() for session in sessions if session.limit] == []

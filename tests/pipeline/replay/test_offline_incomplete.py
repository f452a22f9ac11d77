"""Offline replay of recordings that lack something: it is made again where it can be, and named where not."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.pipeline.replay.offline.comparison import CannotCompareError, Comparison
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.pipeline.replay.offline.rescoring import rescore
from fantwin.schemas.enums import Action
from tests.support.killed_site import CHAIN, Site
from tests.support.offline_replay import (
    alarms_of,
    changed,
    made_equal,
    recorded,
    remade,
    verified,
    verified_in_part,
    without,
    without_topics,
)


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


MADE = ("grid", "prediction", "score")
ASKED = (Action.ACKNOWLEDGE, Action.SHELVE, Action.COMMISSION, Action.OUT_OF_SERVICE)
ANYTHING = {
    "seed": st.integers(0, 1000),
    "raw_samples": st.sampled_from([1, 4, 4]),
    "calibrated": st.booleans(),
    "remembers": st.sampled_from([True, True, False]),
    "events": st.lists(
        st.tuples(st.integers(5, 100), st.sampled_from([*CHAIN, "scorer", "acquisition", "silence", "loss", *ASKED])),
        min_size=2,
        max_size=5,
    ),
}


def random_site(
    folder: Path,
    seed: int,
    raw_samples: int,
    calibrated: bool,
    remembers: bool,
    events: Sequence[tuple[int, str | Action]],
) -> Site:
    """The site after all events, each of which comes so many samples after the one before."""
    site = Site(folder, seed, raw_samples, calibrated=calibrated, remembers=remembers)
    for samples, event in events:
        site.run(samples)
        if isinstance(event, Action):
            site.ask(event, fan=samples % 4 - 1, duration_s=float(samples % 2))
        elif event == "acquisition":
            site.restart_source()
        elif event == "silence":
            site.fall_silent(0.8)
        elif event == "loss":
            site.loses(1 + samples % 3)
        else:
            site.kill(event)
    site.run(50)
    return site


def lean(path: Path, *topics: str) -> Path:
    """The same recording, as a recorder makes it that leaves out these topics."""
    topics = topics or MADE
    return without_topics(path, path.with_name(f"without-{'-'.join(topics)}.mcap"), *topics)


def compared(path: Path) -> Comparison:
    found = verified(path).comparison
    assert found
    return found


@pytest.mark.parametrize("topics", [MADE, ("grid",)])
def test_what_was_left_out_is_made_again_to_the_bit(undisturbed, topics):
    scores = sum(len(score.t_ns) for score in recorded(undisturbed, "score"))
    again = remade(lean(undisturbed, *topics), undisturbed)
    assert again.is_equal and again.counts["samples_equal"] == scores > 550 and again.largest.share == 0.0
    assert again.counts["alarms_equal"] == len(recorded(undisturbed, "alarm")) > 0


@settings(deadline=None, max_examples=6)
@given(**ANYTHING)
def test_after_any_kills_and_requests_a_replay_decides_the_same_and_makes_again_what_was_left_out(
    tmp_path_factory, seed, raw_samples, calibrated, remembers, events
):
    site = random_site(tmp_path_factory.mktemp("site"), seed, raw_samples, calibrated, remembers, events)
    whole = site.finished()
    path = lean(whole)
    assert len(recorded(path, "consumed")) < len(recorded(whole, "score")) + 10
    has_loss = any(event == "loss" for _, event in events)
    scorer_killed = any(event == "scorer" for _, event in events)
    samples = sum(len(score.t_ns) for score in recorded(whole, "score"))
    try:
        tray = verified(whole)
        assert tray.comparison
        assert made_equal(tray) + tray.comparison.counts["samples_not_comparable"] == samples
        assert has_loss or not tray.comparison.counts["samples_not_comparable"]
        found = compared(path)
    except CannotCompareError as error:  # the loss was before the first output
        assert has_loss and "never reached resampler" in str(error)
        return
    assert found.is_equal, found
    assert has_loss or not found.reasons
    # a scorer that answered a request and was killed before its first score made nothing that can be made again
    judged = {score.header.producer for score in recorded(whole, "score")}
    snapshots = [one for one in recorded(path, "snapshot") if not one.restored and one.header.producer in judged]
    assert found.counts["snapshots_equal"] + found.counts["snapshots_not_comparable"] == len(snapshots)
    assert has_loss or found.counts["alarms_equal"] == len(alarms_of(path))
    again = remade(path, whole)
    assert not (again.counts["samples_different"] or again.counts["alarms_different"]), again
    # a scorer that was killed has not reported its last scores: its successor made them from the same samples
    assert scorer_killed or not again.counts["samples_not_made"], again
    assert (
        has_loss
        or scorer_killed
        or (again.is_equal and again.largest.share == 0.0 and again.counts["samples_equal"] == samples)
    ), again

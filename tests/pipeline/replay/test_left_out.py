"""Offline replay of recordings whose recorder left out what can be made again: it is made to the bit, and alarms and
snapshots are held against the recorded ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fantwin.pipeline.replay.offline.comparison import CannotCompareError, Comparison
from fantwin.schemas.enums import Action
from tests.support.killed_site import CHAIN, Site
from tests.support.offline_replay import (
    alarms_of,
    made_equal,
    recorded,
    remade,
    verified,
    without_topics,
)

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

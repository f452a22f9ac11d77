"""Sequence accounting: received, missing and duplicated messages of a stream add up."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fantwin.schemas.health import Input
from fantwin.schemas.streams import StreamState, stage_losses


def test_skipping_counts_published_messages_that_never_came():
    state = StreamState()
    assert state.skip_to(3) == 0, "nothing was known of the stream: this is history"
    assert state.skip_to(5) == 2
    assert state.skip_to(4) == 0
    assert (state.missing, state.next_sequence, state.first_sequence) == (2, 5, 3)


@given(st.lists(st.integers(0, 60), min_size=1))
def test_received_and_missing_add_up_to_the_numbers_from_the_first_to_the_last(sequences: list[int]):
    state = StreamState()
    accepted = [sequence for sequence in sequences if state.accept(sequence)]
    assert accepted == sorted(set(accepted))
    assert (state.first_sequence, state.next_sequence) == (accepted[0], accepted[-1] + 1)
    assert state.received == len(accepted)
    assert state.duplicated == len(sequences) - len(accepted)


def test_a_stage_that_may_drop_loses_only_what_its_loss_counters_say():
    inputs = [Input(key="k", producer="p", received=1, missing=3, duplicated=0, next_sequence=4)]
    counters = {"lost_commands": 2, "dropped": 9}
    assert stage_losses(inputs, counters, may_drop=False) == 5
    assert stage_losses(inputs, counters, may_drop=True) == 2

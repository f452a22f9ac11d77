"""The sequence ledger: every message of every producer is recorded, missing, or duplicated."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fantwin.pipeline.recordings.sequence_ledger import (
    SequenceLedger,
    StreamCounts,
    before_from_metadata,
    correct_for_damage,
    counts_from_metadata,
    ledger_metadata,
    next_sequences,
    sum_by_key,
)
from fantwin.schemas.health import Health, Output
from fantwin.schemas.topics import health_key
from tests.support import made_messages

KEY, TWIN_KEY = "fantwin/plant/tray1/raw", "fantwin/plant/tray1/twin"


def counted(sequences, before=None, key=KEY, producer="a") -> SequenceLedger:
    ledger = SequenceLedger(before)
    for sequence in sequences:
        ledger.add(key, producer, sequence, 1000 + sequence)
    return ledger


def health(producer: str, published: int, key: str = KEY) -> Health:
    return made_messages.health("acquisition", "tray1", producer, outputs=(Output(key=key, published=published),))


def test_messages_in_gaps_are_missing_and_times_are_the_first_and_the_last_also_of_a_clock_that_was_set_back():
    ledger = counted([3, 4, 8, 9])
    assert ledger.counts[KEY, "a"] == StreamCounts(4, 3, 0, 3, 9, 1003, 1009)
    ledger.add(KEY, "a", 10, 5)
    assert ledger.counts[KEY, "a"] == StreamCounts(5, 3, 0, 3, 10, 5, 1009)


def test_a_card_that_is_written_again_at_the_start_of_a_part_counts_once():
    assert counted([1, 2], before={(TWIN_KEY, "a"): 2}, key=TWIN_KEY).counts[TWIN_KEY, "a"].messages == 1


def test_every_producer_has_its_own_counts_and_every_key_the_sum():
    ledger = counted([0, 1, 4])
    ledger.add(KEY, "b", 7, 5000)
    ledger.add_duplicated(KEY, "b", 3)
    assert sum_by_key(ledger.counts.items()) == {KEY: StreamCounts(4, 2, 3, None, None, 1000, 5000)}


def test_messages_that_will_not_be_recorded_are_missing_once_a_later_one_is():
    ledger = counted([0, 1])
    for sequence in (2, 3, 2):
        ledger.add_lost(KEY, "a", sequence)
    ledger.add(KEY, "a", 5, 1)
    ledger.finish()
    assert ledger.counts[KEY, "a"].missing == 3


def test_messages_that_will_not_be_recorded_are_missing_at_the_end_if_no_later_one_came():
    ledger = counted([0, 1])
    ledger.add_lost(KEY, "a", 3)
    ledger.add_lost(KEY, "b", 7)
    assert before_from_metadata(ledger.before_as_metadata()) == {(KEY, "a"): 2, (KEY, "b"): 7}
    last = ledger.for_next_part().for_next_part()
    last.finish()
    assert ledger.counts[KEY, "a"].missing == 0
    assert {line: account.missing for line, account in last.counts.items()} == {(KEY, "a"): 2, (KEY, "b"): 1}


def test_messages_that_health_reports_as_published_and_that_never_came_are_unrecorded():
    ledger = counted([0, 1, 2])
    ledger.add_health(health("a", 3))
    assert ledger.unrecorded() == {}
    ledger.add_health(health("a", 5))
    assert ledger.unrecorded() == {(KEY, "a"): 2}
    ledger.finish()
    assert ledger.counts[KEY, "a"].missing == 2
    assert ledger.unrecorded() == {}


def test_all_messages_count_of_a_producer_that_was_known_before_its_first_one_and_only_of_it():
    ledger = SequenceLedger()
    ledger.add_health(health("a", 500))
    ledger.finish()
    assert ledger.counts == {}
    ledger = SequenceLedger()
    ledger.add_health(health("a", 0))
    ledger.add(KEY, "a", 3, 1)
    assert ledger.counts[KEY, "a"].missing == 3
    ledger = SequenceLedger()
    ledger.add_health(health("a", 0))
    ledger.add_health(health("a", 5))
    ledger.finish()
    assert ledger.counts[KEY, "a"] == StreamCounts(missing=5)


def test_topics_that_are_never_recorded_or_were_left_out_on_purpose_are_never_missing():
    ledger = SequenceLedger()
    for published in (0, 5):
        ledger.add_health(health("a", published, "fantwin/plant/tray1/clock"))
        ledger.add_health(health("a", published, "fantwin/something/else"))
    ledger.finish()
    assert ledger.counts == {}
    grid = "fantwin/plant/tray1/grid"
    ledger = SequenceLedger({(grid, "a"): 3, (KEY, "a"): 3}, left_out=("grid",))
    for published in (0, 5):
        ledger.add_health(health("b", published, grid))
    ledger.add_health(health("a", 9, grid))
    assert ledger.unrecorded() == {}
    assert ledger.next == {(KEY, "a"): 3}, "a recorder that takes it up again misses nothing of it"
    for successor in (ledger.for_next_part(), ledger.as_lost()):
        successor.add_health(health("c", 0, grid))
        successor.add_health(health("c", 5, grid))
        successor.finish()
        assert not [key for key, _ in successor.counts if key == grid]


def test_after_a_lost_part_its_messages_are_missing_and_healths_that_were_left_out_on_purpose_are_not():
    ledger, of_health = counted([0, 1]), health_key("plant", "scorer", "all")
    for sequence in (0, 50):
        ledger.add(of_health, "a", sequence, 1)
    ledger = ledger.as_lost()
    assert ledger.unrecorded() == {(KEY, "a"): 2}
    for sequence in (100, 200, 300):
        ledger.add(of_health, "a", sequence, 1)
    ledger.add(KEY, "a", 2, 1)
    ledger.finish()
    assert {key: counts.missing for (key, _), counts in ledger.counts.items()} == {of_health: 0, KEY: 2}


def test_messages_recorded_in_a_damaged_file_and_not_found_are_missing():
    recorded = counted([0, 1, 5, 6]).counts | counted([7, 8], producer="b").counts
    found = counted([5]).counts
    assert correct_for_damage(recorded, found) == {
        (KEY, "a"): StreamCounts(1, 3 + 3, 0, 5, 6, 1005, 1005),
        (KEY, "b"): StreamCounts(missing=2, last_sequence=8),
    }


@given(st.lists(st.integers(0, 30), min_size=1), st.integers(0, 30))
def test_each_number_is_recorded_or_missing_and_each_message_is_new_or_duplicated(sequences, due):
    account = counted(sequences, before={(KEY, "a"): due}).counts[KEY, "a"]
    new = account.messages - account.duplicated
    last = max(sequences)
    assert new + account.missing == max(0, last + 1 - due)
    assert account.messages == len(sequences)


@given(st.sets(st.integers(0, 40)), st.sets(st.integers(0, 40)))
def test_the_counts_of_parts_add_up_to_those_of_the_whole(first, second):
    whole = counted(sorted(first) + sorted(n + 41 for n in second))
    one = counted(sorted(first))
    other = one.for_next_part()
    for sequence in sorted(second):
        other.add(KEY, "a", sequence + 41, 1041 + sequence)
    parts = [ledger.counts.get((KEY, "a"), StreamCounts()) for ledger in (one, other)]
    total = whole.counts.get((KEY, "a"), StreamCounts())
    assert sum(part.messages for part in parts) == total.messages
    assert sum(part.missing for part in parts) == total.missing


def test_a_ledger_is_read_back_as_it_was_written_and_the_next_part_is_due_after_its_last_message():
    ledger = counted([0, 5])
    ledger.add(KEY, "b", 7, 1)
    assert counts_from_metadata(ledger_metadata(ledger.counts)) == ledger.counts
    assert before_from_metadata(ledger.before_as_metadata()) == ledger.next == {(KEY, "a"): 6, (KEY, "b"): 8}
    ledger.add_lost(KEY, "a", 6)
    ledger.finish()
    assert next_sequences({(KEY, "c"): 9}, ledger.counts) == {(KEY, "a"): 6, (KEY, "b"): 8, (KEY, "c"): 9}

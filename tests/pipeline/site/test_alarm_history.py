"""The history of alarms: shared by several outputs, on a disk that is full, and in a file that is damaged."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.mqtt.outbox import READER, TransitionQueue
from fantwin.pipeline.site import alarm_history
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.schemas.enums import Transition
from tests.support.notified_alarms import alarm


@pytest.fixture
def store(tmp_path: Path) -> AlarmHistory:
    return AlarmHistory(tmp_path / "alarms.sqlite")


def fill(store: AlarmHistory, *, is_full: bool) -> None:
    """Let the disk have no room for another page, or again enough."""
    pages = store.store._file.execute("PRAGMA page_count").fetchone()[0]
    store.store._file.execute(f"PRAGMA max_page_count = {pages if is_full else 1 << 30}")


def kept(store: AlarmHistory) -> list[int]:
    return [found.header.sequence for _, found in store.after(0, 100_000)]


def test_what_several_outputs_hear_is_kept_once_and_is_news_to_each_but_for_what_was_there_before(store, tmp_path):
    assert store.add(alarm(sequence=1))
    page, mail = (AlarmHistory(tmp_path / "alarms.sqlite") for _ in range(2))
    assert not page.add(alarm(sequence=1)), "the history had it when the page began"
    assert [each.add(alarm(sequence=2)) for each in (mail, page, mail)] == [True, True, False]
    assert kept(store) == [1, 2]
    mail.set_position("mail", mail.newest_number())
    assert (page.position("mail"), page.position("page")) == (2, None)


def test_a_forged_message_with_the_number_of_a_real_one_does_not_hide_it(store):
    forged = [alarm(Transition.CLEARED, sequence=number, active=False) for number in range(20)]
    real = alarm(sequence=5)
    assert all(map(store.add, [*forged, real]))
    assert [found.active for _, found in store.after(0, 100)] == [False] * 20 + [True]


def test_the_alarms_of_now_follow_from_the_last_occurrence_of_each_fan(store):
    over = [alarm(sequence=0), alarm(Transition.CLEARED, sequence=1, active=False)]
    again = [alarm(sequence=2, onset_s=9), alarm(Transition.ACKNOWLEDGED, sequence=3, onset_s=9, acknowledged=True)]
    for each in (*over, alarm(fan=5, sequence=4), *again, alarm(fan=5, sequence=5, onset_s=7)):
        store.add(each)
    assert [each.header.sequence for each in store.last_occurrences(5)] == [4, 2, 3]
    assert [each.header.sequence for each in store.last_occurrences(100)] == [2, 3, 5]


def test_what_a_full_disk_has_no_room_for_is_kept_in_its_order_once_there_is_room(store, monkeypatch):
    monkeypatch.setattr(alarm_history, "MOST_UNSAVED", 150)
    added = [alarm(sequence=number, comment="x" * 500) for number in range(300)]
    assert all(map(store.add, added[:50]))
    fill(store, is_full=True)
    assert all(map(store.add, added[50:250]))
    assert "disk is full" in store.problem
    assert not store.add(added[249]), "it has been heard before"
    before = kept(store)
    assert store.lost == 250 - len(before) - 150 > 0
    fill(store, is_full=False)
    store.set_position(READER, 0)
    queue = TransitionQueue(store, 10_000)
    assert store.save_again()
    assert not store.problem
    assert store.add(added[250])
    expected = [*before, *range(100, 251)]
    assert kept(store) == expected, "the oldest of those that waited are lost"
    queue.notice_new()
    assert [found.header.sequence for _, found in queue.take(1000)] == expected
    fill(store, is_full=True)
    assert all(map(store.add, added[251:290]))
    fill(store, is_full=False)
    assert store.add(added[290])
    assert kept(store) == [*expected, *range(251, 291)], "those that waited come before the one that found room"


def test_a_damaged_file_is_named_in_one_line_and_holds_up_no_alarm(store, tmp_path):
    for number in range(300):
        store.add(alarm(sequence=number))
    store.store._file.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    store.close()
    path = tmp_path / "alarms.sqlite"
    with path.open("r+b") as file:
        file.seek(4096)
        file.write(os.urandom(path.stat().st_size - 4096))
    damaged = AlarmHistory(path)
    with pytest.raises(UserError, match="move it away"):
        damaged.newest(10)
    with pytest.raises(UserError, match="move it away"):
        TransitionQueue(damaged, 100)
    assert damaged.add(alarm(sequence=1000)), "it is shown all the same"
    assert str(path) in damaged.problem
    damaged.close()
    path.write_bytes(b"no database" * 100)
    with pytest.raises(UserError, match=r"alarms\.sqlite"):
        AlarmHistory(path)


def test_a_queue_goes_on_where_its_history_cannot_be_read_for_a_while(store, monkeypatch):
    queue = TransitionQueue(store, 100)
    store.add(alarm(sequence=1))
    queue.notice_new()

    def fail(*_rest: object) -> None:
        raise UserError("it cannot be read")

    with monkeypatch.context() as patched:
        patched.setattr(store, "after", fail)
        patched.setattr(store, "newest_number", fail)
        queue.notice_new()
        assert queue.take(10) == ()
    assert [found.header.sequence for _, found in queue.take(10)] == [1]

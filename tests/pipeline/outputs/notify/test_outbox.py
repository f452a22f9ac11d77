"""The outbox: what survives, what is lost, and what a file that cannot be understood does."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.notify import outbox as module
from fantwin.pipeline.outputs.notify.deciding import Announced, Gathered, Happened, Kind, Told
from fantwin.pipeline.outputs.notify.notification_flow import Basket, Changes, Outgoing, Saved
from fantwin.pipeline.outputs.notify.outbox import Outbox
from fantwin.pipeline.outputs.notify.wording import Level, Text
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.units import NS_PER_S
from tests.support.notified_alarms import START_NS, alarm

TEXT = Text("WARNING, fan 2", "fan 2 of tray1", Level.WARNING)
FAN = Fan("tray1", 2)
ANNOUNCED = {("mail", FAN): Announced(START_NS, Told.BEGUN, START_NS, 1)}


def save(outbox: Outbox, saved: Saved, changes: Changes, *, seconds: float = 0.0) -> None:
    now_ns = START_NS + round(seconds * NS_PER_S)
    outbox.save(saved, changes, now_ns)


def texts(*targets: str) -> Changes:
    return Changes(outgoing=[Outgoing(target, TEXT, START_NS) for target in targets])


@pytest.fixture
def outbox(tmp_path: Path) -> Outbox:
    return Outbox(tmp_path / "outbox", ["mail", "chat"])


def test_all_that_was_decided_is_there_again(outbox, tmp_path):
    assert outbox.load() == (Saved(), ())
    outbox.hear(alarm())
    outbox.hear(alarm(fan=3))
    (heard,) = outbox.news(1)
    assert heard.fan == 2
    saved = Saved(
        is_first=False,
        announced=ANNOUNCED,
        gathered={("mail", Basket.HELD): Gathered(1, 2, 3, {FAN: Happened((Kind.RAISED, Kind.AGAIN), 4)})},
    )
    changes = Changes({*ANNOUNCED}, {("mail", Basket.HELD)}, texts("mail").outgoing)
    save(outbox, saved, changes)
    outbox.close()
    again = Outbox(tmp_path / "outbox", ["mail", "chat"])
    loaded, past = again.load()
    assert loaded == saved
    assert [each.fan for each in past] == [2], "the other was not read before the first one was saved"
    assert [each.fan for each in again.news(9)] == [3]
    waiting = again.next_for("mail")
    assert waiting and waiting.text == TEXT and not waiting.may_be_repeated
    assert again.next_for("chat") is None


def test_a_delivery_that_was_under_way_may_be_repeated(outbox, tmp_path):
    save(outbox, Saved(), texts("mail", "mail"))
    first = outbox.next_for("mail")
    outbox.begin(first)
    outbox.close()
    again = Outbox(tmp_path / "outbox", ["mail"])
    found = again.next_for("mail")
    assert found and (found.number, found.may_be_repeated) == (first.number, True)
    again.delivered("mail", found)
    second = again.next_for("mail")
    assert second and not second.may_be_repeated


def test_the_oldest_are_lost_and_the_next_one_knows_how_many(outbox, monkeypatch):
    monkeypatch.setattr(module, "MOST_MESSAGES", 3)
    monkeypatch.setattr(module, "KEPT_S", 60.0)
    save(outbox, Saved(), texts(*["mail"] * 5))
    assert (outbox.count(), outbox.lost) == (3, {"mail": 2})
    save(outbox, Saved(), Changes(), seconds=50)
    assert outbox.count() == 3
    outbox.begin(outbox.next_for("mail"))
    save(outbox, Saved(), Changes(), seconds=61)
    assert (outbox.count(), outbox.lost) == (1, {"mail": 4}), "what is under way is not lost"
    last = outbox.next_for("mail")
    assert last.lost == 4
    outbox.delivered("mail", last)
    save(outbox, Saved(), texts("mail"))
    assert outbox.next_for("mail").lost == 0, "it was said once"


def test_messages_of_a_target_that_is_gone_are_lost_and_counted_and_one_that_comes_back_hears_nothing_twice(
    outbox, tmp_path
):
    changes = texts("chat", "mail", "mail")
    changes.announced |= ANNOUNCED.keys()
    save(outbox, Saved(announced=ANNOUNCED), changes)
    outbox.close()
    again = Outbox(tmp_path / "outbox", ["chat"])
    assert (again.count(), again.lost) == (1, {"mail": 2})
    assert again.load()[0].announced == ANNOUNCED


def test_a_save_that_fails_saves_nothing_and_its_texts_are_not_sent(outbox, tmp_path):
    outbox.load()
    outbox.hear(alarm())
    assert len(outbox.news(9)) == 1
    outbox._store.write("DROP TABLE gathered")
    changes = texts("mail")
    changes.announced |= ANNOUNCED.keys()
    with pytest.raises(sqlite3.Error):
        save(outbox, Saved(announced=ANNOUNCED), changes)
    assert outbox.next_for("mail") is None
    outbox.close()
    again = Outbox(tmp_path / "outbox", ["mail"])
    assert again.load()[0] == Saved(), "not even that it was read"


def test_a_file_that_cannot_be_understood_is_named(outbox, tmp_path):
    outbox._store.write("INSERT INTO announced VALUES ('mail', 'tray1', 2, 'nonsense')")
    with pytest.raises(UserError, match="move it away"):
        outbox.load()
    (tmp_path / "text").write_text("this is no database, and long enough to be seen as such\n" * 20)
    with pytest.raises(UserError, match="the history of alarms cannot be kept there"):
        Outbox(tmp_path / "text", ["mail"])

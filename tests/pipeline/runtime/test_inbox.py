"""What is not urgent wakes nobody: it is taken, in order, with the next urgent item, at a tick, or once many wait."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from fantwin.pipeline.runtime.inbox import INBOX_SIZE, MOST_PATIENT, FromBus, FromSource, Inbox, Item, Liveness
from fantwin.schemas.topics import health_key, tray_key
from tests.support.running_chain import eventually

LONG_S = 20.0
MOMENT_S = 0.1


def item(number: int) -> FromBus:
    return FromBus("key", b"", number)


class Getter:
    """A stage that waits for an item."""

    def __init__(self, inbox: Inbox) -> None:
        self.got: Item | None = None
        self.thread = threading.Thread(target=self._get, args=(inbox,), daemon=True)
        self.thread.start()

    def _get(self, inbox: Inbox) -> None:
        self.got = inbox.get(LONG_S)

    def is_woken(self, timeout_s: float) -> bool:
        self.thread.join(timeout_s)
        return not self.thread.is_alive()


def woken_by(put_last: Callable[[Inbox], object], patient: int) -> Item | None:
    """What a waiting stage gets first after so many items that are not urgent, and one more."""
    inbox = Inbox(drops_oldest=False)
    getter = Getter(inbox)
    eventually(lambda: inbox._changed._waiters, "it waits")  # pyright: ignore[reportAttributeAccessIssue]
    for number in range(patient):
        inbox.put(item(number), is_urgent=False)
    assert not getter.is_woken(MOMENT_S)
    put_last(inbox)
    assert getter.is_woken(LONG_S / 2)
    return getter.got


def test_an_urgent_item_or_many_wake_the_stage_which_takes_the_others_first() -> None:
    assert woken_by(lambda inbox: inbox.put(item(99)), patient=2) == item(0)
    assert woken_by(lambda inbox: inbox.put_at_once(item(99)), patient=2) == item(0)
    assert woken_by(lambda inbox: inbox.put(item(99), is_urgent=False), patient=MOST_PATIENT) == item(0)
    inbox = Inbox(drops_oldest=False)
    inbox.put(item(1), is_urgent=False)
    assert inbox.get(LONG_S) == item(1), "a stage that asks gets what is there"
    assert inbox.get(0) is None


@pytest.mark.parametrize("waiting", [FromSource("a", None), FromBus(tray_key("s", "a", "raw"), b"", 1)])
def test_row_16_health_and_liveness_of_others_are_no_input(waiting: Item) -> None:
    inbox = Inbox(drops_oldest=True)
    inbox.put(FromBus(health_key("s", "scorer", "all"), b"", 1))
    inbox.put(Liveness("key", alive=True))
    assert not inbox.has_input("")
    inbox.put(waiting)
    assert [inbox.has_input(tray) for tray in ("", "a", "b")] == [True, True, False]
    for _ in range(3):
        inbox.get(0)
    assert [inbox.has_input(tray) for tray in ("", "a", "b")] == [False, False, False]


def test_row_16_while_an_item_cannot_be_put_input_of_any_tray_may_wait() -> None:
    inbox = Inbox(drops_oldest=False)
    for _ in range(INBOX_SIZE):
        inbox.put(FromSource("a", None))
    assert not inbox.has_input("b")
    blocked = threading.Thread(target=inbox.put, args=(FromSource("a", None),))
    blocked.start()
    eventually(lambda: inbox.has_input("b"), "what waits behind it is not known")
    inbox.get(0)
    blocked.join(LONG_S)
    assert not inbox.has_input("b")


def test_row_16_what_was_dropped_is_no_input() -> None:
    inbox = Inbox(drops_oldest=True)
    for number in range(INBOX_SIZE + 1):
        inbox.put(item(number))
    assert inbox.dropped == 1
    for _ in range(INBOX_SIZE):
        assert inbox.has_input("")
        inbox.get(0)
    assert not inbox.has_input("")

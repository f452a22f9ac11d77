"""Messages that wait: whose turn it is, and which of them come together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fantwin.pipeline.runtime.inbox import MOST_JOINED_VALUES, MOST_REQUESTS, DueMessages
from fantwin.schemas.blocks import can_join
from fantwin.schemas.enums import Action
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Message, Raw, Request
from fantwin.schemas.topics import tray_key
from tests.support.made_messages import filled

TRAYS = ("a", "b")


def raw(tray: str, sequence: int, samples: int = 1, fans: int = 2, producer: str = "acquisition-1") -> Envelope:
    times = {"host_receive_t_ns": np.arange(samples) + sequence}
    return envelope("raw", filled(Raw, samples, fans, header=Header(producer, sequence, tray), **times))


def request(tray: str, sequence: int) -> Envelope:
    return envelope("request", Request(t_ns=1, action=Action.IN_SERVICE, header=Header("operator", sequence, tray)))


def envelope(topic: str, message: Message) -> Envelope:
    return Envelope.of(tray_key("s", message.header.tray, topic), message, 0)


def popped(due: DueMessages) -> list[list[Envelope]]:
    found = []
    while due:
        found.append(taken(due))
    return found


def taken(due: DueMessages) -> list[Envelope]:
    return due.pop() if due.is_pressing else due.pop_request()


def begun() -> DueMessages:
    """The first message of each tray has been taken."""
    due = DueMessages(TRAYS, joins=True)
    due.add([raw("a", 0), raw("b", 0)])
    popped(due)
    return due


def test_messages_of_a_tray_come_together_after_the_first_and_trays_take_turns():
    due = DueMessages(TRAYS, joins=True)
    first = [raw("a", k) for k in range(3)]
    due.add(first)
    assert popped(due) == [first[:1], first[1:]], "the first message of a key comes alone"
    due = begun()
    a, b = [raw("a", k) for k in range(3)], [raw("b", k) for k in range(2)]
    between = request("a", 0)
    due.add([a[0], b[0], a[1], between, a[2], b[1]])
    assert len(due) == 6
    assert due.bytes == sum(len(each.payload) for each in (*a, *b, between))
    assert popped(due) == [a, b, [between]], "the request waits behind samples"
    assert due.bytes == 0
    mixed = [raw("a", 0), raw("a", 0, producer="acquisition-2"), raw("a", 1, fans=3)]
    due.add(mixed)
    assert popped(due) == [[each] for each in mixed], "another producer or number of fans is not joined"
    due.add([*a, between, *b])
    assert due.pop_of_each() == [a, b]
    assert not due.is_pressing
    assert due.pop_request() == [between]
    of_all = DueMessages([""], joins=True)
    of_all.add([*a, *b, request("", 0)])
    assert popped(of_all) == [[each] for each in (*a, *b, request("", 0))], "one core for all trays gets each alone"


def test_no_more_values_come_together_than_are_joined_at_most():
    due = begun()
    half = [raw("a", k, samples=MOST_JOINED_VALUES // 4, fans=2) for k in range(3)]
    larger = raw("a", 3, samples=MOST_JOINED_VALUES, fans=2)
    due.add([*half, larger])
    assert popped(due) == [half[:2], half[2:], [larger]]
    large = [raw(tray, k, samples=MOST_JOINED_VALUES // 4, fans=2) for k in range(3) for tray in TRAYS]
    due.add(large)
    assert due.pop_of_each() == [large[0:4:2], large[1:4:2]], "two of each, as if there were no other tray"
    larger_trays = DueMessages(TRAYS, joins=True)
    larger_trays.add([raw(tray, 0, samples=MOST_JOINED_VALUES, fans=2) for tray in TRAYS])
    assert [len(group) for group in larger_trays.pop_of_each()] == [1]


STEPS = st.lists(st.one_of(st.none(), st.tuples(st.sampled_from(["a", "b", "c"]), st.booleans())), max_size=40)


@given(STEPS, st.booleans(), st.booleans())
def test_nothing_is_lost_or_overtaken_within_a_tray(
    steps: Sequence[tuple[str, bool] | None], joins: bool, of_each: bool
) -> None:
    due, added, found = DueMessages(TRAYS, joins=joins), [], []
    for step in steps:
        if step is not None:
            added.append(request(step[0], len(added)) if step[1] else raw(step[0], len(added)))
            due.add(added[-1:])
        elif due.is_pressing and of_each:
            at_once = due.pop_of_each()
            assert len({group[0].header.tray for group in at_once if group[0].header.tray in TRAYS}) == len(
                [group for group in at_once if group[0].header.tray in TRAYS]
            )
            found += at_once
        elif due:
            found.append(taken(due))
    found += popped(due)
    for group in found:
        assert all(can_join(group[0].message, other.message) for other in group[1:])
        assert joins or len(group) == 1
    for tray in ("a", "b", "c"):
        for kind in (Raw, Request):
            of_tray = [each for group in found for each in group if is_of(each, tray, kind)]
            assert of_tray == [each for each in added if is_of(each, tray, kind)]


def is_of(envelope: Envelope, tray: str, kind: type[Message]) -> bool:
    return envelope.header.tray == tray and isinstance(envelope.message, kind)


def test_row_11_requests_of_people_wait_behind_samples_and_no_more_than_some_of_a_tray():
    due = begun()
    flood = [request("a", number) for number in range(MOST_REQUESTS + 5)]
    of_another_tray, samples = request("b", 0), raw("a", 1)
    due.add([*flood, of_another_tray, samples])
    assert due.refused_requests == 5
    assert due.has("b")
    assert due.pop() == [samples]
    assert popped(due) == [*([each] for each in flood[:MOST_REQUESTS]), [of_another_tray]]
    assert not due.has("b")
    due.add([request("a", 100)])
    assert len(due) == 1, "there is room again"

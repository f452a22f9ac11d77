"""What one stage keeps for others, and what a stage that starts is given of it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest

from fantwin.pipeline.bus.kept_messages import KeptQuery
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.runtime.kept_snapshots import KeptForOthers, KeptSnapshots
from fantwin.schemas.codec import encode
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import ScorerSnapshot
from fantwin.schemas.topics import tray_key
from tests.support.running_chain import eventually
from tests.support.written_recordings import alarm

LONG_S = 60.0
TRAYS = ("a", "b")
"""those that the recorder has"""


def snapshot(tray: str, t_ns: int) -> Envelope:
    header = Header("scorer-all-1", t_ns, tray)
    message = ScorerSnapshot(header=header, t_ns=t_ns, twin_sha256="x", state_json="{}")
    return Envelope.of(tray_key("s", tray, "snapshot"), message, t_ns)


@pytest.fixture
def buses(endpoint: str) -> Iterator[tuple[Bus, Bus]]:
    with Bus(BusConfig(endpoint=endpoint)) as one, Bus(BusConfig(endpoint=endpoint)) as other:
        other.wait_for_others(threading.Event())
        yield one, other


def asking(
    bus: Bus, wait_for_predecessor: Callable[[], None] = lambda: None, answer_limit_s: float = LONG_S, **more: Any
) -> KeptSnapshots:
    limits = {"is_one_expected": True, "keeper_limit_s": LONG_S, **more}
    return KeptSnapshots(lambda: bus, "s", threading.Event(), wait_for_predecessor, answer_limit_s, **limits)


def keeping(bus: Bus, before: Mapping[str, bytes]) -> KeptForOthers:
    """What a recorder keeps that answers at once."""

    def answer(query: KeptQuery) -> None:
        kept.answer(query)

    kept = KeptForOthers(bus, "s", ("snapshot",), TRAYS, before, answer)
    return kept


def by_key(*snapshots: Envelope) -> dict[str, bytes]:
    return {each.key: each.payload for each in snapshots}


def times(kept: KeptSnapshots, tray: str, *, is_patient: bool = True) -> list[int]:
    return [each.t_ns for each in kept.of(tray, is_patient=is_patient)[0]]


def test_the_last_snapshot_of_a_tray_is_given_to_whoever_asks_for_that_tray(buses):
    recorder, scorer = buses
    kept = keeping(recorder, by_key(snapshot("b", 1), snapshot("a", 1)))
    for t_ns in (5, 7):
        kept.add(snapshot("a", t_ns))
    kept.add(Envelope.of(tray_key("s", "a", "alarm"), alarm(0), 9))
    found = asking(scorer)
    assert [times(found, tray) for tray in ("a", "b")] == [[7], [1]]
    (given,), _ = found.of("a", is_patient=True)
    assert given.header == Header("scorer-all-1", 7, "a"), "as it was published"


def test_each_stage_that_keeps_one_answers_and_what_cannot_be_read_is_left_out(buses):
    one, scorer = buses
    for payload in (encode(snapshot("a", 3).message), b"\xff\xff"):
        keeping(one, {tray_key("s", "a", "snapshot"): payload})
    found = asking(scorer)
    assert eventually(lambda: times(found, "a"), "both have answered") == [3]


def test_nobody_waits_for_a_recorder_that_the_configuration_does_not_have_or_where_the_own_file_is_recent(buses):
    _, scorer = buses
    assert asking(scorer, is_one_expected=False).of("a", is_patient=True) == ([], "")
    assert asking(scorer).of("a", is_patient=False) == ([], "")


def test_a_recorder_that_has_nothing_of_a_tray_is_not_waited_for_and_one_of_other_trays_is_none(buses):
    recorder, scorer = buses
    keeping(recorder, {})
    assert asking(scorer).of("a", is_patient=True) == ([], "")
    found = asking(scorer, keeper_limit_s=0.3)
    assert found.of("c", is_patient=True) == ([], "no recorder of this tray was there within 0.3 s")


def test_a_recorder_that_starts_meanwhile_is_waited_for(buses):
    recorder, scorer = buses
    given: list[int] = []
    thread = threading.Thread(target=lambda: given.extend(times(asking(scorer), "a")))
    thread.start()
    keeping(recorder, by_key(snapshot("a", 4)))
    thread.join(LONG_S)
    assert given == [4]


def test_whoever_takes_over_asks_when_the_one_before_has_published_its_last_snapshot(buses):
    recorder, scorer = buses
    kept = keeping(recorder, by_key(snapshot("a", 1)))
    assert times(asking(scorer, wait_for_predecessor=lambda: kept.add(snapshot("a", 2))), "a") == [2]


def test_a_recorder_that_hangs_is_not_waited_for_twice_and_is_told_of(buses):
    recorder, scorer = buses
    queries: list[KeptQuery] = []
    KeptForOthers(recorder, "s", ("snapshot",), TRAYS, {}, queries.append)
    found = asking(scorer, answer_limit_s=0.6)
    assert found.of("a", is_patient=True) == ([], "a recorder did not answer within 0.6 s")
    assert found.of("b", is_patient=True) == ([], "a recorder did not answer within 0.5 s")
    assert [query.key for query in queries] == [tray_key("s", tray, "snapshot") for tray in ("a", "b")]

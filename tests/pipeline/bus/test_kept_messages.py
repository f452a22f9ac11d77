"""What publishers keep for consumers that missed it: enough for a lost link, and bounded in memory."""

from __future__ import annotations

from queue import SimpleQueue

from fantwin.pipeline.bus import publisher as publisher_module
from fantwin.pipeline.bus.kept_messages import KeptQuery, answer_for_kept, ask_for_kept
from fantwin.pipeline.bus.recovery import Answer
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.schemas.topics import BY_NAME, CATCH_UP_MESSAGES, tray_key
from tests.support.running_chain import eventually

LOST_S, RATE_HZ = 30, 100


def test_row_16_what_is_sent_while_a_link_is_lost_for_30_s_is_kept(endpoint, monkeypatch):
    """Samples of 8 fans at 100 Hz; a consumer that begins, as after a hang, asks for those of 40 s."""
    key, topic = tray_key("s", "a", "raw"), BY_NAME["raw"]
    monkeypatch.setattr(Bus, "answer_timeout_s", 60.0)
    config = BusConfig(endpoint=endpoint)
    with Bus(config) as bus, Bus(config) as asker:
        publisher = bus.publisher(key, topic, "", "p")
        for _ in range(LOST_S * RATE_HZ + CATCH_UP_MESSAGES):
            publisher.put(bytes(300))
        eventually(lambda: asker.recover(key, "p"), "they have met")
        assert len(asker.recover(key, "p")) == LOST_S * RATE_HZ + CATCH_UP_MESSAGES
        assert len(asker.recover(key)) == CATCH_UP_MESSAGES


def test_a_site_or_tray_may_have_a_name_of_which_other_keys_are_made(endpoint):
    config, topic = BusConfig(endpoint=endpoint), BY_NAME["snapshot"]
    with Bus(config) as bus, Bus(config) as asker:
        for key in (tray_key("s", "recover", "snapshot"), tray_key("kept", "recover", "snapshot")):
            bus.publisher(key, topic, "", "p").put(b"one")
            asked: list[str] = []
            with answer_for_kept(bus._session, key, lambda query, asked=asked: answer(query, asked)):
                found = eventually(lambda key=key: ask_for_kept(asker._session, key, 1.0)[0], "what is kept is found")
            assert (found, set(asked)) == ([b"one"], {key})
            assert eventually(lambda key=key: asker.recover(key, "p"), "they have met") == [(key, b"one")]


def answer(query: KeptQuery, asked: list[str]) -> None:
    asked.append(query.key)
    query.answer(b"one")


RANGES = [(0, 99), (5, 7), (97, 200), (100, 200)]


def test_a_request_for_a_range_is_answered_with_what_is_kept_of_it(endpoint, monkeypatch):
    monkeypatch.setattr(publisher_module, "KEPT_BYTES", 60)
    key, answers = tray_key("s", "a", "raw"), SimpleQueue[Answer]()
    config = BusConfig(endpoint=endpoint)
    with Bus(config) as bus, Bus(config) as asker:
        publisher = bus.publisher(key, BY_NAME["raw"], "", "p")
        for number in range(100):
            publisher.put(bytes([number]))
        eventually(lambda: asker.recover(key, "p"), "they have met")
        for first, last in RANGES:
            asker.request_missed(key, "p", first, last, 20.0, answers.put)
            answer = answers.get(timeout=20)
            kept = [number for number in range(40, 100) if first <= number <= last]
            assert [payload[0] for _, payload in answer.messages] == kept
            assert answer.published == 100


def test_row_16_publishers_of_a_process_keep_a_bounded_number_of_bytes_together(endpoint, monkeypatch):
    monkeypatch.setattr(publisher_module, "KEPT_BYTES_OF_ALL", 10_000)
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        first, second = (bus.publisher(tray_key("s", tray, "raw"), BY_NAME["raw"], "", "p") for tray in "ab")
        rare = bus.publisher(tray_key("s", "a", "alarm"), BY_NAME["alarm"], "", "p")
        for _ in range(100):
            rare.put(bytes(100))
            for publisher in (first, second):
                publisher.put(bytes(100))
        assert sum(len(each._kept) for each in (first, second)) == 100
        assert len(rare._kept) == 100, "what is published only on change is kept all the same"


def test_the_newest_message_is_kept_however_large_it_is_and_of_small_ones_as_many_as_its_topic_says(endpoint):
    topic = BY_NAME["snapshot"]
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        publisher = bus.publisher(tray_key("s", "a", "snapshot"), topic, "", "p")
        for number in range(3):
            publisher.put(bytes([number]) * (publisher_module.KEPT_BYTES + 1))
        assert [(sequence, payload[0]) for sequence, payload in publisher._kept] == [(2, 2)]
        for _ in range(topic.kept + 1):
            publisher.put(b"small")
        assert len(publisher._kept) == topic.kept

"""The bus between real processes: nothing is lost, in any order of starting and after any death."""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import zenoh

from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.bus.publisher import KEPT_BYTES
from fantwin.pipeline.bus.recovery import recovery_key
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.models import BusConfig
from fantwin.schemas.codec import type_name
from fantwin.schemas.messages import Alarm
from fantwin.schemas.topics import BY_NAME, alive_key, tray_key
from tests.support.bus_peer import KEY, TOPIC
from tests.support.running_chain import eventually

COUNT = 400


def peer(role: str, endpoint: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "tests.support.bus_peer", role, endpoint, str(COUNT)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[3],
    )


def line_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout
    return process.stdout.readline().strip()


def collected(collector: subprocess.Popen[str], publisher: subprocess.Popen[str]) -> str:
    """The line that the collector prints at the end; until then the publisher publishes one message at a time."""
    result: queue.Queue[str] = queue.Queue()
    threading.Thread(target=lambda: result.put(line_of(collector)), daemon=True).start()
    assert publisher.stdin
    for _ in range(300):
        publisher.stdin.write("one more\n")
        publisher.stdin.flush()
        try:
            return result.get(timeout=0.1)
        except queue.Empty:
            continue
    pytest.fail("the collector did not get what it waits for")


@pytest.fixture
def peers(endpoint):
    """Starts peers, waits for their first word, and ends them after the test."""
    started: list[subprocess.Popen[str]] = []

    def start(role: str) -> subprocess.Popen[str]:
        started.append(peer(role, endpoint))
        assert line_of(started[-1]) in {"published", "ready"}
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


ALL = " ".join(map(str, range(COUNT)))


def test_every_message_arrives_in_order_when_the_consumer_starts_last(peers):
    publisher, collector = peers("publish"), peers("collect")
    assert collected(collector, publisher).startswith(ALL)


def test_peers_discover_each_other_after_the_process_at_the_endpoint_was_killed(peers):
    holder, collector = peers("collect"), peers("collect")
    holder.kill()
    holder.wait()
    assert collected(collector, peers("publish")).startswith(ALL)


def test_a_token_shows_when_a_process_appears_and_when_it_has_gone(endpoint):
    seen: list[bool] = []
    changed = threading.Event()

    def on_change(_key: str, alive: bool) -> None:
        seen.append(alive)
        changed.set()

    with Bus(BusConfig(endpoint=endpoint)) as watcher:
        watcher.watch_alive(alive_key("site", "*", "*"), on_change)
        with Bus(BusConfig(endpoint=endpoint)) as other:
            other.declare_alive(alive_key("site", "scorer", "all"))
            assert changed.wait(20)
            changed.clear()
        assert changed.wait(20)
    assert seen == [True, False]


def test_a_session_that_does_not_listen_leaves_the_endpoint_to_others(endpoint):
    config = BusConfig(endpoint=endpoint)
    with Bus(config, listens=False) as first, Bus(config) as staying:
        assert not staying.came_second
        staying.declare_alive(alive_key("site", "scorer", "all"))
        eventually(lambda: first.alive(alive_key("site", "*", "*")), "they meet all the same")
        with Bus(config, listens=False) as late:
            assert late.came_second


def test_a_publisher_keeps_the_newest_messages_that_fit_its_memory(endpoint, monkeypatch):
    key, size, count = tray_key("site", "tray", "score"), KEPT_BYTES // 4, 6
    monkeypatch.setattr(Bus, "answer_timeout_s", 30.0)
    patient = BusConfig(endpoint=endpoint)
    met = threading.Event()
    with Bus(patient) as bus, Bus(patient) as asker:
        bus.declare_alive(alive_key("site", "big", "all"))
        asker.watch_alive(alive_key("site", "*", "*"), lambda _key, _alive: met.set())
        assert met.wait(20)
        publisher = bus.publisher(key, BY_NAME["score"], "", "big")
        for number in range(count):
            publisher.put(bytes([number]) * size)
        # the asker must have discovered the publisher
        eventually(lambda: asker.recover(key, "big"), "somebody answers")
        kept = [payload[0] for _, payload in asker.recover(key, "big")]
        assert kept == [2, 3, 4, 5]
        history = BY_NAME["score"].history
        for _ in range(history + 1):
            publisher.put(b"small")
        assert len(asker.recover(key, "big")) == history


def test_row_11_a_request_that_makes_no_sense_is_answered_as_if_it_had_not_asked_that(endpoint, capfd):
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        bus.publisher(KEY, TOPIC, type_name(Alarm), "peer").put(b"kept")
        for asked in ("first=x", "last=-1", "newest=1e9", "newest=0", f"first={'9' * 5000}"):
            where, every_reply = f"{recovery_key(KEY, 'peer')}?{asked}", zenoh.ConsolidationMode.NONE
            replies = list(bus._session.get(where, timeout=20.0, consolidation=every_reply))
            assert [reply.ok.payload.to_bytes() for reply in replies if reply.ok] == [b"kept", b""], asked
        assert bus.recover(KEY, "nobody") == []
    assert "Traceback" not in capfd.readouterr().err


def test_a_wrong_endpoint_is_one_line():
    with pytest.raises(BusError, match="bus.endpoint = 'nonsense' cannot be used"):
        Bus(BusConfig(endpoint="nonsense"))

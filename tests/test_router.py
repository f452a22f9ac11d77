"""`fantwin router`: sessions on several hosts meet there."""

from __future__ import annotations

import queue
from collections.abc import Iterator

import pytest
from chain import Running, fantwin

from pipeline.bus import Bus
from pipeline.config import BusConfig
from schemas.topics import BY_NAME, tray_key

KEY = tray_key("site", "tray", "alarm")


@pytest.fixture
def started() -> Iterator[list[Running]]:
    processes: list[Running] = []
    yield processes
    for process in processes:
        process.kill()


def client(endpoint: str) -> Bus:
    return Bus(BusConfig(mode="client", endpoint=endpoint))


def exchange(listener: Bus, speaker: Bus) -> bytes:
    """What the one hears of the other; said again until it is, since nobody knows when they have met."""
    heard: queue.Queue[bytes] = queue.Queue()
    listener.subscribe(KEY, lambda _key, payload: heard.put(payload))
    outlet = speaker.outlet(KEY, BY_NAME["alarm"], "x", "speaker")
    for _ in range(600):
        outlet.put(b"hello")
        try:
            return heard.get(timeout=0.1)
        except queue.Empty:
            continue
    raise AssertionError("nothing was heard in a minute")


def test_two_clients_hear_each_other_through_the_router(endpoint, started):
    router = Running(["router", "--listen", endpoint, "--json"])
    started.append(router)
    with client(endpoint) as one, client(endpoint) as other:
        assert exchange(one, other) == b"hello"
        assert exchange(other, one) == b"hello"
    assert router.end() == 0
    assert router.output() == {"listening": endpoint}


def test_clients_that_start_before_the_router_get_through_once_it_is_there(endpoint, started):
    with client(endpoint) as one, client(endpoint) as other:
        started.append(Running(["router", "--listen", endpoint]))
        assert exchange(one, other) == b"hello"


def test_without_a_router_clients_hear_nothing(endpoint):
    heard: list[bytes] = []
    with client(endpoint) as one, client(endpoint) as other:
        one.subscribe(KEY, lambda _key, payload: heard.append(payload))
        other.outlet(KEY, BY_NAME["alarm"], "x", "speaker").put(b"hello")
    assert heard == []


def test_a_second_router_at_the_same_place_is_refused_in_one_line(endpoint, started):
    first = Running(["router", "--listen", endpoint])
    started.append(first)
    with client(endpoint) as one, client(endpoint) as other:
        exchange(one, other)  # it is there
    done = fantwin("router", "--listen", endpoint)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "is one running already?" in done.stderr

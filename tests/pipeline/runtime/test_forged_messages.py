"""A message in the name of another session is refused, whatever its number, and so is an answer in its name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import zenoh

from fantwin.pipeline.bus.identity import SHOWN_S, Forgeries, new_session_id
from fantwin.pipeline.bus.recovery import recovery_key
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.runtime.sessions import Session
from fantwin.pipeline.runtime.stage import BuiltStage
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import Severity
from fantwin.schemas.header import Header
from fantwin.schemas.health import Output
from fantwin.schemas.messages import Alarm, Grid, Raw
from fantwin.schemas.topics import BY_NAME, alive_key, health_key, tray_key
from tests.support import made_messages
from tests.support.running_chain import eventually
from tests.support.toy_stage import TRAY_A, Bench, Silent, raw, toy

KEY = tray_key("s", TRAY_A, "raw")
REAL_T_NS, FORGED_T_NS = 1, 3600 * 10**9


class Acquisition:
    """A session that publishes as the product's stages do."""

    def __init__(self, bus: Bus) -> None:
        self.producer = f"acquisition-{TRAY_A}-{bus.id}"
        self.raw = bus.publisher(KEY, BY_NAME["raw"], type_name(Raw), self.producer)
        bus.declare_alive(Session("acquisition", TRAY_A, 1, self.producer, "host", 1).key("s"))

    def send(self, t_ns: int) -> None:
        self.raw.put(sample(self.producer, self.raw.published, t_ns))


def sample(producer: str, sequence: int, t_ns: int) -> bytes:
    columns = {"device_sequence": np.array([sequence], np.uint32)} if sequence % 2 else {}
    return encode(replace(raw(t_ns), header=Header(producer, sequence, TRAY_A), **columns))


def claim(producer: str, published: int) -> bytes:
    return encode(
        made_messages.health("acquisition", TRAY_A, producer, outputs=(Output(key=KEY, published=published),))
    )


@pytest.mark.parametrize(
    "forge",
    [
        lambda stranger, producer: [stranger.put(KEY, sample(producer, n, FORGED_T_NS)) for n in range(1, 21)],
        lambda stranger, producer: stranger.put(KEY, sample(producer, 10**6, FORGED_T_NS)),
        lambda stranger, producer: stranger.put(health_key("s", "acquisition", TRAY_A), claim(producer, 10**6)),
    ],
    ids=["the next numbers", "a number far ahead", "a health that claims many"],
)
def test_row_10_what_a_stranger_sends_in_the_name_of_a_stage_is_refused_and_real_samples_go_on(
    config, forge: Callable[[zenoh.Session, str], None]
):
    bench = Bench(toy(), config)
    acquisition = Acquisition(bench.bus)
    acquisition.send(REAL_T_NS)
    assert bench.next(Grid).t_ns.tolist() == [REAL_T_NS]
    with Bus(config.bus) as stranger:
        eventually(lambda: stranger.alive(alive_key("s", "*", "*")), "they meet")
        forge(stranger._session, acquisition.producer)
        warned = bench.health_with(lambda health: "another program publishes" in health.problem)
    for t_ns in range(2, 5):
        acquisition.send(t_ns)
    assert [bench.next(Grid).t_ns.tolist() for _ in range(3)] == [[2], [3], [4]]
    last = bench.end()
    assert f"in the name of {acquisition.producer}: refused" in warned.problem
    assert {each.name: each.value for each in last.counters}["refused_forged"] > 0
    (line,) = last.inputs
    assert (line.received, line.missing, line.duplicated) == (4, 0, 0)


def test_row_10_what_a_stranger_answers_for_a_producer_is_not_believed(config):
    with Bus(config.bus) as bus, Bus(config.bus) as stranger, Bus(config.bus) as reader:
        acquisition = Acquisition(bus)
        acquisition.send(REAL_T_NS)

        def answer(query: zenoh.Query) -> None:
            with query:
                for number in range(20):
                    query.reply(query.key_expr, sample(acquisition.producer, number, FORGED_T_NS))
                query.reply(query.key_expr, b"", attachment=b"1000000")

        with stranger._session.declare_queryable(recovery_key(KEY, acquisition.producer), answer):
            eventually(lambda: reader.recover(KEY) and reader.forgeries.count, "both have answered")
            for producer in (acquisition.producer, "*"):
                assert reader.recover(KEY, producer) == [(KEY, sample(acquisition.producer, 0, REAL_T_NS))]


def test_row_10_forged_alarms_do_not_make_the_real_one_a_duplicate(config):
    """A consumer that starts after them does not take them either."""
    key = tray_key("s", TRAY_A, "alarm")
    stage = toy(lambda _context: BuiltStage(Silent()), reads=("alarm",), writes=())
    with Bus(config.bus) as scorer, Bus(config.bus) as stranger:
        producer = f"scorer-all-{scorer.id}"
        scorer.declare_alive(Session("scorer", "all", 1, producer, "host", 1).key("s"))
        alarms = scorer.publisher(key, BY_NAME["alarm"], type_name(Alarm), producer)
        bench = Bench(stage, config)
        eventually(lambda: stranger.alive(alive_key("s", "*", "*")), "they meet")
        for number in range(20):
            forged = made_messages.alarm(0, tray=TRAY_A, producer=producer, sequence=number, severity=Severity.NONE)
            stranger._session.put(key, encode(forged))
        bench.health_with(lambda health: any(each.name == "refused_forged" for each in health.counters))
        alarms.put(encode(made_messages.alarm(0, tray=TRAY_A, producer=producer)))
        health = bench.health_with(lambda health: bool(health.inputs))
        bench.end()
    assert [(line.received, line.duplicated) for line in health.inputs if line.key == key] == [(1, 0)]


def test_a_forged_message_is_named_for_a_while_and_what_cannot_be_read_is_none():
    now_s = [0.0]
    forgeries = Forgeries(lambda: now_s[0])
    assert not forgeries.is_one(KEY, b"\xff", "")
    assert not forgeries.is_one("no/topic", b"", "")
    assert forgeries.is_one(KEY, sample(f"acquisition-all-{new_session_id()}", 0, 1), "")
    assert forgeries.problem()
    now_s[0] = SHOWN_S
    assert not forgeries.problem()
    assert forgeries.count == 1

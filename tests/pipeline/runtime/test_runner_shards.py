"""A process of a stage that has some of the trays: what it reads, and what it is called."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from fantwin.pipeline.runtime.runner import Runner
from fantwin.pipeline.runtime.stage import BuiltStage, Context, StageError
from fantwin.schemas.codec import decode, encode, type_name
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Grid, Message, ScorerSnapshot
from fantwin.schemas.topics import BY_NAME, health_key, tray_key
from tests.support import made_messages
from tests.support.running_chain import eventually
from tests.support.toy_stage import TRAY_A, TRAY_B, Bench, Passer, Silent, ToyConfig, toy


def test_a_shard_reads_its_trays_only_and_says_in_its_health_which_they_are(config):
    bench = Bench(toy(), config, TRAY_B)
    bench.feed(TRAY_A, 1)
    bench.feed(TRAY_B, 2)
    assert bench.next(Grid).header.tray == TRAY_B
    last = bench.end()
    assert (last.instance, last.trays) == (TRAY_B, TRAY_B)
    assert last.header.producer.startswith(f"resampler-{TRAY_B}-")
    assert {line.key.split("/")[2] for line in (*last.inputs, *last.outputs)} == {TRAY_B}


def test_a_shard_receives_the_health_of_every_process_that_has_one_of_its_trays_and_of_no_other(config):
    heard: list[tuple[str, str]] = []

    class Listens(Passer):
        def step(self, item: Any) -> Sequence[Message]:
            if isinstance(item, Health):
                heard.append((item.stage, item.instance))
            return []

    bench = Bench(
        toy(lambda _context: BuiltStage(Listens()), core_per_tray=False, reads=("raw", "health")), config, "b"
    )
    for instance, trays in (("1-of-2", "a"), ("2-of-2", "b"), ("a+b", "a,b"), ("all", "")):
        key, producer = health_key("s", "scorer", instance), f"scorer-{instance}-1"
        publisher = bench.bus.publisher(key, BY_NAME["health"], type_name(Health), producer)
        publisher.put(encode(made_messages.health("scorer", instance, producer, trays=trays)))
    eventually(lambda: ("scorer", "all") in heard, "the last one has come")
    bench.end()
    assert [instance for stage, instance in heard if stage == "scorer"] == ["2-of-2", "a+b", "all"]
    assert ("resampler", TRAY_B) in heard, "its own"


def test_a_recorder_that_is_behind_gives_the_last_snapshot_that_had_arrived(config):
    is_behind, may_go_on = threading.Event(), threading.Event()

    class Behind(Silent):
        def step(self, item: Any) -> Sequence[Message]:
            is_behind.set()
            assert may_go_on.wait(20)
            return []

    config = replace(config, sections={"recorder": ToyConfig()})
    declared = {"name": "recorder", "reads": ("raw", "snapshot"), "writes": ()}
    stage = toy(lambda _context: BuiltStage(Behind()), core_per_tray=False, **declared)
    bench = Bench(stage, config)
    key = tray_key("s", TRAY_A, "snapshot")
    scorer = bench.bus.publisher(key, BY_NAME["snapshot"], type_name(ScorerSnapshot), "scorer-all-1")
    for number in (0, 1):
        header = Header("scorer-all-1", number, TRAY_A)
        scorer.put(encode(ScorerSnapshot(header=header, t_ns=number, twin_sha256="", state_json="")))
        assert is_behind.wait(20)
    found: list[tuple[list[bytes], bool]] = []
    thread = threading.Thread(target=lambda: found.append(bench.bus.ask_for_kept(key, 20.0)))
    thread.start()
    eventually(lambda: bench.runner._inbox.waiting() > 1, "the second snapshot and the question wait")
    may_go_on.set()
    thread.join(20)
    bench.end()
    ((payload,), have_answered) = found[0]
    assert (decode(ScorerSnapshot, payload).t_ns, have_answered) == (1, True)


def test_a_stage_that_cannot_be_built_says_so_although_its_router_is_away(config):
    def build(_context: Context) -> BuiltStage:
        raise StageError("there is no twin")

    config = replace(config, bus=config.bus.model_copy(update={"mode": "client"}))
    with pytest.raises(StageError, match="there is no twin"):
        Runner(toy(build), config, None, threading.Event())

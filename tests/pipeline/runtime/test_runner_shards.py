"""A process of a stage that has some of the trays: what it reads, and what it is called."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.runtime.stage import BuiltStage
from schemas.codec import encode, type_name
from schemas.messages import Grid, Header, Health, Message, StageStatus
from schemas.topics import BY_NAME, health_key
from tests.support.running_chain import eventually
from tests.support.toy_stage import TRAY_A, TRAY_B, Bench, Passer, toy


def test_a_shard_reads_its_trays_only_and_says_in_its_health_which_they_are(config):
    bench = Bench(toy(), config, TRAY_B)
    bench.feed(TRAY_A, 1)
    bench.feed(TRAY_B, 2)
    assert bench.next(Grid).header.tray == TRAY_B
    last = bench.end()
    assert (last.instance, last.trays) == (TRAY_B, TRAY_B)
    assert last.header.producer.startswith(f"resampler-{TRAY_B}-")
    assert {line.key.split("/")[2] for line in (*last.inputs, *last.outputs)} == {TRAY_B}


def test_a_process_with_all_trays_is_called_as_before_and_names_none(config):
    last = Bench(toy(), config).end()
    assert (last.instance, last.trays) == ("all", "")


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
        producer = f"scorer-{instance}-1"
        publisher = bench.bus.publisher(
            health_key("s", "scorer", instance), BY_NAME["health"], type_name(Health), producer
        )
        health = Health(
            header=Header(producer, 0, ""),
            stage="scorer",
            instance=instance,
            status=StageStatus.OK,
            t_ns=1,
            uptime_s=0.0,
            trays=trays,
        )
        publisher.put(encode(health))
    eventually(lambda: ("scorer", "all") in heard, "the last one has come")
    bench.end()
    assert [instance for stage, instance in heard if stage == "scorer"] == ["2-of-2", "a+b", "all"]
    assert ("resampler", TRAY_B) in heard, "its own"

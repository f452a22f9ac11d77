"""A process of one of the shards killed (kill -9) at random, again and again, under load: what is lost, which alarms.

Every stage from raw samples to recordings runs in shards under `fantwin up`, and the samples of the trays, made
beforehand, are published in real time. The kills are spread over that time. In the end, the recordings of all shards
together are compared with what was sent and with what the same samples give where nothing is killed.

    python -m bench.fleet.shard_kills
"""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from bench.fleet.fed_outcome import RECORDS_SCORES, Outcome, outcome_of
from bench.fleet.fed_trays import BUSY, FREE_RUN_BEGINS_AGAIN_S, SITE, Feed, Load, NewestScores
from bench.printing import JsonOption, progress, show
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.site.site_watcher import SiteWatcher

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.running_chain import RunningCommand, eventually

STAGES = ("resampler", "twin_integrator", "scorer", "recorder")
DEADLINE_S = 900.0  # far beyond what anything takes


@dataclass(frozen=True)
class Kills:
    """How many, spread over the samples that are fed in real time, of how many shards of each stage, and which."""

    number: int
    shards: int
    seed: int
    stages: Sequence[str] = STAGES

    @property
    def may_move_s(self) -> float:
        """By how much they may move the beginning or the end of an alarm."""
        return FREE_RUN_BEGINS_AGAIN_S if {"resampler", "twin_integrator"} & set(self.stages) else 0.0


def main(
    kills: Annotated[int, typer.Option(min=1)] = 30,
    trays: Annotated[int, typer.Option(min=1, help="Of 8 fans each, at 100 Hz.")] = 4,
    shards: Annotated[int, typer.Option(min=1, help="Of each stage.")] = 4,
    seconds: Annotated[float, typer.Option(help="Of samples, over which the kills are spread.")] = 180.0,
    seed: Annotated[int, typer.Option(help="Of the kills.")] = 1,
    stage: Annotated[list[str] | None, typer.Option(help="Kill only this one; repeatable.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Print what was lost and which alarms differ; exit code 1 if something was lost and not counted, or one does."""
    with tempfile.TemporaryDirectory() as folder:
        load = Load(trays, seconds)
        found, killed = run(load, Kills(kills, shards, seed, stage or STAGES), Path(folder), progress)
    rows = [{"stage": stage, "killed": number} for stage, number in killed.items()]
    tables = {"kills": rows, f"{trays} trays, {shards} shards of each stage": [found.row()]}
    show(tables, found.notes(), as_json=json_output)
    if found.lost_silently or not found.alarms_are_right:
        raise typer.Exit(1)


def run(
    load: Load, kills: Kills, folder: Path, say: Callable[[str], None] = lambda _line: None
) -> tuple[Outcome, Counter[str]]:
    """The outcome, and how often a process of each stage was killed. folder: for configuration and recordings."""
    say("simulating")
    sent = load.made_beforehand()
    endpoint = _free_endpoint()
    configuration = folder / "site.toml"
    configuration.write_text(
        f'site = "{SITE}"\nrun_folder = "runs"\n[launcher]\nstages = {json.dumps(STAGES)}\n'
        f'shards = {kills.shards}\n{BUSY}[bus]\nendpoint = "{endpoint}"\n{RECORDS_SCORES}{load.tables}'
    )
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        watcher, ends = SiteWatcher(bus, SITE), NewestScores(bus)
        up = RunningCommand(["up", "-c", configuration, "--json"])
        try:
            processes = kills.shards * len(STAGES)
            with Feed(bus, load, sent) as feed:
                eventually(lambda: len(_at_work(watcher)) == processes, "all are at work", DEADLINE_S)
                say("feeding the beginning")
                feed.begin()
                eventually(lambda: ends.have_reached(load, sent, load.beginning_s), "that is scored", DEADLINE_S)
                killed = _feed_and_kill(load, kills, feed, watcher, say)
                say("waiting until all is scored")
                eventually(lambda: len(_at_work(watcher)) == processes, "all are back", DEADLINE_S)
                end_s = load.beginning_s + load.seconds
                eventually(lambda: ends.have_reached(load, sent, end_s), "the last samples are scored", DEADLINE_S)
            status = up.end()
            assert status in (0, 3), (status, up.lines[-20:])
            lost = up.output()["lost"]
        finally:
            up.kill()
    say("comparing with what should have been decided")
    return outcome_of([folder / "runs"], sent, lost, kills.may_move_s), killed


def _feed_and_kill(
    load: Load, kills: Kills, feed: Feed, watcher: SiteWatcher, say: Callable[[str], None]
) -> Counter[str]:
    chance = random.Random(kills.seed)
    feeding = threading.Thread(target=feed.run)
    began_s = time.monotonic()
    feeding.start()
    killed: Counter[str] = Counter()
    for number in range(kills.number):
        due_s = began_s + (number + chance.random()) * load.seconds / kills.number
        time.sleep(max(0.0, due_s - time.monotonic()))
        stage, process_id = chance.choice(eventually(lambda: _at_work(watcher, kills.stages), "one is", DEADLINE_S))
        os.kill(process_id, signal.SIGKILL)
        killed[stage] += 1
        eventually(lambda gone=process_id: not watcher.is_ready(gone), "it is seen to be gone")
        say(f"{number + 1} of {kills.number} kills: {stage}")
    feeding.join()
    return killed


def _at_work(watcher: SiteWatcher, stages: Sequence[str] = STAGES) -> list[tuple[str, int]]:
    """Stage and process of those that are at work, in an order that does not depend on when they were heard."""
    views = [view for view in watcher.stages() if view.alive and view.health.stage in stages]
    views.sort(key=lambda view: (view.health.stage, view.health.instance))
    return [(view.health.stage, view.health.process_id) for view in views]


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


if __name__ == "__main__":
    typer.run(main)

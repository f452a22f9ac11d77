"""Cuts between the stages of a chain and their router: what is lost, reported and recovered, and until when.

Each stage runs on a host of its own, a network namespace, with the demo's simulated tray behind acquisition; the router
is on another. The link of a stage is cut, or drops what goes in one direction, or a share of all packets; or the router
is killed and started again later. In the end the recording is compared with what the device sent, and its scores and
alarms with what the same samples give where nothing happens. Linux, root.

    python -m bench.fleet.partitions --place acquisition --place router --seconds 30
    python -m bench.fleet.partitions --soak 1800 --cuts 30
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.fleet.fed_outcome import RECORDS_SCORES, Outcome, outcome_of
from bench.fleet.network_hosts import ALONE, Host, Process, bridge
from bench.printing import JsonOption, progress, show
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.recordings.parts import in_order
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_states import StageView
from fantwin.schemas.codec import decode
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.messages import Raw, Score
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.running_chain import eventually

SITE, TRAY, FANS = "demo", "tray1", 8
STAGES = ("acquisition", "resampler", "twin_integrator", "scorer", "recorder")
"""in the order in which they are stopped"""
ROUTER, ROUTERS = "10.78.0.1", 7447
PLACES = (*STAGES, "router")
KINDS = ("cut", "deaf", "mute", "lossy", "slow")
"""which packets are dropped: all; those to the stage; those from it; 20 % of both; those above the rate SLOW"""
SLOW = "16kb/s"
"""per direction; less than the streams of the stages need"""
BEFORE_S, AFTER_S = 25.0, 10.0
"""the first is longer than the scorer needs to begin"""
FAULT_S, PERIOD_S = 6.0, 15.0
"""a fault of this length begins once in each period: one before each cut, others in and after it"""
BEHIND_S, BEHIND_MESSAGES = 2.0, 60
"""what is no more behind than this is up to date"""
DEADLINE_S = 240.0
DEMO = Path(__file__).parents[2] / "pipeline" / "demo" / "twin.onnx"


@dataclass(frozen=True)
class Cut:
    """What happens to one place; kind: one of KINDS."""

    place: str
    kind: str
    seconds: float


@dataclass
class Found:
    """What became of a run."""

    name: dict[str, Any]
    sent: int
    """samples of the device"""
    recorded: int
    outcome: Outcome
    well_s: list[float]
    """from the end of each cut until all was well again"""
    lost: dict[str, int] = field(default_factory=dict)

    def row(self) -> dict[str, Any]:
        """For a table."""
        found = self.outcome
        return {
            **self.name,
            "samples": self.sent,
            "not recorded": self.sent - self.recorded,
            "not scored": found.not_scored,
            "reported": sum(self.lost.values()),
            "alarms": found.alarms,
            "forgotten": len(found.forgotten),
            "too many": len(found.too_many),
            "raised again": len(found.raised_again),
            "well after s": round(max(self.well_s), 1),
        }

    @property
    def is_good(self) -> bool:
        """Whether nothing is missing that was not reported, and no alarm without a loss."""
        return bool(self.lost) or (self.sent == self.recorded and not self.outcome.not_scored and self._alarms_right)

    @property
    def _alarms_right(self) -> bool:
        return self.outcome.alarms_are_right


def main(
    place: Annotated[list[str] | None, typer.Option(help=f"Repeatable: {', '.join(PLACES)}. Default: all.")] = None,
    kind: Annotated[list[str] | None, typer.Option(help=f"Repeatable: {', '.join(KINDS)}. Default: cut.")] = None,
    seconds: Annotated[list[float] | None, typer.Option(help="Of a cut. Repeatable.")] = None,
    soak: Annotated[float, typer.Option(help="Seconds of one run with random cuts instead.")] = 0.0,
    cuts: Annotated[int, typer.Option(help="Of the soak.")] = 30,
    seed: Annotated[int, typer.Option(help="Of the soak's cuts.")] = 1,
    setting: Annotated[list[str] | None, typer.Option("--set", help="Of the configuration. Repeatable.")] = None,
    routers: Annotated[int, typer.Option(min=1, max=2)] = 1,
    keep: Annotated[Path | None, typer.Option(help="Folder for recordings and logs, which stays.")] = None,
    json_output: JsonOption = False,
    inside: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Print what was lost, reported and recovered; exit code 1 if something was lost and not reported."""
    if not inside:
        words = [sys.executable, "-m", "bench.fleet.partitions", "--inside", *sys.argv[1:]]
        os.execvp(ALONE[0], [*ALONE, *words])
    rows, notes, is_good = [], [], True
    with tempfile.TemporaryDirectory() as scratch:
        folder = keep or Path(scratch)
        plans = _plans(place or PLACES, kind or ["cut"], seconds or [1.0, 30.0], soak, cuts, seed)
        bridge(ROUTER)
        for number, (name, plan, run_s) in enumerate(plans):
            progress(" ".join(map(str, name.values())))
            here = folder / f"{number}"
            here.mkdir(parents=True)
            found = run(name, plan, run_s, here, setting or [], routers)
            rows.append(found.row())
            notes += [f"{' '.join(map(str, name.values()))}: {line}" for line in _notes(found)]
            is_good &= found.is_good
    show({f"cuts, {routers} router(s)": rows}, notes, as_json=json_output)
    if not is_good:
        raise typer.Exit(1)


def _notes(found: Found) -> list[str]:
    lost = [f"{process} lost {number}" for process, number in found.lost.items() if number]
    return lost + found.outcome.notes()


Plan = Sequence[tuple[float, Cut]]
"""cuts, each with the time of the run at which it begins"""


def _plans(
    places: Sequence[str], kinds: Sequence[str], lengths_s: Sequence[float], soak_s: float, cuts: int, seed: int
) -> Iterator[tuple[dict[str, Any], Plan, float]]:
    if not soak_s:
        for place in places:
            for kind in kinds:
                for length_s in lengths_s:
                    name = {"place": place, "kind": kind, "s": length_s}
                    yield name, [(BEFORE_S, Cut(place, kind, length_s))], BEFORE_S + length_s + AFTER_S
        return
    chance = random.Random(seed)
    each_s = (soak_s - BEFORE_S - AFTER_S) / cuts
    plan: list[tuple[float, Cut]] = []
    for number in range(cuts):
        length_s = min(each_s / 2, chance.choice([0.3, 1.0, 3.0, 4.0, 5.0, 8.0, 15.0, 30.0]))
        start_s = BEFORE_S + number * each_s + chance.uniform(0.0, each_s / 2 - 1.0)
        plan.append((start_s, Cut(chance.choice(PLACES), chance.choice(KINDS), length_s)))
    yield {"place": "random", "kind": f"{cuts} cuts", "s": soak_s}, plan, soak_s


def run(name: dict[str, Any], plan: Plan, run_s: float, folder: Path, settings: Sequence[str], routers: int) -> Found:
    """What becomes of one run. It must be in a network namespace of its own."""
    site = _Site(folder, settings, routers, run_s)
    try:
        well_s = site.let_things_happen(plan, run_s)
        sent, lost = site.end()
    finally:
        site.close()
    with open_replay_input(in_order([folder / "recorder"]), None, (), None) as recorded:
        raws = [decode(Raw, each.payload) for each in recorded.envelopes(TRAY, ("raw",))]
    raws.sort(key=lambda raw: int(raw.host_receive_t_ns[0]))
    samples = len({int(number) for raw in raws for number in raw.device_sequence})
    lost = {process: number for process, number in lost.items() if number}
    outcome = outcome_of([folder / "recorder"], {TRAY: raws}, lost, may_move_s=0.0)
    return Found(name, sent, samples, outcome, well_s, lost)


class _Site:
    """The hosts, and what happens to them."""

    def __init__(self, folder: Path, settings: Sequence[str], routers: int, run_s: float) -> None:
        self._folder = folder
        self._routers = [f"tcp/{ROUTER}:{ROUTERS + number}" for number in range(routers)]
        self._running: dict[int, Process] = {}
        for number in range(routers):
            self._start_router(number)
        endpoint = json.dumps(self._routers if routers > 1 else self._routers[0])
        (folder / "site.toml").write_text(
            f'site = "{SITE}"\n[launcher]\nwatchdog_s = 60\n'
            f'[bus]\nmode = "client"\nendpoint = {endpoint}\n[resampler]\nrate_hz = 100\n'
            f'{RECORDS_SCORES}[[tray]]\nname = "{TRAY}"\n'
            f'fans = {FANS}\nport = "{folder / "tray"}"\nprotocol = "binary"\nspeed_unit = "rpm"\nspeed_max = 20000\n'
            f'twin = "{DEMO}"\n'
        )
        self._settings = settings
        faults = [
            word
            for number in range(int((run_s - FAULT_S) / PERIOD_S))
            for start_s in [20.0 + number * PERIOD_S]
            for word in ("--fault", f"rotor:fan={number % FANS},start={start_s},stop={start_s + FAULT_S},size=1.0")
        ]
        words = ["simulate", "--fans", FANS, "--set", "speed_unit=rpm", "--link", folder / "tray", "--wait-for-reader"]
        self._device = Process([*words, "--json", *faults], folder / "device")
        self._hosts = {
            stage: Host(stage.replace("_", "-")[:12], f"10.78.0.{number}") for number, stage in enumerate(STAGES, 11)
        }
        self._ups = {stage: self._up(stage) for stage in reversed(STAGES)}
        self._bus = Bus(BusConfig(mode="client", endpoint=self._routers[-1]), threading.Event())
        self._watcher = SiteWatcher(self._bus, SITE)
        self._newest_ns = 0
        self._bus.subscribe(tray_key(SITE, TRAY, "score"), self._hear)

    def let_things_happen(self, plan: Plan, run_s: float) -> list[float]:
        """Run for so long; returns for each cut the seconds until all was well after it."""
        eventually(self._is_well, "all is well in the beginning", DEADLINE_S)
        began_s, well_s = time.monotonic(), []
        for start_s, cut in plan:
            time.sleep(max(0.0, began_s + start_s - time.monotonic()))
            undo = self._apply(cut)
            time.sleep(cut.seconds)
            undo()
            healed_s = time.monotonic()
            eventually(self._is_well, f"all is well after {cut}", DEADLINE_S)
            well_s.append(time.monotonic() - healed_s)
            progress(f"{cut.place} {cut.kind} {cut.seconds:g} s at {start_s:.0f} s: well after {well_s[-1]:.1f} s")
        time.sleep(max(AFTER_S, began_s + run_s - time.monotonic()))
        return well_s

    def end(self) -> tuple[int, dict[str, int]]:
        """Stop it in the order of the data flow; the samples that were sent, and what each process has lost."""
        sent = self._device.end(DEADLINE_S)["samples_sent"]
        time.sleep(2.0)
        lost: dict[str, int] = {}
        for stage in STAGES:
            lost.update(self._ups[stage].end(DEADLINE_S)["lost"])
        return sent, lost

    def close(self) -> None:
        """Leave nothing."""
        self._bus.close()
        for process in (*self._ups.values(), self._device, *self._running.values()):
            process.kill()
        for host in self._hosts.values():
            host.kill()

    def _start_router(self, number: int) -> None:
        words = ["router", "--listen", self._routers[number], "--insecure"]
        for other in self._routers[:number]:
            words += ["--connect", other]
        self._running[number] = Process(words, self._folder / f"router{number}")

    def _up(self, stage: str) -> Process:
        words = ["up", "-c", self._folder / "site.toml", "--json", "--insecure"]
        words += ["--set", f"launcher.stages={json.dumps([stage])}"]
        words += ["--set", f"run_folder='{self._folder / stage}'"]
        words += [word for setting in self._settings for word in ("--set", setting)]
        return Process(words, self._folder / stage, self._hosts[stage])

    def _apply(self, cut: Cut) -> Callable[[], None]:
        """Begin it; returns what ends it."""
        if cut.place == "router":
            self._running[0].kill()
            return lambda: self._start_router(0)
        host = self._hosts[cut.place]
        if cut.kind == "cut":
            host.cut()
            return host.heal
        for chain in {"deaf": ["INPUT"], "mute": ["OUTPUT"]}.get(cut.kind, ["INPUT", "OUTPUT"]):
            above = ["-m", "hashlimit", "--hashlimit-name", chain, "--hashlimit-above", SLOW]
            above += ["--hashlimit-burst", SLOW.removesuffix("/s")]
            share = ["-m", "statistic", "--mode", "random", "--probability", "0.2"]
            which = {"slow": above, "lossy": share}.get(cut.kind, [])
            _iptables(host, "-A", chain, *which, "-j", "DROP")
        return lambda: _iptables(host, "-F")

    def _is_well(self) -> bool:
        """Whether all are there and at work, and everything is up to date, in the scores and in the recorder."""
        views = {view.health.stage: view for view in self._watcher.stages() if view.alive}
        is_there = len(views) == len(STAGES) and all(_is_at_work(view) for view in views.values())
        is_new = time.time_ns() - self._newest_ns < BEHIND_S * NS_PER_S
        return is_there and is_new and all(_has(views["recorder"], views[stage]) for stage in STAGES[:-1])

    def _hear(self, _key: str, payload: bytes) -> None:
        self._newest_ns = max(self._newest_ns, int(decode(Score, payload).t_ns[-1]))


def _is_at_work(view: StageView) -> bool:
    age_s = (time.time_ns() - view.health.t_ns) / NS_PER_S
    return age_s < BEHIND_S and view.health.status == StageStatus.OK


def _has(recorder: StageView, producer: StageView) -> bool:
    """Whether the recorder is up to date with a stage."""
    had = {line.key: line.received + line.missing for line in recorder.health.inputs}
    outputs = [output for output in producer.health.outputs if output.key in had]
    return all(output.published - had[output.key] < BEHIND_MESSAGES for output in outputs)


def _iptables(host: Host, *words: str) -> None:
    subprocess.run([*host.inside, "iptables", *words], check=True)


if __name__ == "__main__":
    typer.run(main)

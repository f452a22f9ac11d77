"""A fleet on the whole chain: processor time of each stage for a fan-sample, what is lost, found and raised falsely.

The raw samples of a simulated data hall are published in real time, in messages of a length, to `fantwin up` with
resampler, integrator, scorer and recorder on this machine. Some fans lose speed for a while, one after the other. If
the stages are slower than real time, the feed waits for them, and `rate` says what was reached.

    python -m bench.fleet.whole_chain --fans 10000
"""

from __future__ import annotations

import json
import math
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from bench.fleet.hall import FAULT_S, PRODUCER, SITE, Hall, HallFault
from bench.fleet.stage_cost import calibrated_twin
from bench.printing import JsonOption, progress, show
from bench.runtime.stage_memory import free_endpoint, memory_mb
from bench.training.published_fan import RATE_HZ
from fantwin.pipeline.bus.recovery import ALL_PRODUCERS, recovery_key
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.codec import decode, encode, type_name
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm, Raw, Score
from fantwin.schemas.topics import BY_NAME, tray_key
from fantwin.schemas.units import NS_PER_S

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.running_chain import RunningCommand, eventually

STAGES = ("resampler", "twin_integrator", "scorer", "recorder")
BEGINNING_S = 30.0
"""time in which the fans become known; it is not measured"""
ANSWER_S = 4.0
LATE_S = 10.0
"""an alarm may come so long after the end of its fault"""
DEADLINE_S = 1800.0
BUSY = "watchdog_s = 300\n"


@dataclass
class Measured:
    """Of one process at one time: processor time in s, resident memory in MB."""

    cpu_s: float
    memory_mb: float


Raised: TypeAlias = list[tuple[str, int, float]]
"""tray, fan and time since the first sample of each alarm"""


def main(
    fans: Annotated[int, typer.Option(help="Of the hall, at 100 Hz.")] = 5000,
    fans_of_tray: Annotated[int, typer.Option(help="At most.")] = 500,
    block_s: Annotated[float, typer.Option(help="Length of the messages.")] = 0.1,
    seconds: Annotated[float, typer.Option(help="That are measured.")] = 60.0,
    faults: Annotated[int, typer.Option(help="Fans that lose 15 % of their speed for 20 s.")] = 10,
    shards: Annotated[int, typer.Option(min=1, help="Of integrator and scorer.")] = 2,
    json_output: JsonOption = False,
) -> None:
    """Print the cost of a fan-sample by stage, the rate that was reached, losses and alarms."""
    with tempfile.TemporaryDirectory() as folder:
        progress("training and calibrating the twin")
        twin = calibrated_twin(Path(folder))
        progress("simulating the hall")
        hall = Hall(fans, fans_of_tray, block_s)
        rows, about = run(
            hall, hall.faults(faults, BEGINNING_S, BEGINNING_S + seconds - FAULT_S), seconds, shards, twin
        )
    show({"processor time by stage": rows, "the hall": [about]}, [], as_json=json_output)


def run(
    hall: Hall, faults: list[HallFault], seconds: float, shards: int, twin: Path
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows of the two tables."""
    endpoint = free_endpoint()
    configuration = twin.parent / "site.toml"
    tables = f'[[tray]]\nname = "{{}}"\nfans = {hall.fans_of_tray}\ntwin = "{twin}"\n'
    configuration.write_text(
        f'site = "{SITE}"\nrun_folder = "runs"\n[launcher]\nstages = {json.dumps(STAGES)}\n'
        f"shards = {{ twin_integrator = {shards}, scorer = {shards} }}\n{BUSY}"
        f'[bus]\nendpoint = "{endpoint}"\n[resampler]\nrate_hz = {RATE_HZ:g}\nwatermark_s = 600\n'
        + "".join(tables.format(name) for name in hall.names)
    )
    raised: Raised = []
    epoch_ns, waits_s = time.time_ns(), 3 * hall.block / RATE_HZ
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        _listen(bus, raised, epoch_ns)
        watcher, scores = SiteWatcher(bus, SITE), NewestScores(bus, hall, epoch_ns)
        up = RunningCommand(["up", "-c", configuration, "--json"])
        try:
            processes = 2 + 2 * shards
            eventually(lambda: len(_at_work(watcher)) == processes, "all stages are at work", DEADLINE_S)
            send = _sender(bus, hall, epoch_ns, faults)
            progress(f"the first {BEGINNING_S:g} s")
            send(BEGINNING_S)
            eventually(lambda: scores.have_reached(BEGINNING_S - waits_s), "they are scored", DEADLINE_S)
            before, began_s = _measured(watcher), time.monotonic()
            progress(f"measuring for {seconds:g} s")
            send(seconds / 2)
            halfway = _measured(watcher)
            send(seconds / 2)
            end_s = BEGINNING_S + seconds
            eventually(lambda: scores.have_reached(end_s - waits_s), "the last are scored", DEADLINE_S)
            took_s, after = time.monotonic() - began_s, _measured(watcher)
            status = up.end()
            assert status in (0, 3), (status, up.lines[-20:])
            lost = sum(up.output()["lost"].values())
        finally:
            up.kill()
    fan_samples = hall.fans * seconds * RATE_HZ
    rows = list(_rows((before, halfway, after), fan_samples, hall.fans))
    recorded = sum(path.stat().st_size for path in (twin.parent / "runs").glob("*.mcap"))
    return rows, {
        "fans": hall.fans,
        "trays": hall.trays,
        "message, s": hall.block / RATE_HZ,
        "rate": seconds / took_s,
        "cores": sum(row["cpu s"] for row in rows[:-1]) / took_s,
        "lost": lost,
        "faults": len(faults),
        **_alarms(hall, faults, raised),
        "bytes recorded": recorded / (hall.fans * (BEGINNING_S + seconds) * RATE_HZ),
    }


def _sender(bus: Bus, hall: Hall, epoch_ns: int, faults: list[HallFault]) -> Callable[[float], None]:
    """Sends the next so many seconds, in real time, or as fast as they are taken."""
    topic = BY_NAME["raw"]
    publishers = [bus.publisher(tray_key(SITE, name, "raw"), topic, type_name(Raw), PRODUCER) for name in hall.names]
    messages = hall.messages(epoch_ns, faults)
    block_s = hall.block / RATE_HZ

    def send(seconds: float) -> None:
        began_s = time.monotonic()
        for number in range(round(seconds / block_s)):
            for publisher, raw in zip(publishers, next(messages), strict=True):
                publisher.put(encode(raw))
            time.sleep(max(0.0, began_s + (number + 1) * block_s - time.monotonic()))

    return send


def _listen(bus: Bus, raised: Raised, epoch_ns: int) -> None:
    def on_alarm(key: str, payload: bytes) -> None:
        alarm = decode(Alarm, payload)
        if alarm.transition == Transition.RAISED:
            raised.append((key.split("/")[2], alarm.fan, (alarm.t_ns - epoch_ns) / NS_PER_S))

    bus.subscribe(tray_key(SITE, "*", "alarm"), on_alarm)


class NewestScores:
    """Until when each tray is scored, asked of the scorers: to receive all scores would cost as much as a stage."""

    def __init__(self, bus: Bus, hall: Hall, epoch_ns: int) -> None:
        self._bus, self._epoch_ns = bus, epoch_ns
        self._keys = [tray_key(SITE, name, "score") for name in hall.names]

    def have_reached(self, seconds: float) -> bool:
        """Whether all trays are scored until then, but for what waits for the next message."""
        return all(self._until_s(key) >= seconds for key in self._keys)

    def _until_s(self, key: str) -> float:
        replies = self._bus._session.get(f"{recovery_key(key, ALL_PRODUCERS)}?newest=1", timeout=ANSWER_S)
        newest_ns = [int(decode(Score, reply.ok.payload.to_bytes()).t_ns[-1]) for reply in replies if reply.ok]
        return (max(newest_ns) - self._epoch_ns) / NS_PER_S if newest_ns else -math.inf


def _at_work(watcher: SiteWatcher) -> list[tuple[str, int]]:
    """Stage and process of those that are at work."""
    views = [view for view in watcher.stages() if view.alive and view.health.stage in STAGES]
    return [(view.health.stage, view.health.process_id) for view in views]


def _measured(watcher: SiteWatcher) -> dict[str, Measured]:
    """Of the processes of each stage together."""
    found = {stage: Measured(0.0, 0.0) for stage in STAGES}
    for stage, process_id in _at_work(watcher):
        words = Path(f"/proc/{process_id}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        found[stage].cpu_s += sum(map(int, words[11:13])) / os.sysconf("SC_CLK_TCK")
        found[stage].memory_mb += memory_mb(process_id)[1]
    return found


def _rows(measured: Sequence[dict[str, Measured]], fan_samples: float, fans: int) -> Iterator[dict[str, Any]]:
    """measured: at the beginning, halfway and at the end."""
    all_s, moments = 0.0, ("MB before", "halfway", "after")
    for stage in STAGES:
        cpu_s = measured[-1][stage].cpu_s - measured[0][stage].cpu_s
        all_s += cpu_s
        memory = {moment: each[stage].memory_mb for moment, each in zip(moments, measured, strict=True)}
        yield {"stage": stage, **_cost(cpu_s, fan_samples), **memory, "MB a fan": memory[moments[-1]] / fans}
    yield {"stage": "all", **_cost(all_s, fan_samples), **dict.fromkeys((*moments, "MB a fan"))}


def _cost(cpu_s: float, fan_samples: float) -> dict[str, Any]:
    us = cpu_s / fan_samples * 1e6
    return {"cpu s": cpu_s, "us a fan-sample": us, "fans at 100 Hz a core": round(1e6 / (us * RATE_HZ)) if us else None}


def _alarms(hall: Hall, faults: list[HallFault], raised: Raised) -> dict[str, Any]:
    """How many faults were found, and how many alarms are of none."""
    delays_s: dict[HallFault, float] = {}
    false = 0
    for tray, fan, t_s in raised:
        of = [
            fault
            for fault in faults
            if (hall.names[fault.tray], fault.fan) == (tray, fan) and 0.0 <= t_s - fault.start_s <= FAULT_S + LATE_S
        ]
        false += not of
        for fault in of:
            delays_s.setdefault(fault, t_s - fault.start_s)
    return {
        "found": len(delays_s),
        "median delay, s": statistics.median(delays_s.values()) if delays_s else None,
        "false": false,
    }


if __name__ == "__main__":
    typer.run(main)

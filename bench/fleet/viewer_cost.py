"""What a fleet costs the viewer: the time of the processor for each fan-sample, and as a share of one core.

The scores of a made-up fleet are made beforehand, a second at a time, and handed over as the runner does: header read,
sequence checked, core stepped, and a tick every 50 ms of the data's time. The view goes to a file and is served, with
nobody watching. All threads of this process count, Rerun's, too; the bus does not, it is not in this process:
`bench.fleet.viewer_on_bus`.

    python -m bench.fleet.viewer_cost
    python -m bench.fleet.viewer_cost --fans 1000 --seconds 20 --profile
"""

from __future__ import annotations

import cProfile
import pstats
import resource
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from bench.detection.plant import START_NS
from bench.fleet.fleet_scores import SITE, FleetScores
from bench.printing import JsonOption, progress, show
from fantwin.pipeline.runtime.runner import TICK_S
from fantwin.pipeline.runtime.sequence_tracker import Found, SequenceTracker
from fantwin.pipeline.runtime.stage import Context, Core
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.viewer import ViewerConfig, build

BLOCKS_S = (0.05, 0.1, 1.0)
FLEETS = (1_000, 10_000)
ALARMS_A_MINUTE = 10
AnyResult = TypeVar("AnyResult")


@dataclass
class ViewerCost:
    """Of some seconds of data.

    Attributes:
        seconds: of the processor, by what it did.
        file_bytes: of the view.
        peak_mb: the largest memory of this process so far, MB.
        counters: of the core.
    """

    seconds: dict[str, float] = field(default_factory=dict[str, float])
    file_bytes: int = 0
    peak_mb: float = 0.0
    counters: dict[str, int] = field(default_factory=dict[str, int])

    def add(self, name: str, seconds: float) -> None:
        """Of one part."""
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def main(
    fans: Annotated[int, typer.Option(help="Of the fleet; 0: 1,000 and 10,000.")] = 0,
    seconds: Annotated[int, typer.Option(help="Of data, for each row.")] = 60,
    profile: Annotated[bool, typer.Option(help="Print where the time goes, of this thread, to stderr.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Print microseconds for each fan-sample and the share of a core at 100 Hz, by fans and length of the messages."""
    rows: list[dict[str, Any]] = []
    for count in (fans,) if fans else FLEETS:
        for block_s in BLOCKS_S:
            progress(f"{count} fans, messages of {block_s:g} s")
            fleet = FleetScores(count, block_s=block_s)
            fleet.add_excursions(max(1, seconds * ALARMS_A_MINUTE // 60), 0.1 * seconds, 0.9 * seconds)
            profiler = cProfile.Profile() if profile else None
            with tempfile.TemporaryDirectory() as folder:
                cost = cost_of(fleet, seconds, Path(folder), profiler)
            rows.append(_row(fleet, seconds, cost))
            if profiler:
                pstats.Stats(profiler, stream=sys.stderr).sort_stats("tottime").print_stats(25)
    notes = ["receive: header and sequence; step, tick: of the core; peak: of this process, all rows before included"]
    show({"the viewer at 100 Hz": rows}, notes, as_json=json_output)


def cost_of(fleet: FleetScores, seconds: int, folder: Path, profiler: cProfile.Profile | None = None) -> ViewerCost:
    """What some seconds of a fleet cost, from an empty view to its end."""
    viewer = _Viewer(build(_context(fleet, folder)).core)
    for number in range(seconds):
        messages = fleet.second(number)
        if profiler:
            profiler.enable()
        for message in messages:
            viewer.take(message)
        if profiler:
            profiler.disable()
    cost = viewer.close()
    cost.file_bytes = (folder / ViewerConfig().file).stat().st_size
    cost.peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return cost


class _Viewer:
    """The core and what its runner does for it."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self._tracker = SequenceTracker(lambda _request: Found(was_asked=False))
        self._cost = ViewerCost()
        self._next_tick_ns = START_NS

    def take(self, message: Envelope | Alarm) -> None:
        """What is sent reaches the viewer; then its time has come."""
        if isinstance(message, Alarm):
            t_ns = message.t_ns
            self._run("step", lambda: self._core.step(message))
        else:
            t_ns = message.received_t_ns
            for due in self._run("receive", lambda: self._tracker.accept(message)):
                self._run("step", lambda due=due: self._core.step(due))
        while self._next_tick_ns <= t_ns:
            self._run("tick", lambda: self._core.tick(self._next_tick_ns))
            self._next_tick_ns += round(TICK_S * NS_PER_S)

    def close(self) -> ViewerCost:
        """End the view."""
        self._run("close", self._core.close)
        self._cost.counters = dict(self._core.counters())
        return self._cost

    def _run(self, name: str, part: Callable[[], AnyResult]) -> AnyResult:
        began_s = time.process_time()
        result = part()
        self._cost.add(name, time.process_time() - began_s)
        return result


def _context(fleet: FleetScores, folder: Path) -> Context:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    config = ViewerConfig(grpc_port=port, web_port=0)
    return Context(
        site=SITE, trays=tuple(fleet.trays), config=config, folder=folder, run_folder=folder, started_t_ns=START_NS
    )


def _row(fleet: FleetScores, seconds: int, cost: ViewerCost) -> dict[str, Any]:
    fan_samples = fleet.fans * fleet.rate_hz * seconds
    total_s = sum(cost.seconds.values())
    return {
        "fans": fleet.fans,
        "message, s": fleet.block_s,
        **{f"{name}, us": cost.seconds[name] / fan_samples * 1e6 for name in ("receive", "step", "tick", "close")},
        "sum, us": total_s / fan_samples * 1e6,
        "% of a core": 100.0 * total_s / seconds,
        "file, kB/s": cost.file_bytes / seconds / 1e3,
        "peak, MB": cost.peak_mb,
        "samples drawn": cost.counters["samples_drawn"],
    }


if __name__ == "__main__":
    typer.run(main)

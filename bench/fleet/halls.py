"""What the benches of halls share: what a process takes, and which samples came when."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.fleet.redfish_controllers import Hall, Plan
from bench.printing import progress
from bench.runtime.stage_memory import free_endpoint
from fantwin.pipeline.acquisition.raw_samples import RawSamples
from fantwin.schemas.units import NS_PER_S


def received(arriving: RawSamples, seconds: float) -> tuple[Mapping[str, list[int]], list[float]]:
    """Times of the samples by tray, and how long after its reading each was received."""
    times_ns: dict[str, list[int]] = defaultdict(list)
    delays_s: list[float] = []
    until_s = time.monotonic() + seconds
    arriving.take()
    while (left_s := until_s - time.monotonic()) > 0:
        for raw in arriving.take(left_s):
            now_ns = time.time_ns()
            times_ns[raw.header.tray] += raw.host_receive_t_ns.tolist()
            delays_s += [(now_ns - t_ns) / NS_PER_S for t_ns in raw.host_receive_t_ns.tolist()]
    return times_ns, delays_s


def samples_by_kind(
    groups: Mapping[str, Sequence[str]], times_ns: Mapping[str, list[int]], due: float, first: str
) -> Iterator[dict[str, Any]]:
    """Which of the samples that were due came of each kind of device, those of kinds that begin with `first` first."""
    for kind, trays in sorted(groups.items(), key=lambda each: not each[0].startswith(first)):
        shares = [len(times_ns[tray]) / due for tray in trays]
        apart_s = np.concatenate([np.diff(sorted(times_ns[tray])) for tray in trays]) / NS_PER_S
        yield {
            "kind": kind,
            "number": len(trays),
            "of the due samples, %": 100.0 * float(np.mean(shares)),
            "least": 100.0 * min(shares),
            "apart, s (99 %)": float(np.quantile(apart_s, 0.99)) if len(apart_s) else float("nan"),
            "at most": float(apart_s.max()) if len(apart_s) else float("nan"),
        }


def run_fantwin(words: str) -> str:
    """Run a command that has to succeed; what it prints."""
    done = subprocess.run(
        [sys.executable, "-m", "fantwin", *words.split()], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def twin_of_hall(plan: Plan, folder: Path, period_s: float, seconds: float, how: str) -> Path:
    """A calibrated twin of the fans, from tables of what three of them did, sampled like the hall. how: options."""
    progress("learning the twin")
    hall, twin = Hall(plan), folder / "twin.onnx"
    for fan in range(3):
        at_s = np.arange(0.0, seconds, period_s)
        rows = [f"{t:g},{u:g},{y:g}" for t, (u, y) in ((t, hall.fan(fan + 1, 0, float(t))) for t in at_s)]
        (folder / f"{fan}.csv").write_text("\n".join(["t,u,y", *rows, ""]), encoding="ascii")
        table = f"import {folder}/{fan}.csv --time t:s --command u --speed y:rpm -o {folder}/{fan}.mcap"
        run_fantwin(table)
    run_fantwin(f"train {folder}/0.mcap --validate {folder}/1.mcap {how} -o {twin}")
    run_fantwin(f"calibrate {twin} {folder}/1.mcap {folder}/2.mcap --false-alarms-per-day 1 --extrapolate")
    return twin


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    return int(free_endpoint().rpartition(":")[2])


def cpu_s(process: int) -> float:
    """Processor time of a process so far."""
    words = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return sum(map(int, words[11:13])) / os.sysconf("SC_CLK_TCK")

"""What the benches of halls share: what a process takes, and which samples came when."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

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


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    return int(free_endpoint().rpartition(":")[2])


def cpu_s(process: int) -> float:
    """Processor time of a process so far."""
    words = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return sum(map(int, words[11:13])) / os.sysconf("SC_CLK_TCK")

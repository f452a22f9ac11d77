"""What learning costs a running site: latency of its scores beside `twins learn` and without it, memory and time.

A simulated tray of eight fans at 100 Hz under `fantwin up`, which learns its first twin from a healthy history that is
there already; then `twins learn` beside the running site, and as long without. The latency of a score is the time
from a sample's receipt to the end of its scoring, which the scorer reports in its health for the last ten seconds.

    python -m bench.runtime.learning_cost
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bench.printing import progress
from bench.runtime.stage_memory import free_endpoint, memory_mb
from bench.training.published_fan import RATE_HZ, ROUGH_RANGE, published_fan, random_stairs
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.learning.child_command import VARIABLE
from fantwin.pipeline.learning.healthy_history import HealthyHistory
from fantwin.pipeline.learning.versions import TwinVersions, learning_folder
from fantwin.pipeline.selftest.scratch_site import FANTWIN
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S

FANS, SITE, TRAY = 8, "site", "tray1"
HISTORY_S = 600.0
SAMPLED_S = 1.0


def write_history(folder: Path) -> None:
    """Ten minutes of healthy running of other fans: how long learning takes depends on their number and the time."""
    history = HealthyHistory(folder, SITE, TRAY, {"trays": TRAY}, {}, hold_back_s=0.0, kept_s=1e9)
    command = random_stairs(1, HISTORY_S, FANS, *ROUGH_RANGE)
    run = published_fan(command, 1, "history").run
    for number, first in enumerate(range(0, len(run.t_s), 1000)):
        rows = slice(first, first + 1000)
        t_ns = 1_700_000_000 * NS_PER_S + (np.arange(len(run.t_s))[rows] / RATE_HZ * NS_PER_S).astype(np.int64)
        samples = run.command[rows], run.speed_rad_s[rows]
        header = Header("acquisition", number, TRAY)
        raw = Raw(header=header, fans=FANS, host_receive_t_ns=t_ns, command=samples[0], speed_rad_s=samples[1])
        history.add(raw, has_alarm=False, is_watched=False)
    history.close()


class Latencies:
    """Of the scorer, sampled while something runs."""

    def __init__(self, watcher: SiteWatcher) -> None:
        self._watcher = watcher

    def now_ms(self) -> tuple[float, float] | None:
        """Median and 99th percentile of the last ten seconds."""
        healths = [view.health for view in self._watcher.stages() if view.alive and view.health.stage == "scorer"]
        return (healths[0].latency_p50_ms, healths[0].latency_p99_ms) if healths else None

    def during(self, is_over: Callable[[], bool]) -> list[tuple[float, float]]:
        """One pair a second until `is_over()`."""
        found = []
        while not is_over():
            time.sleep(SAMPLED_S)
            now = self.now_ms()
            found += [now] if now else []
        return found[10:]  # what is older is of before


def main() -> None:
    """Print the figures, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    as_json = parser.parse_args().json
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the site that it started ends with it
    with tempfile.TemporaryDirectory(prefix="fantwin-learning-") as name:
        found = measured(Path(name))
    if as_json:
        print(json.dumps(found))
        return
    for key, value in found.items():
        print(f"{key}: {value:.3g}")


def _started(words: list[str], **variables: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        words,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        env={**os.environ, **variables},
    )


def measured(folder: Path) -> dict[str, float]:
    """All figures."""
    endpoint = free_endpoint()
    config = folder / "fantwin.toml"
    config.write_text(
        f'run_folder = "runs"\n[bus]\nendpoint = "{endpoint}"\n[[tray]]\nname = "{TRAY}"\nfans = {FANS}\n'
        f'command_max = 100\nport = "{folder / "line"}"\n[viewer]\ngrpc_port = 0\n',
        encoding="utf-8",
    )
    place = learning_folder(folder / "runs", TRAY)
    write_history(place)
    versions = TwinVersions(place, TRAY)
    tray = _started([*FANTWIN, "simulate", "--fans", str(FANS), "--link", str(folder / "line")])
    up = _started([*FANTWIN, "up", "-c", str(config)])
    try:
        with Bus(BusConfig(endpoint=endpoint), listens=False) as bus:
            latencies = Latencies(SiteWatcher(bus, SITE))
            began_s = time.monotonic()
            progress("waiting for the first twin of the site: a few minutes")
            while not versions.all():
                for name, process in (("simulate", tray), ("up", up)):
                    if process.poll() is not None:
                        raise SystemExit(f"fantwin {name} has ended, status {process.returncode}")
                time.sleep(SAMPLED_S)
            first_s = time.monotonic() - began_s
            time.sleep(15.0)  # the twin takes over
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            began_s = time.monotonic()
            progress("latency beside fantwin twins learn, and for as long without it")
            learn = _started([*FANTWIN, "twins", "learn", "-c", str(config)], **{VARIABLE: "1"})
            peak_mb = [0.0]

            def is_over() -> bool:
                if learn.poll() is None:
                    peak_mb[0] = max(peak_mb[0], memory_mb(learn.pid)[0])
                return learn.poll() is not None

            beside = latencies.during(is_over)
            took_s = time.monotonic() - began_s
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            until_s = time.monotonic() + took_s
            without = latencies.during(lambda: time.monotonic() > until_s)
    finally:
        for process in (up, tray):
            process.terminate()
            process.wait()
    medians = {name: np.median(np.array(each), axis=0) for name, each in (("beside", beside), ("without", without))}
    return {
        "first version after, s": first_s,
        "learn: wall time, s": took_s,
        "learn: processor time, s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "learn: largest memory, MB": peak_mb[0],
        "latency beside, median ms": float(medians["beside"][0]),
        "latency without, median ms": float(medians["without"][0]),
        "latency beside, 99 % ms": float(medians["beside"][1]),
        "latency without, 99 % ms": float(medians["without"][1]),
        "median beside / without": float(medians["beside"][0] / medians["without"][0]),
        "99 % beside / without": float(medians["beside"][1] / medians["without"][1]),
    }


if __name__ == "__main__":
    sys.exit(main())

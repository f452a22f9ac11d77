"""A site in wall time with one fault after another: does anything hang, get lost without a count, or alarm falsely?

The faults are those of `fantwin doctor selftest` that need not lose recorded data, in random order. After each, all
fans must be judged again and no alarm may have been raised. At the end the site stops in order, and its recording is
verified.

    python -m bench.runtime.soak --minutes 30 --seeds 1 2 3
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

from fantwin.pipeline.cli.watch.selftest import simulated_tray
from fantwin.pipeline.selftest.scenarios import SCENARIOS
from fantwin.pipeline.selftest.scratch_site import STAGES, NotKept, ScratchSite
from fantwin.pipeline.selftest.selftest import Row, account, run_scenario

LOSING = {"deleted", "full-disk"}
SHARED = [scenario for scenario in SCENARIOS if scenario.name not in LOSING]


def soak(minutes: float, seed: int, folder: Path) -> tuple[list[Row], dict[str, tuple[float, ...]]]:
    """The rows of all faults, and the largest memory of each stage in the first and in the last third, MB."""
    rng = random.Random(seed)
    rows: list[Row] = []
    memory: list[dict[str, float]] = []
    with ScratchSite(folder, simulated_tray()) as site:
        until_s = time.monotonic() + 60.0 * minutes
        while time.monotonic() < until_s:
            row = run_scenario(site, rng.choice(SHARED))
            rows.append(row)
            kept = "kept" if row.kept else "NOT KEPT"
            print(f"seed {seed}: {kept}: {row.name}: {row.seen}", file=sys.stderr, flush=True)
            with suppress(NotKept):  # a stage that is not there is reported by its row
                memory.append({label: site.memory_bytes(label) / 1e6 for label in STAGES})
        rows.append(account(site, "all faults"))
    third = max(1, len(memory) // 3)
    parts = (memory[:third], memory[-third:])
    return rows, {label: tuple(max(each[label] for each in part) for part in parts) for label in STAGES}


@contextmanager
def _folder(keep: Path | None, seed: int) -> Iterator[Path]:
    """Where a seed's site runs: a new folder in `keep`, or one that is removed at the end."""
    if keep is not None:
        (keep / f"seed-{seed}").mkdir(parents=True)
        yield keep / f"seed-{seed}"
        return
    with tempfile.TemporaryDirectory(prefix="fantwin-soak-") as folder:
        yield Path(folder)


def main() -> None:
    """Print a line for each seed, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0, help="wall time of each seed (default 30)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3], help="of the order of faults")
    parser.add_argument("--keep", type=Path, help="a folder in which each seed's site and recordings stay")
    parser.add_argument("--json", action="store_true", help="print all rows as JSON")
    options = parser.parse_args()
    for seed in options.seeds:
        with _folder(options.keep, seed) as folder:
            rows, memory = soak(options.minutes, seed, folder)
        if options.json:
            print(json.dumps({"seed": seed, "rows": [asdict(row) for row in rows], "memory_mb": memory}))
            continue
        kept = sum(bool(row.kept) for row in rows)
        grown = ", ".join(f"{label} {first:.0f}, {last:.0f}" for label, (first, last) in memory.items())
        seen = f"{kept} of {len(rows)} kept; {rows[-1].seen}"
        print(f"seed {seed}: {seen}; memory in the first and last third, MB: {grown}", flush=True)


if __name__ == "__main__":
    main()

"""Memory and import time of each stage of the demo at rest, against Python with what that stage truly needs.

Each stage runs as the launcher starts it, on a bus of its own, until it is alive and idle. Beside it a bare Python
imports the third-party packages that the stage needs (`NEEDS`) and opens a bus session. Memory is PSS, which shares
common pages among processes, and RSS, which does not. The ratio of RSS may be at most 1.3.

    python -m bench.runtime.stage_memory
    python -m bench.runtime.stage_memory --source FOLDER   # another checkout, to compare with
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "pipeline" / "demo" / "demo.toml"
COMMON = (  # pydantic and protobuf import most of what they need only when it is used
    "numpy",
    "pydantic.main",
    "pydantic.fields",
    "pydantic.functional_validators",
    "google.protobuf.internal.builder",
    "zenoh",
)
NEEDS: dict[str, tuple[str, ...]] = {
    "acquisition": (*COMMON, "serial", "cobs.cobs"),
    "resampler": COMMON,
    "twin_integrator": (*COMMON, "scipy.signal", "onnxruntime"),
    "scorer": (*COMMON, "scipy.special"),
    "recorder": (*COMMON, "mcap.writer", "zstandard"),
    "viewer": (
        *COMMON,
        "rerun",
        "rerun.blueprint",
        "pyarrow",
        "pandas",
    ),  # pyarrow imports pandas where it is installed
}
LIMIT = 1.3
READY_S = 60.0
SETTLE_S = 3.0

BARE = """
import sys, time
from importlib import import_module
from importlib.util import find_spec
start = time.perf_counter()
for name in sys.argv[2:]:
    if name != "pandas" or find_spec(name):
        import_module(name)
print(time.perf_counter() - start, flush=True)
import zenoh
conf = zenoh.Config()
conf.insert_json5("listen/endpoints", f'["{sys.argv[1]}"]')
conf.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(conf):
    sys.stdin.read()
"""
IMPORT_TIME = """
import sys, time
from importlib import import_module
start = time.perf_counter()
import_module("fantwin.pipeline.cli.watch.one_stage")
from fantwin.pipeline.config.loading import load_config
load_config(__import__("pathlib").Path(sys.argv[2]), (), (sys.argv[1],))
import_module(f"fantwin.stages.{sys.argv[1]}")
print(time.perf_counter() - start)
"""


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def memory_mb(process_id: int) -> tuple[float, float]:
    """RSS and PSS, MB."""
    lines = Path(f"/proc/{process_id}/smaps_rollup").read_text().splitlines()[1:]
    kb = {line.split(":")[0]: int(line.split()[1]) for line in lines}
    return kb["Rss"] / 1000, kb["Pss"] / 1000


def settled_mb(process: subprocess.Popen[Any]) -> tuple[float, float]:
    """Memory once it has stopped growing."""
    before, until_s = memory_mb(process.pid), time.monotonic() + READY_S
    while time.monotonic() < until_s:
        time.sleep(SETTLE_S)
        now = memory_mb(process.pid)
        if now[0] - before[0] < 0.5:
            return now
        before = now
    return before


def bare(stage: str, environment: dict[str, str]) -> tuple[float, float, float]:
    """RSS, PSS in MB and import time in seconds of a Python that imports the needs of a stage."""
    command = [sys.executable, "-P", "-c", BARE, free_endpoint(), *NEEDS[stage]]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout and process.stdin
        import_s = float(process.stdout.readline())
        memory = settled_mb(process)
        process.stdin.close()
    return (*memory, import_s)


def at_rest(stage: str, folder: Path, environment: dict[str, str]) -> tuple[float, float]:
    """RSS and PSS in MB of a stage without input."""
    settings = [f"bus.endpoint='{free_endpoint()}'", f"run_folder='{folder / stage}'", "viewer.grpc_port=0"]
    command = [sys.executable, "-P", "-m", "fantwin", "up", "--only", stage, "-c", str(DEMO), "--until-stdin-closes"]
    if stage == "acquisition":
        command += ["--tray", "tray1"]
    for setting in settings:
        command += ["--set", setting]
    with subprocess.Popen(command, stdin=subprocess.PIPE, env=environment, cwd=folder) as process:
        try:
            return settled_mb(process)
        finally:
            process.terminate()


def import_s(stage: str, environment: dict[str, str]) -> float:
    """Seconds to import a stage and check its section."""
    command = [sys.executable, "-P", "-c", IMPORT_TIME, stage, str(DEMO)]
    return float(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--source", type=Path, default=ROOT, help="the checkout that is measured")
    parser.add_argument("stages", nargs="*", default=list(NEEDS), help="which stages; without any, all")
    arguments = parser.parse_args()
    source = arguments.source.resolve()
    environment = os.environ | {"PYTHONPATH": str(source), "OMP_NUM_THREADS": "1", "ORT_DISABLE_TELEMETRY": "1"}
    print(f"{'stage':16} {'RSS MB':>8} {'PSS MB':>8} {'import s':>9}   {'bare':>8} {'PSS':>8} {'import s':>9}  ratio")
    total = 0.0
    with tempfile.TemporaryDirectory() as name:
        for stage in arguments.stages:
            rss, pss = at_rest(stage, Path(name), environment)
            seconds = import_s(stage, environment)
            bare_rss, bare_pss, bare_s = bare(stage, environment)
            ratio = rss / bare_rss
            total += rss
            print(
                f"{stage:16} {rss:8.1f} {pss:8.1f} {seconds:9.2f}   {bare_rss:8.1f} {bare_pss:8.1f} {bare_s:9.2f}"
                f"  {ratio:5.2f}{'' if ratio <= LIMIT else '  over the limit'}",
                flush=True,
            )
    print(f"all stages: {total:.0f} MB RSS")


if __name__ == "__main__":
    main()

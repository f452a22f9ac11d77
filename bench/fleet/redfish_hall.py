"""A hall of baseboard controllers asked by one process: processor time, memory, delay, and what a bad one costs others.

The controllers are simulated in another process (`redfish_controllers.py`); acquisition runs as `fantwin up` starts it.

    python -m bench.fleet.redfish_hall
    python -m bench.fleet.redfish_hall --tls --period-s 1
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from bench.fleet.halls import cpu_s, free_port, received, samples_by_kind
from bench.fleet.redfish_controllers import SHAPES, Plan
from bench.printing import JsonOption, progress, show
from bench.runtime.stage_memory import free_endpoint, memory_mb
from fantwin.pipeline.acquisition.raw_samples import RawSamples
from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.site.site_watcher import SiteWatcher

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.running_chain import RunningCommand, eventually

STARTS_S = 300.0
ORDINARY = "ordinary"


def main(
    controllers: Annotated[int, typer.Option(help="With two fans each.")] = 400,
    bad: Annotated[int, typer.Option(help="Controllers of each kind: broken, slow, silent, lying, dead.")] = 4,
    period_s: Annotated[float, typer.Option(help="Between two readings.")] = 1.0,
    seconds: Annotated[float, typer.Option(help="That are measured.")] = 60.0,
    tls: Annotated[bool, typer.Option("--tls", help="By HTTPS.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Print what acquisition takes, and by kind of controller which of the due samples came, and when."""
    plan = Plan(free_port(), controllers)
    for number, kind in enumerate(_BAD * bad):
        getattr(plan, kind).append((7 + 11 * number) % controllers)
    with tempfile.TemporaryDirectory() as folder:
        if tls:
            plan.certificate = _certificate(plan, Path(folder))
        with _served(plan) as server:
            about, rows = _measured(plan, Path(folder), period_s, seconds, server)
    show({"acquisition": [about], "samples by kind of controller": rows}, [], as_json=json_output)


_BAD = ("broken", "slow", "silent", "lying", "dead")


def _measured(
    plan: Plan, folder: Path, period_s: float, seconds: float, server: int
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    path = folder / "site.toml"
    path.write_text(_configuration(plan, period_s), encoding="utf-8")
    config = load_config(path, stages=())
    names = [tray.name for tray in config.trays]
    with join_bus(config) as bus:
        watcher, arriving = SiteWatcher(bus, config.site), RawSamples(bus, config.site, names)
        progress("starting acquisition")
        began_s = time.monotonic()
        up = RunningCommand(["up", "-c", path, "--json"])
        try:
            seen: set[str] = set()
            wanted = plan.controllers - len(plan.silent) - len(plan.dead) - len(plan.lying)

            def all_send() -> bool:
                seen.update(raw.header.tray for raw in arriving.take(0.5))
                return len(seen) >= wanted

            eventually(all_send, "all controllers that can be read are read", STARTS_S)
            started_s = time.monotonic() - began_s
            process = next(
                view.health.process_id for view in watcher.stages() if view.alive and view.health.stage == "acquisition"
            )
            began_cpu_s = [cpu_s(process), cpu_s(server)]
            progress(f"{len(seen)} controllers after {started_s:.0f} s; measuring for {seconds:g} s")
            times_ns, delays_s = received(arriving, seconds)
            used_s = [cpu_s(process) - began_cpu_s[0], cpu_s(server) - began_cpu_s[1]]
            about = {
                "controllers": plan.controllers,
                "period, s": period_s,
                "processes": 1,
                "threads": len(list(Path(f"/proc/{process}/task").iterdir())),
                "core, %": 100.0 * used_s[0] / seconds,
                "us a controller and reading": 1e6 * used_s[0] / (plan.controllers * seconds / period_s),
                "RSS, MB": memory_mb(process)[1],
                "all read after, s": started_s,
                "delay to the bus, ms": 1e3 * float(np.median(delays_s)),
                "99 %, ms": 1e3 * float(np.quantile(delays_s, 0.99)),
                "controllers' core, %": 100.0 * used_s[1] / seconds,
            }
            up.end()
        finally:
            up.kill()
    return about, list(_rows(plan, config, times_ns, seconds / period_s))


def _rows(plan: Plan, config: Config, times_ns: Mapping[str, list[int]], due: float) -> Iterator[dict[str, Any]]:
    bad = {number: kind for kind in _BAD for number in getattr(plan, kind)}
    names = {plan.address(number).replace(".", "-"): number for number in range(plan.controllers)}
    groups: dict[str, list[str]] = defaultdict(list)
    for tray in config.trays:
        number = names[tray.name]
        groups[bad.get(number, f"{ORDINARY}: {list(SHAPES)[number % len(SHAPES)]}")].append(tray.name)
    yield from samples_by_kind(groups, times_ns, due, first=ORDINARY)


def _configuration(plan: Plan, period_s: float) -> str:
    scheme = "https" if plan.certificate else "http"
    trays = ""
    for shape, command in enumerate(SHAPES.values()):
        hosts = [plan.address(number) for number in range(shape, plan.controllers, len(SHAPES))]
        source = {"kind": "redfish", "url": f"{scheme}://{{host}}:{plan.port}", "command": command}
        keys = "".join(f"{key} = {json.dumps(value)}\n" for key, value in source.items() if value)
        verify = f"verify = {json.dumps(plan.certificate)}\n" if plan.certificate else ""
        trays += (
            f'[[tray]]\nhosts = {json.dumps(hosts)}\nfans = 2\nspeed_unit = "rpm"\nspeed_max = 50000\n'
            f"command_max = 100\n[tray.source]\n{keys}{verify}period_s = {period_s:g}\n"
        )
    bus = f'bus = {{ endpoint = "{free_endpoint()}" }}'
    return f'run_folder = "runs"\n{bus}\nlauncher = {{ stages = ["acquisition"] }}\n{trays}'


@contextmanager
def _served(plan: Plan) -> Iterator[int]:
    """The controllers, in a process; its id."""
    words: Sequence[str] = [sys.executable, "-m", "bench.fleet.redfish_controllers", json.dumps(asdict(plan))]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stdout.readline() == "serving\n"
        try:
            yield process.pid
        finally:
            process.terminate()


def _certificate(plan: Plan, folder: Path) -> str:
    import trustme  # noqa: PLC0415

    authority = trustme.CA()
    own = authority.issue_cert(*(plan.address(number) for number in range(plan.controllers)))
    path = folder / "all.pem"
    own.private_key_and_cert_chain_pem.write_to_path(str(path))
    authority.cert_pem.write_to_path(str(path), append=True)
    return str(path)


if __name__ == "__main__":
    typer.run(main)

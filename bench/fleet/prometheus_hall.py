"""A hall behind one real Prometheus, which scrapes an exporter of each node: processor time, memory, delay from scrape
to sample, and what a bad node costs.

The exporters are simulated in another process (`metrics_of_nodes.py`); `fantwin init` writes the configuration, and
acquisition runs as `fantwin up` starts it.

    python -m bench.fleet.prometheus_hall
    python -m bench.fleet.prometheus_hall --controllers 20 --period-s 2 --seconds 30
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import time
import tomllib
import urllib.request
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from bench.fleet.halls import cpu_s, free_port, received, samples_by_kind
from bench.fleet.metrics_of_nodes import BAD, EXPORTERS, FANS, Plan, fan_at
from bench.printing import JsonOption, progress, show
from bench.runtime.stage_memory import free_endpoint, memory_mb
from fantwin.pipeline.acquisition.raw_samples import RawSamples
from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.sources.found import as_toml
from fantwin.schemas.codec import decode
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.running_chain import RunningCommand, eventually

STARTS_S = 300.0
ORDINARY = "ordinary"
LEARNED_PERIODS = 960


def main(
    controllers: Annotated[int, typer.Option(help="Nodes, with two fans each.")] = 400,
    bad: Annotated[int, typer.Option(help="Nodes of each kind that become dead, silent, broken and lying.")] = 4,
    period_s: Annotated[float, typer.Option(help="Between two scrapes, and between two queries.")] = 15.0,
    seconds: Annotated[float, typer.Option(help="That are measured.")] = 300.0,
    scored: Annotated[bool, typer.Option("--scored", help="Let a static twin judge the fans.")] = False,
    faulty: Annotated[int, typer.Option(help="Nodes with a fan that becomes 15 % slower, with --scored.")] = 0,
    known_for: Annotated[float, typer.Option(help="Periods before nodes become bad or faulty.")] = 0.0,
    json_output: JsonOption = False,
) -> None:
    """Print what acquisition takes, and by kind of node which of the due samples came, and when."""
    plan = Plan(free_port(), controllers)
    for number, kind in enumerate(BAD * bad):
        getattr(plan, kind).append((7 + 11 * number) % controllers)
    plan.faulty = [(3 + 17 * number) % controllers for number in range(faulty)]
    with tempfile.TemporaryDirectory() as folder:
        twin = _twin(Path(folder), period_s) if scored else None
        about, rows = _measured(plan, Path(folder), period_s, seconds, twin, known_for)
    show({"acquisition": [about], "samples by kind of node": rows}, [], as_json=json_output)


def _measured(
    plan: Plan, folder: Path, period_s: float, seconds: float, twin: Path | None, known_for: float
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    bad = {number: kind for kind in BAD for number in getattr(plan, kind)}
    words = _prometheus(plan, folder, period_s)
    with _running(_exporters(plan, folder)), _running(words) as prometheus:
        url = f"http://127.0.0.1:{words[-1].rpartition(':')[2]}"
        path, found, init_s = _configuration(plan, folder, url, twin)
        config = load_config(path, stages=())
        names = [tray.name for tray in config.trays]
        with join_bus(config) as bus:
            watcher, arriving = SiteWatcher(bus, config.site), RawSamples(bus, config.site, names)
            alarms, scored_s = list[Alarm](), list[float]()

            def add_score(_: str, payload: bytes) -> None:
                score = decode(Score, payload)
                if int(score.header.tray.removeprefix("node")) not in bad:
                    scored_s.append(time.time() - int(score.t_ns[-1]) / NS_PER_S)

            bus.subscribe(tray_key(config.site, "*", "alarm"), lambda _, payload: alarms.append(decode(Alarm, payload)))
            bus.subscribe(tray_key(config.site, "*", "score"), add_score)
            up = RunningCommand(["up", "-c", path, "--json"])
            try:
                seen: set[str] = set()

                def all_send() -> bool:
                    seen.update(raw.header.tray for raw in arriving.take(0.5))
                    return len(seen) >= plan.controllers

                eventually(all_send, "all nodes are read", STARTS_S)
                process = next(
                    view.health.process_id
                    for view in watcher.stages()
                    if view.alive and view.health.stage == "acquisition"
                )
                time.sleep(known_for * period_s)
                (folder / "bad").touch()
                time.sleep(4.0 * period_s)  # until Prometheus has left out what is dead
                before_s, queries = [cpu_s(process), cpu_s(prometheus.pid)], _queries(url)
                progress(f"{queries:g} queries so far; measuring for {seconds:g} s")
                scored_s.clear()
                times_ns, delays_s = received(arriving, seconds)
                used_s = [cpu_s(process) - before_s[0], cpu_s(prometheus.pid) - before_s[1]]
                about = {
                    "nodes": plan.controllers,
                    "period, s": period_s,
                    **found,
                    "init, s": init_s,
                    "processes": 1,
                    "threads": len(list(Path(f"/proc/{process}/task").iterdir())),
                    "queries a period": (_queries(url) - queries) * period_s / seconds,
                    "core, %": 100.0 * used_s[0] / seconds,
                    "us a node and scrape": 1e6 * used_s[0] / (plan.controllers * seconds / period_s),
                    "RSS, MB": memory_mb(process)[1],
                    "scrape to bus, s": float(np.median(delays_s)),
                    "99 %, s": float(np.quantile(delays_s, 0.99)),
                    "Prometheus' core, %": 100.0 * used_s[1] / seconds,
                    "its RSS, MB": memory_mb(prometheus.pid)[0],
                }
                if twin:
                    raised = {(each.header.tray, each.fan) for each in alarms if each.transition == Transition.RAISED}
                    wanted = {(f"node{number:03}", 0) for number in plan.faulty}
                    about |= {
                        "scrape to score, s": float(np.median(scored_s)),
                        "score 99 %, s": float(np.quantile(scored_s, 0.99)),
                        "faults found": f"{len(raised & wanted)} of {len(wanted)}",
                        "other alarms": ", ".join(f"{tray}/{fan}" for tray, fan in sorted(raised - wanted)) or "none",
                    }
                up.end()
            finally:
                up.kill()
    groups: dict[str, list[str]] = defaultdict(list)
    for name in names:
        number = int(name.removeprefix("node"))
        groups[bad.get(number, f"{ORDINARY}: {list(EXPORTERS)[number % len(EXPORTERS)]}")].append(name)
    return about, list(samples_by_kind(groups, times_ns, seconds / period_s, first=ORDINARY))


def _run_fantwin(words: str) -> str:
    """Run a command that has to succeed; what it prints."""
    done = subprocess.run(
        [sys.executable, "-m", "fantwin", *words.split()], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def _twin(folder: Path, period_s: float) -> Path:
    """A calibrated twin of the fans, from tables of what three of them did, sampled like the hall."""
    progress("learning the twin")
    twin = folder / "twin.onnx"
    for fan in range(3):
        at_s = np.arange(0.0, LEARNED_PERIODS * period_s, period_s)
        rows = [f"{t:g},{u:g},{y:g}" for t, (u, y) in ((t, fan_at(fan + 1, 0, float(t))) for t in at_s)]
        (folder / f"{fan}.csv").write_text("\n".join(["t,u,y", *rows, ""]), encoding="ascii")
        table = f"import {folder}/{fan}.csv --time t:s --command u --speed y:rpm -o {folder}/{fan}.mcap"
        _run_fantwin(table)
    _run_fantwin(f"train {folder}/0.mcap --validate {folder}/1.mcap -o {twin}")
    _run_fantwin(f"calibrate {twin} {folder}/1.mcap {folder}/2.mcap --false-alarms-per-day 1 --extrapolate")
    return twin


def _configuration(plan: Plan, folder: Path, url: str, twin: Path | None) -> tuple[Path, dict[str, int], float]:
    """What `init` writes once all fans are there, with the commands that it cannot know."""
    path = folder / "site.toml"
    trays: list[dict[str, Any]] = []
    took_s = 0.0

    def all_found() -> bool:
        nonlocal trays, took_s
        time.sleep(2.0)
        path.unlink(missing_ok=True)
        began_s = time.monotonic()
        try:
            _run_fantwin(f"init --prometheus {url} -c {path}")
        except AssertionError:  # nothing was scraped yet
            return False
        took_s = time.monotonic() - began_s
        trays = tomllib.loads(path.read_text(encoding="utf-8"))["tray"]
        return len(load_config(path, stages=()).trays) == plan.controllers and all(
            len(tray["source"]["fan"]) == FANS and "period_s" in tray["source"] for tray in trays
        )

    eventually(all_found, "init finds all fans", STARTS_S)
    for tray in trays:
        source = tray["source"]
        metric = source["fan"][0]["speed"].partition("{")[0]
        exporter = next(each for each in EXPORTERS.values() if each.speed.startswith(f"{metric}{{"))
        for number, fan in enumerate(source["fan"], 1):
            series = fan.get("command", exporter.command.format(number))
            fan["command"] = {"name": series, "scale": 1.0 / exporter.scale}  # per cent
        tray |= {"command_max": 101.0, **({"twin": str(twin)} if twin else {})}
    stages = ["acquisition", *(("resampler", "twin_integrator", "scorer") if twin else ())]
    launcher = f"launcher = {{ stages = {json.dumps(stages)} }}"
    head = f'run_folder = "runs"\nbus = {{ endpoint = "{free_endpoint()}" }}\n{launcher}\n'
    lines = [
        line for tray in trays for line in ("[[tray]]", *(f"{key} = {as_toml(each)}" for key, each in tray.items()))
    ]
    path.write_text("\n".join([head, *lines, ""]), encoding="utf-8")
    return path, {"[[tray]]": len(trays), "fans found": plan.controllers * FANS}, took_s


def _queries(url: str) -> float:
    """How often this Prometheus was asked so far."""
    with urllib.request.urlopen(f"{url}/metrics") as answer:
        found = re.findall(r'^prometheus_http_requests_total{.*/api/v1/query".*} (\S+)', answer.read().decode(), re.M)
    return sum(map(float, found))


def _exporters(plan: Plan, folder: Path) -> list[str]:
    return [sys.executable, "-m", "bench.fleet.metrics_of_nodes", json.dumps(asdict(plan)), str(folder / "bad")]


def _prometheus(plan: Plan, folder: Path, period_s: float) -> list[str]:
    nodes = [f"node{number:03}:9100" for number in range(plan.controllers)]
    relabel = [
        {"source_labels": ["__address__"], "target_label": "instance"},
        {"source_labels": ["__address__"], "regex": "node0*([0-9]+):.*", "target_label": "__param_node"},
        {"target_label": "__address__", "replacement": f"127.0.0.1:{plan.port}"},
    ]
    job = {"job_name": "nodes", "static_configs": [{"targets": nodes}], "relabel_configs": relabel}
    times = {"scrape_interval": f"{period_s:g}s", "scrape_timeout": f"{min(period_s, 10.0):g}s"}
    (folder / "prometheus.yml").write_text(json.dumps({"global": times, "scrape_configs": [job]}), encoding="ascii")
    return [
        *("prometheus", "--log.level=error", f"--config.file={folder}/prometheus.yml"),
        *(f"--storage.tsdb.path={folder}/data", f"--web.listen-address=127.0.0.1:{free_port()}"),
    ]


@contextmanager
def _running(words: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


if __name__ == "__main__":
    typer.run(main)

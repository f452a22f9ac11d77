"""What many open pages cost the gateway: share of a core, memory, and how long an alarm takes to reach each page.

A process publishes the scores of a made-up fleet on a real bus in real time, and raises an alarm now and then. The
gateway is that of `fantwin up --only gateway`. The pages are in a third process: each holds a stream of live
events as a browser does, half of them looking at a fan, and notes when each alarm arrives. Prometheus' part is one
scrape of /metrics every 15 s. Each row has a gateway of its own; Linux only, for what it says about processes.

    python -m bench.fleet.page_load
"""

from __future__ import annotations

import http.client
import json
import math
import multiprocessing
import os
import selectors
import socket
import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from bench.fleet.fleet_scores import SITE, FleetScores
from bench.printing import JsonOption, progress, show
from bench.runtime.stage_memory import free_endpoint
from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.selftest.scratch_site import FANTWIN
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Diagnosis, Score
from fantwin.schemas.topics import BY_NAME, tray_key, tray_of

PAGES = (0, 1, 200)
READY_S = 300.0
WARM_UP_S = 5.0
SCRAPED_EVERY_S = 15.0
ALARMS_HZ = 2.0
LATEST_S = 30.0
"""an alarm that has not arrived so long after the last one is lost"""
PRODUCER = "scorer-all-0123abcd"
_ALARM = b"event: alarm\ndata: "
_END = b"\n\n"


@dataclass
class Arrivals:
    """What the pages have had.

    Attributes:
        latencies_s: from the publication of an alarm to its arrival at a page, of all pages.
        missed: times that a page was sent `missed`: it did not keep up.
        received_bytes: of all events.
        scrapes_s: how long each scrape took.
    """

    latencies_s: list[float] = field(default_factory=list[float])
    missed: int = 0
    received_bytes: int = 0
    scrapes_s: list[float] = field(default_factory=list[float])


def main(
    fans: Annotated[int, typer.Option(help="Of the fleet.")] = 5_000,
    seconds: Annotated[int, typer.Option(help="Measured, for each row, after 5 s.")] = 30,
    rate_hz: Annotated[float, typer.Option(help="Samples a second of each fan.")] = 10.0,
    block_s: Annotated[float, typer.Option(help="Length of the messages, s.")] = 0.1,
    pages: Annotated[int, typer.Option(help="Open pages; -1: 0, 1 and 200.")] = -1,
    json_output: JsonOption = False,
) -> None:
    """Print what the gateway takes, and how late alarms are, by the number of open pages."""
    rows: list[dict[str, Any]] = []
    for count in PAGES if pages < 0 else (pages,):
        progress(f"{count} pages")
        with tempfile.TemporaryDirectory() as folder:
            rows.append(load_of(count, fans, seconds, rate_hz, block_s, Path(folder)))
    for row in rows:
        row["relative"] = row["% of a core"] / rows[0]["% of a core"]
    notes = [
        "relative: to the first row; missed: times that a page did not keep up",
        "latency: from the publication of an alarm to its arrival at a page",
        f"load: of the machine while it was measured, with {os.cpu_count()} cores; all processes of the bench included",
    ]
    show({f"the gateway, {fans} fans at {rate_hz:g} Hz": rows}, notes, as_json=json_output)


def load_of(pages: int, fans: int, seconds: int, rate_hz: float, block_s: float, folder: Path) -> dict[str, Any]:
    """What so many pages cost."""
    spawned = multiprocessing.get_context("spawn")
    endpoint, port = free_endpoint(), int(free_endpoint().rpartition(":")[2])
    fleet = FleetScores(fans, rate_hz=rate_hz, block_s=block_s)
    is_made, may_begin, may_end = (spawned.Event() for _ in range(3))
    sent, sent_by = spawned.Pipe(duplex=False)
    scorers = spawned.Process(
        target=publish,
        args=(endpoint, fleet, seconds + WARM_UP_S, is_made, may_begin, may_end, sent_by),
        daemon=True,
    )
    scorers.start()
    assert is_made.wait(READY_S), "the fleet is not made in time"
    gateway = subprocess.Popen(
        [*FANTWIN, "up", "--only", "gateway", "-c", str(_configuration(fleet, endpoint, port, folder))]
    )
    try:
        _wait_for(port)
        arrived, arrived_by = spawned.Pipe(duplex=False)
        are_open, have_ended = spawned.Event(), spawned.Event()
        expected = spawned.Value("l", -1)
        names = [f"{tray.name}/{fan}" for tray in fleet.trays for fan in range(tray.fans)]
        looked_at = [names[len(names) * page // pages] if page % 2 else "" for page in range(pages)]
        browsers = spawned.Process(
            target=browse, args=(port, looked_at, are_open, have_ended, expected, arrived_by), daemon=True
        )
        browsers.start()
        assert are_open.wait(READY_S), "the pages do not open"
        may_begin.set()
        time.sleep(WARM_UP_S)
        began_s, cpu_s = time.monotonic(), _cpu_s(gateway.pid)
        alarms = sent.recv()  # the last has been sent
        took_s, cpu_s = time.monotonic() - began_s, _cpu_s(gateway.pid) - cpu_s
        peak_mb, load = _peak_mb(gateway.pid), os.getloadavg()[0]
        expected.value = alarms * pages
        have_ended.set()
        arrivals: Arrivals = arrived.recv()
        may_end.set()
        browsers.join()
        scorers.join()
    finally:
        gateway.terminate()
        gateway.wait()
    late_ms = np.array(arrivals.latencies_s) * 1e3 if arrivals.latencies_s else np.full(1, np.nan)
    return {
        "pages": pages,
        "% of a core": 100.0 * cpu_s / took_s,
        "peak, MB": peak_mb,
        "alarms lost": alarms * pages - len(arrivals.latencies_s),
        "median, ms": float(np.median(late_ms)),
        "p99, ms": float(np.percentile(late_ms, 99)),
        "max, ms": float(late_ms.max()),
        "missed": arrivals.missed,
        "MB/s": arrivals.received_bytes / 1e6 / (took_s + WARM_UP_S),
        "scrape, ms": 1e3 * float(np.median(arrivals.scrapes_s)) if arrivals.scrapes_s else float("nan"),
        "rate": seconds / took_s,
        "load": load,
    }


def publish(
    endpoint: str,
    fleet: FleetScores,
    seconds: float,
    is_made: Event,
    may_begin: Event,
    may_end: Event,
    sent: Connection,
) -> None:
    """Send what the scorers of a fleet send, in real time, and how many alarms that were; in a process of its own."""
    made = [each for second in range(round(seconds)) for each in fleet.second(second) if isinstance(each, Envelope)]
    with Bus(BusConfig(endpoint=endpoint)) as bus:

        def publisher_of(tray: str, topic: str, kind: type[Score | Alarm]) -> Publisher:
            return bus.publisher(tray_key(SITE, tray, topic), BY_NAME[topic], type_name(kind), PRODUCER)

        scores = {tray.name: publisher_of(tray.name, "score", Score) for tray in fleet.trays}
        alarms = {tray.name: publisher_of(tray.name, "alarm", Alarm) for tray in fleet.trays}
        is_made.set()
        may_begin.wait()
        began_s, raised = time.monotonic(), 0
        for number, envelope in enumerate(made):
            due_s = number * seconds / len(made)
            early_s = began_s + due_s - time.monotonic()
            if early_s > 0.0:
                time.sleep(early_s)
            scores[tray_of(envelope.key)].put(envelope.payload)
            if due_s >= raised / ALARMS_HZ:
                tray = fleet.trays[raised % len(fleet.trays)]
                alarm = alarms[tray.name]
                alarm.put(encode(_alarm(tray.name, raised % tray.fans, alarm.published)))
                raised += 1
        sent.send(raised)
        may_end.wait()


def browse(
    port: int,
    looked_at: list[str],
    are_open: Event,
    have_ended: Event,
    expected: Synchronized[int],
    arrived: Connection,
) -> None:
    """Hold a page open for each of `looked_at`, the name of its fan or nothing; in a process of its own.

    expected: arrivals of alarms at all pages, known at the end.
    """
    waiting, arrivals = selectors.DefaultSelector(), Arrivals()
    for fan in looked_at:
        page = socket.create_connection(("127.0.0.1", port))
        page.sendall(f"GET /api/v1/events?fan={fan} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        waiting.register(page, selectors.EVENT_READ, _Stream(arrivals))
    opened: set[int] = set()
    scraping = threading.Thread(target=_scrape_now_and_then, args=(port, have_ended, arrivals.scrapes_s))
    scraping.start()
    until_s = math.inf
    while not (have_ended.is_set() and len(arrivals.latencies_s) >= expected.value) and time.monotonic() < until_s:
        if have_ended.is_set():
            until_s = min(until_s, time.monotonic() + LATEST_S)
        for key, _ in waiting.select(0.2):
            data = key.fileobj.recv(1 << 20)  # type: ignore[union-attr]
            assert data, "the gateway has closed a page"
            key.data.take(data, time.time_ns())
            opened.add(key.fd)
        if len(opened) == len(looked_at):
            are_open.set()
    scraping.join()
    arrived.send(arrivals)


class _Stream:
    """The events of one page."""

    def __init__(self, arrivals: Arrivals) -> None:
        self._arrivals = arrivals
        self._rest = b""

    def take(self, data: bytes, now_ns: int) -> None:
        """Something has arrived."""
        self._arrivals.received_bytes += len(data)
        *events, self._rest = (self._rest + data).split(_END)
        for event in events:
            if (begins := event.find(_ALARM)) >= 0:
                alarm = json.loads(event[begins + len(_ALARM) :])
                self._arrivals.latencies_s.append((now_ns - alarm["onset_t_ns"]) / 1e9)
            self._arrivals.missed += b"event: missed" in event


def _scrape_now_and_then(port: int, have_ended: Event, took_s: list[float]) -> None:
    while not have_ended.wait(SCRAPED_EVERY_S):
        began_s = time.monotonic()
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        connection.request("GET", "/metrics", headers={"Accept-Encoding": "gzip"})
        connection.getresponse().read()
        connection.close()
        took_s.append(time.monotonic() - began_s)


def _alarm(tray: str, fan: int, sequence: int) -> Alarm:
    """It is published now."""
    now_ns = time.time_ns()
    return Alarm(
        header=Header(PRODUCER, sequence, tray),
        fan=fan,
        active=True,
        severity=Severity.ALARM,
        t_ns=now_ns,
        onset_t_ns=now_ns,
        residual_rad_s=-16.0,
        residual_std_rad_s=4.0,
        message=f"fan {fan}: slower than its twin",
        transition=Transition.RAISED,
        causes=(Diagnosis(cause="drag", probability=0.8, evidence="drag +20 %"),),
    )


def _configuration(fleet: FleetScores, endpoint: str, port: int, folder: Path) -> Path:
    lines = [f'site = "{SITE}"', f'run_folder = "{folder}"', f'[bus]\nendpoint = "{endpoint}"']
    lines += [f"[gateway]\nport = {port}"]
    lines += [f'[[tray]]\nname = "{tray.name}"\nfans = {tray.fans}\nspeed_unit = "rpm"' for tray in fleet.trays]
    path = folder / "fantwin.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def _wait_for(port: int) -> None:
    until_s = time.monotonic() + READY_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            return
        except OSError:
            assert time.monotonic() < until_s, "the gateway does not start"
            time.sleep(0.1)


def _cpu_s(process_id: int) -> float:
    words = Path(f"/proc/{process_id}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return sum(map(int, words[11:13])) / os.sysconf("SC_CLK_TCK")


def _peak_mb(process_id: int) -> float:
    lines = Path(f"/proc/{process_id}/status").read_text(encoding="ascii").splitlines()
    (line,) = (line for line in lines if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1e3


if __name__ == "__main__":
    typer.run(main)

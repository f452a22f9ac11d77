"""What TLS and access control cost on the way through a router: throughput, round trip, and CPU time, as ratios.

Three processes on loopback: a router, one that publishes or echoes, one that measures. The three variants alternate.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import zenoh

from bench.printing import JsonOption, progress, show

sys.path.insert(0, str(Path(__file__).parents[2]))

from fantwin.pipeline.bus.router import open_router
from fantwin.pipeline.bus.settings import Settings
from fantwin.schemas.topics import tray_key
from tests.support.secured_site import SITE, SecuredSite, free_endpoint

PLAIN, TLS, RULES = "plain", "TLS", "TLS and roles"
SIZE, ECHO_SIZE = 1000, 256
THERE, BACK = (tray_key(SITE, "a", topic) for topic in ("command", "raw"))


def main(rounds: int = 5, messages: int = 40_000, echoes: int = 1000, json_output: JsonOption = False) -> None:
    found: dict[str, list[dict[str, float]]] = {PLAIN: [], TLS: [], RULES: []}
    for number in range(1, rounds + 1):
        for variant, rows in found.items():
            progress(f"round {number} of {rounds}: {variant}")
            with tempfile.TemporaryDirectory() as folder:
                rows.append(measured(variant, Path(folder), messages, echoes))
    medians = {
        variant: {name: statistics.median(row[name] for row in rows) for name in rows[0]}
        for variant, rows in found.items()
    }
    table: list[dict[str, Any]] = [
        {"variant": variant, **{name: value / medians[PLAIN][name] for name, value in row.items()}}
        for variant, row in medians.items()
    ]
    plain = ", ".join(f"{name} {value:.4g}" for name, value in medians[PLAIN].items())
    show(
        {"through a router, plain = 1": table}, [f"plain: {plain}", f"medians of {rounds} rounds"], as_json=json_output
    )


def measured(variant: str, folder: Path, messages: int, echoes: int) -> dict[str, float]:
    site = SecuredSite(folder, free_endpoint())
    words = [sys.executable, "-m", "bench.runtime.tls_overhead", "child", variant, str(folder), site.endpoint]
    with (
        subprocess.Popen([*words, "router", "0"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as router,
        _session(site, variant, "operator") as session,
        subprocess.Popen(
            [*words, "acquisition", str(messages)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as other,
    ):
        assert router.stdout and router.stdin and other.stdin and other.stdout
        echoed, received, done = threading.Event(), [0], threading.Event()

        def count(_sample: zenoh.Sample) -> None:
            received[0] += 1
            if received[0] == messages:
                done.set()

        echo = session.declare_subscriber(BACK, zenoh.handlers.Callback(lambda _sample: echoed.set(), indirect=False))
        asking = session.declare_publisher(THERE, congestion_control=zenoh.CongestionControl.BLOCK, express=True)
        while not echoed.wait(0.05):
            asking.put(b"x")
        times: list[float] = []
        for _ in range(echoes):
            echoed.clear()
            began_s = time.perf_counter()
            asking.put(bytes(ECHO_SIZE))
            assert echoed.wait(10)
            times.append(time.perf_counter() - began_s)
        echo.undeclare()
        counting = session.declare_subscriber(BACK, zenoh.handlers.Callback(count, indirect=False))
        time.sleep(0.5)  # until the router has it
        cpu_s, began_s = _cpu_s(router.pid), time.perf_counter()
        other.stdin.write(b"go\n")
        other.stdin.flush()
        assert done.wait(120)
        elapsed_s = time.perf_counter() - began_s
        cpu_s = _cpu_s(router.pid) - cpu_s
        counting.undeclare()
        other.stdin.close()
        router.stdin.close()
    times.sort()
    return {
        "messages/s of 1 kB": messages / elapsed_s,
        "round trip of 256 B, median, us": 1e6 * times[len(times) // 2],
        "p99, us": 1e6 * times[int(0.99 * len(times))],
        "CPU of the router, us a message": 1e6 * cpu_s / messages,
    }


def _session(site: SecuredSite, variant: str, role: str) -> zenoh.Session:
    settings = Settings()
    settings.set("mode", "client")
    settings.set("connect/endpoints", [_endpoint(site.endpoint, variant)])
    settings.set("connect/timeout_ms", 20_000)
    settings.set("scouting/multicast/enabled", False)
    settings.set("transport/shared_memory/enabled", False)
    settings.secure(site.credentials(role) if variant != PLAIN else None)
    return zenoh.open(settings.config)


def _endpoint(endpoint: str, variant: str) -> str:
    return endpoint.replace("tls/", "tcp/") if variant == PLAIN else endpoint


def _cpu_s(process_id: int) -> float:
    fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def child(variant: str, folder: str, endpoint: str, role: str, messages: int) -> None:
    """A router, or the other end, until standard input closes."""
    site = SecuredSite(Path(folder), endpoint, is_new=False)
    if role == "router":
        credentials = site.credentials("router") if variant != PLAIN else None
        with open_router(_endpoint(endpoint, variant), credentials, site.site if variant == RULES else None):
            sys.stdin.read()
        return
    with _session(site, variant, role) as session:
        publisher = session.declare_publisher(BACK, congestion_control=zenoh.CongestionControl.BLOCK, express=True)

        def send_back(sample: zenoh.Sample) -> None:
            publisher.put(sample.payload)

        subscriber = session.declare_subscriber(THERE, zenoh.handlers.Callback(send_back, indirect=False))
        sys.stdin.readline()
        subscriber.undeclare()
        bulk = session.declare_publisher(BACK, congestion_control=zenoh.CongestionControl.BLOCK)
        for _ in range(messages):
            bulk.put(bytes(SIZE))
        sys.stdin.read()


if __name__ == "__main__":
    if sys.argv[1:2] == ["child"]:
        child(sys.argv[2], sys.argv[3], sys.argv[4], sys.argv[5], int(sys.argv[6]))
    else:
        import typer

        typer.run(main)

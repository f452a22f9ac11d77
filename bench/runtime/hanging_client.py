"""An OPC UA client that hangs for minutes, with subscriptions: does another client hear of alarms as before, and does
the server's memory grow?

The stage `opcua` runs in a process on a real bus, with scores and alarms of a hall of fans from here. One client hears
the alarms of the site; the other one subscribes to the values of all fans and to the alarms, and is stopped (SIGSTOP)
and goes on again. Printed: how long an alarm takes to the first client before, while the other one hangs, and after;
alarms that it missed or heard twice; memory of the server; and what the client that had hung has heard in the end.
"""

# pyright: reportPrivateImportUsage=false
# (the library declares its names otherwise than it uses them)
from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from asyncua import Client, ua

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.printing import JsonOption, progress, show
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import FanState
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.topics import BY_NAME, tray_key
from tests.support.notified_alarms import alarm
from tests.support.ports import free_port
from tests.support.running_chain import RunningCommand, eventually

SITE, TRAY, FANS = "hall", "tray1", 500
ALARM_EVERY_S, SCORE_EVERY_S = 1.0, 1.0
WATCHED = ("Speed", "PredictedSpeed", "Score", "State")
ITEMS_AT_ONCE = 500
RECENT_S = 60.0
CONFIGURATION = """
site = "{site}"
run_folder = "runs"
bus.endpoint = "{endpoint}"
[[tray]]
name = "{tray}"
fans = {fans}
speed_unit = "rpm"
source = {{ kind = "push" }}
[opcua]
port = {port}
"""


class Hall:
    """Publishes scores and alarms as a scorer does, and remembers when."""

    def __init__(self, bus: Bus) -> None:
        self._alarms, self._scores = (
            bus.publisher(tray_key(SITE, TRAY, topic), BY_NAME[topic], type_name(kind), "scorer-all-1")
            for topic, kind in (("alarm", Alarm), ("score", Score))
        )
        self._random = np.random.default_rng(0)
        self._ended = threading.Event()
        self.sent_s: dict[str, float] = {}
        """when, by what the alarm says"""
        self._threads = [
            threading.Thread(target=each, daemon=True) for each in (self._publish_alarms, self._publish_scores)
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def _publish_alarms(self) -> None:
        while not self._ended.wait(ALARM_EVERY_S):
            number = self._alarms.published
            words = f"alarm {number}"
            found = alarm(fan=number % FANS, tray=TRAY, sequence=number, onset_s=number, message=words)
            self.sent_s[words] = time.monotonic()
            self._alarms.put(encode(found))

    def _publish_scores(self) -> None:
        while not self._ended.wait(SCORE_EVERY_S):
            self._scores.put(encode(self._score()))

    def _score(self) -> Score:
        shape = (1, FANS)
        speed = self._random.normal(100.0, 5.0, shape).astype(np.float32)
        return Score(
            header=Header("scorer-all-1", self._scores.published, TRAY),
            fans=FANS,
            period_ns=10_000_000,
            t_ns=np.array([time.time_ns()]),
            command=np.full(shape, 0.5, np.float32),
            measured_speed_rad_s=speed,
            predicted_speed_rad_s=speed + 1,
            band_variance=np.ones(shape, np.float32),
            state=np.full(shape, FanState.NORMAL, np.uint8),
            valid=np.ones(shape, bool),
            invalid_reason=np.zeros(shape, np.uint8),
            torque_balance_command=np.zeros(shape, np.float32),
            expected_residual_rad_s=np.zeros(shape, np.float32),
            expected_balance_command=np.zeros(shape, np.float32),
            score=np.abs(speed) / 200,
            statistic=np.zeros(shape, np.uint8),
        )


class Listener:
    """What a subscription brings. heard_s: when each event came, by its words."""

    def __init__(self) -> None:
        self.heard_s: dict[str, float] = {}
        self.twice = self.values = 0

    def event_notification(self, event: Any) -> None:
        words = str(event.Message.Text)
        self.twice += words in self.heard_s
        self.heard_s.setdefault(words, time.monotonic())

    def datachange_notification(self, _node: Any, _value: Any, _data: Any) -> None:
        self.values += 1

    def status_change_notification(self, status: Any) -> None:
        """Its end shows in what has not come."""


async def listen(url: str, listener: Listener, ended: threading.Event, *, with_values: bool) -> None:
    logging.getLogger("asyncua").setLevel(logging.ERROR)
    async with Client(url, timeout=60) as client:
        subscription = await client.create_subscription(100, listener)
        await subscription.subscribe_events(ua.ObjectIds.Server, ua.ObjectIds.BaseEventType, queuesize=10_000)
        if with_values:
            names = [f"ns=2;s={TRAY}/{fan}/{name}" for fan in range(FANS) for name in WATCHED]
            for first in range(0, len(names), ITEMS_AT_ONCE):
                nodes = [client.get_node(name) for name in names[first : first + ITEMS_AT_ONCE]]
                await subscription.subscribe_data_change(nodes)
        while not ended.is_set():
            await asyncio.sleep(0.1)


def hang(url: str, heard: Synchronized[int], values: Synchronized[int]) -> None:
    """The client that is stopped, in a process of its own."""
    listener, ended = Listener(), threading.Event()

    def report() -> None:
        while True:
            heard.value, values.value = len(listener.heard_s), listener.values
            time.sleep(0.2)

    threading.Thread(target=report, daemon=True).start()
    asyncio.run(listen(url, listener, ended, with_values=True))


class Bench:
    """The server, its two clients, and what is measured."""

    def __init__(self, folder: Path, bus: Bus, endpoint: str) -> None:
        port = free_port()
        config = folder / "fantwin.toml"
        config.write_text(CONFIGURATION.format(site=SITE, endpoint=endpoint, tray=TRAY, fans=FANS, port=port))
        url = f"opc.tcp://127.0.0.1:{port}/fantwin"
        self.hall = Hall(bus)
        self._server = RunningCommand(["up", "--only", "opcua", "-c", config])
        eventually(lambda: _answers(port), "the server listens")
        self.listener, self._ended = Listener(), threading.Event()
        listening = listen(url, self.listener, self._ended, with_values=False)
        self._thread = threading.Thread(target=lambda: asyncio.run(listening), daemon=True)
        self._thread.start()
        spawn = multiprocessing.get_context("spawn")
        self.heard, self.values = spawn.Value("i", 0), spawn.Value("i", 0)
        self._other = spawn.Process(target=hang, args=(url, self.heard, self.values), daemon=True)
        self._other.start()
        eventually(lambda: self.values.value > FANS and self.heard.value > 2, "both clients hear something")
        eventually(lambda: self.listener.heard_s, "both clients hear something")
        self.not_heard = len(self.hall.sent_s) - self.heard.value
        """alarms that came before the second client had subscribed"""
        self.rows: list[dict[str, Any]] = []

    def pause(self, *, is_paused: bool) -> None:
        assert self._other.pid
        os.kill(self._other.pid, signal.SIGSTOP if is_paused else signal.SIGCONT)

    def measure(self, what: str, seconds: float) -> None:
        """A row about these seconds."""
        progress(f"{what}: {seconds:.0f} s")
        began_s, cpu_s, most_mb = time.monotonic(), self._cpu_s(), 0.0
        while time.monotonic() - began_s < seconds:
            time.sleep(1.0)
            most_mb = max(most_mb, self._memory_mb())
        until_s, cpu_s = time.monotonic() - 2.0, self._cpu_s() - cpu_s
        sent = {words: at_s for words, at_s in self.hall.sent_s.items() if began_s <= at_s < until_s}
        eventually(lambda: sent.keys() <= self.listener.heard_s.keys(), "all alarms are heard")
        late_ms = np.array([1e3 * (self.listener.heard_s[words] - at_s) for words, at_s in sent.items()])
        self.rows.append(
            {
                "the other client": what,
                "alarms": len(sent),
                "median, ms": float(np.median(late_ms)),
                "95 %, ms": float(np.quantile(late_ms, 0.95)),
                "longest, ms": float(late_ms.max()),
                "memory, MB": most_mb,
                "CPU, % of a core": 100 * cpu_s / seconds,
            }
        )

    def close(self) -> None:
        self._ended.set()
        self.pause(is_paused=False)
        self._other.kill()
        self._thread.join(20)
        self.hall.close()
        self._server.end()
        self._server.kill()

    def _memory_mb(self) -> float:
        status = Path(f"/proc/{self._server.process.pid}/status").read_text()
        return int(status.partition("VmRSS:")[2].split()[0]) / 1024

    def _cpu_s(self) -> float:
        fields = Path(f"/proc/{self._server.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def main(
    hangs_s: Annotated[float, typer.Option(min=30, help="How long the client hangs.")] = 300.0,
    as_json: JsonOption = False,
) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder, Bus(BusConfig(endpoint=endpoint)) as bus:
        bench = Bench(Path(folder), bus, endpoint)
        try:
            bench.measure("reads", RECENT_S)
            bench.pause(is_paused=True)
            bench.measure("hangs", hangs_s)
            bench.pause(is_paused=False)
            bench.measure("reads again", RECENT_S)
            missed = len(bench.hall.sent_s) - bench.not_heard - bench.heard.value
        finally:
            bench.close()
    watched = f"{FANS} fans; the client that hangs subscribes to {FANS * len(WATCHED)} values and all alarms"
    notes = [
        f"{watched}, and has missed {max(0, missed)} alarms in the end",
        f"the other client has heard {bench.listener.twice} alarms twice",
    ]
    show({"OPC UA client that hangs: time from the scorer to the other client": bench.rows}, notes, as_json=as_json)


if __name__ == "__main__":
    typer.run(main)

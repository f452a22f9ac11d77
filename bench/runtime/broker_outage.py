"""An MQTT broker that is killed and comes back after ten minutes: what a subscriber has then of the alarms of a site.

The demo's site runs in processes, with the stage `mqtt`. While the broker is away an operator shelves and unshelves a
fan every 20 s, in the middle all fans at once again and again, and later the stage is killed. Printed: transitions on
the bus and at the subscriber, how many are missing, twice or out of order, when they came after the broker was back,
and the latency of the other stages before, during and after.

The subscriber has a session that the broker keeps; without one it would miss what comes before it is back itself.
"""

from __future__ import annotations

import json
import shutil
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import paho.mqtt.client as paho
import typer
from paho.mqtt.enums import CallbackAPIVersion

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.printing import JsonOption, progress, show
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.codec import CodecError, decode, encode, type_name
from fantwin.schemas.enums import Action
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Request
from fantwin.schemas.topics import BY_NAME, tray_key
from tests.support.mosquitto import Mosquitto
from tests.support.running_chain import FANS, SITE, TRAY, Chain, eventually, view_of

EVERY_S = 20.0
BURST_REQUESTS = 25
"""of all fans at once, in the middle"""
KILLED_AT = 0.7
OTHERS = ("resampler", "twin_integrator", "scorer")
PERSISTENCE = ("allow_anonymous true", "persistence true", "autosave_interval 1", "autosave_on_changes true")

Key = tuple[int, int, str, str]
"""time, fan, transition and comment; two transitions of a fan may have the same time"""


class Subscriber:
    """Keeps each transition that the broker delivers. lines: its subscription survives the broker."""

    def __init__(self, port: int) -> None:
        self.heard: list[tuple[int, Key, float]] = []
        """number of the transition, its key, and when it came"""
        self.client = paho.Client(CallbackAPIVersion.VERSION2, "subscriber", clean_session=False)
        self.client.reconnect_delay_set(1, 10)
        self.client.on_connect = self._on_connect
        self.client.on_message = self._on_message
        self.client.connect_async("127.0.0.1", port, keepalive=10)
        self.client.loop_start()

    def _on_connect(self, client: paho.Client, *_rest: Any) -> None:
        client.subscribe("fantwin/+/+/+/alarm/transitions", 1)

    def _on_message(self, _client: Any, _data: Any, message: paho.MQTTMessage) -> None:
        found = json.loads(message.payload)
        key = (found["t_ns"], found["fan"], found["transition"], found["comment"])
        self.heard.append((found["number"], key, time.monotonic()))


class Operator:
    """Asks the scorer of the tray, and hears all transitions on the bus."""

    def __init__(self, bus: Bus) -> None:
        self._lock = threading.Lock()
        self._heard: set[Key] = set()
        key = tray_key(SITE, TRAY, "request")
        self._publisher = bus.publisher(key, BY_NAME["request"], type_name(Request), "bench-all-1")
        self.answers_s: list[float] = []
        bus.subscribe(tray_key(SITE, TRAY, "alarm"), self._on_alarm)

    def ask(self, action: Action, fan: int) -> None:
        """Of a fan, or all (-1); waits for the transitions."""
        fans = FANS if fan < 0 else 1
        before, began_s = len(self.heard()), time.monotonic()
        number = self._publisher.published
        asked = Request(
            header=Header("bench-all-1", number, TRAY),
            t_ns=time.time_ns(),
            action=action,
            fan=fan,
            operator_name="bench",
            comment=f"request {number}",
        )
        self._publisher.put(encode(asked))
        eventually(lambda: len(self.heard()) >= before + fans, f"the scorer has answered to {action.name}")
        self.answers_s.append(time.monotonic() - began_s)

    def heard(self) -> set[Key]:
        with self._lock:
            return set(self._heard)

    def _on_alarm(self, _key: str, payload: bytes) -> None:
        try:
            alarm = decode(Alarm, payload)
        except CodecError:
            return
        if isinstance(alarm, Alarm):
            with self._lock:
                self._heard.add((alarm.t_ns, alarm.fan, alarm.transition.name.lower(), alarm.comment))


class Latency:
    """The highest and the mean 99th percentile of the other stages, over their health messages."""

    def __init__(self, watcher: SiteWatcher) -> None:
        self._watcher = watcher
        self._found: dict[str, dict[str, list[float]]] = {}

    def look(self, when: str) -> None:
        of = self._found.setdefault(when, {name: [] for name in OTHERS})
        for name in OTHERS:
            if view := view_of(self._watcher, name):
                of[name].append(view.health.latency_p99_ms)

    def wait(self, seconds: float, when: str) -> None:
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            self.look(when)
            time.sleep(min(2.0, left_s))

    def rows(self) -> list[dict[str, Any]]:
        return [
            {"stage": name}
            | {f"{when}, mean": sum(of[name]) / len(of[name]) for when, of in self._found.items()}
            | {f"{when}, most": max(of[name]) for when, of in self._found.items()}
            for name in OTHERS
        ]


def outage(chain: Chain, watcher: SiteWatcher, operator: Operator, latency: Latency, outage_s: float) -> None:
    """The broker is away; many transitions at once in the middle, and then a kill of the stage."""
    began_s, is_burst_over, is_killed, fan = time.monotonic(), False, False, 0
    while (gone_s := time.monotonic() - began_s) < outage_s - EVERY_S:
        operator.ask(Action.SHELVE, fan)
        operator.ask(Action.UNSHELVE, fan)
        fan = (fan + 1) % FANS
        if not is_burst_over and gone_s > outage_s / 2:
            is_burst_over = True
            for _ in range(BURST_REQUESTS):
                operator.ask(Action.OUT_OF_SERVICE, -1)
                operator.ask(Action.IN_SERVICE, -1)
        if not is_killed and gone_s > KILLED_AT * outage_s:
            is_killed = True
            chain.kill(watcher, "mqtt")
        latency.wait(EVERY_S, "away")
    latency.wait(max(0.0, outage_s - (time.monotonic() - began_s)), "away")


def main(
    outage_s: Annotated[float, typer.Option(min=60, help="How long the broker is away.")] = 600.0,
    as_json: JsonOption = False,
) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    # a path that is short enough for the port of the tray
    folder = Path(tempfile.mkdtemp(prefix="outage"))
    broker = Mosquitto(folder, *PERSISTENCE, f"persistence_location {folder}/")
    broker.start()
    stages = json.dumps(["acquisition", "resampler", "twin_integrator", "scorer", "recorder", "mqtt"])
    settings = (f"launcher.stages={stages}", f"mqtt.url='mqtt://127.0.0.1:{broker.port}'")
    chain = Chain(folder, endpoint, *settings)
    subscriber = Subscriber(broker.port)
    try:
        chain.start_tray()
        chain.start_up()
        with Bus(BusConfig(endpoint=endpoint), listens=False) as bus:
            watcher, operator = SiteWatcher(bus, SITE), Operator(bus)
            latency = Latency(watcher)
            eventually(lambda: (view := view_of(watcher, "mqtt")) is not None and view.alive, "the stage is there", 120)
            time.sleep(20)
            operator.ask(Action.SHELVE, 0)
            operator.ask(Action.UNSHELVE, 0)
            eventually(lambda: len(subscriber.heard) >= len(operator.heard()), "the broker delivers", 60)
            latency.wait(60, "before")
            progress(f"the broker is away for {outage_s:.0f} s")
            broker.stop()
            outage(chain, watcher, operator, latency, outage_s)
            broker.start()
            back_s = time.monotonic()
            progress("the broker is back")
            expected = operator.heard()
            eventually(lambda: expected <= {key for _, key, _ in subscriber.heard}, "all have come", 120)
            latency.wait(60, "after")
            view = view_of(watcher, "mqtt")
            counters = {each.name: each.value for each in view.health.counters} if view else {}
            row = row_of(operator, subscriber, outage_s, back_s) | {
                "counted as lost": counters.get("lost_transitions", 0)
            }
            tables = {"Broker away": [row], "99th percentile of latency, ms": latency.rows()}
            show(tables, ["times from the return of the broker"], as_json=as_json)
    finally:
        subscriber.client.disconnect()
        subscriber.client.loop_stop()
        chain.close()
        broker.stop()
        shutil.rmtree(folder, ignore_errors=True)


def row_of(operator: Operator, subscriber: Subscriber, outage_s: float, back_s: float) -> dict[str, Any]:
    expected, counts = operator.heard(), Counter(key for _, key, _ in subscriber.heard)
    numbers = [number for number, _, _ in subscriber.heard]
    came_s = [each - back_s for *_, each in subscriber.heard if each > back_s]
    return {
        "away, s": outage_s,
        "transitions": len(expected),
        "arrived": len(counts),
        "missing": len(expected - counts.keys()),
        "twice": sum(counts.values()) - len(counts),
        "in order": "yes" if numbers == sorted(numbers) else "no",
        "first after, s": min(came_s),
        "last after, s": max(came_s),
        "longest answer of the scorer, s": max(operator.answers_s),
    }


if __name__ == "__main__":
    typer.run(main)

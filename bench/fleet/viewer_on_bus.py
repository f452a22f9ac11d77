"""What a fleet costs the viewer over the bus: the share of a core that its process takes, Zenoh and Rerun included.

Another process publishes the scores and alarms of a made-up fleet, made beforehand, as fast as they would come; some
fans are in alarm from the beginning. This process is the viewer with its runner: a view in a file, served, with nobody
watching. On a machine with other work the fleet may come more slowly than in real time: the rate says so.

    python -m bench.fleet.viewer_on_bus
"""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
import threading
import time
from collections.abc import Callable
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.detection.plant import START_NS
from bench.fleet.fleet_scores import DELAY_S, SITE, FleetScores
from bench.printing import JsonOption, progress, show
from bench.runtime.stage_memory import free_endpoint
from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import BusConfig, Config
from fantwin.pipeline.runtime.runner import Runner
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.topics import BY_NAME, tray_key
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.viewer import STAGE

FLEETS = (1_000, 10_000)
READY_S = 600.0
"""the fleet is made before the first message is sent"""


def main(
    fans: Annotated[int, typer.Option(help="Of the fleet; 0: 1,000 and 10,000.")] = 0,
    seconds: Annotated[int, typer.Option(help="Of data; all of it is held in memory, 100 bytes a fan-sample.")] = 15,
    block_s: Annotated[float, typer.Option(help="Length of the messages, s.")] = 0.05,
    alarms: Annotated[int, typer.Option(help="Fans in alarm.")] = 8,
    json_output: JsonOption = False,
) -> None:
    """Print the share of a core that the viewer's process takes, by the number of fans at 100 Hz."""
    rows: list[dict[str, Any]] = []
    for count in (fans,) if fans else FLEETS:
        progress(f"{count} fans")
        with tempfile.TemporaryDirectory() as folder:
            rows.append(cost_on_bus(count, seconds, block_s, alarms, Path(folder)))
    notes = ["peak: of this process, all rows before included; rate: of the fleet, 1 is real time"]
    show({"the viewer on the bus, at 100 Hz": rows}, notes, as_json=json_output)


def cost_on_bus(fans: int, seconds: int, block_s: float, alarms: int, folder: Path) -> dict[str, Any]:
    """What a fleet costs, from its first message to its last."""
    endpoint, spawned = free_endpoint(), multiprocessing.get_context("spawn")
    is_made, may_begin, is_sent, may_end = (spawned.Event() for _ in range(4))
    arguments = (endpoint, fans, seconds, block_s, alarms, is_made, may_begin, is_sent, may_end)
    scorers = spawned.Process(target=publish, args=arguments, daemon=True)
    scorers.start()
    assert is_made.wait(READY_S), "the fleet is not made in time"
    stop, is_ready, healths = threading.Event(), threading.Event(), list[Health]()

    def on_health(health: Health) -> None:
        healths[:] = [health]
        if health.status == StageStatus.OK:
            is_ready.set()

    runner = Runner(STAGE, _config(endpoint, fans, block_s, folder), None, stop, on_health)
    viewer = threading.Thread(target=runner.run)
    viewer.start()
    assert is_ready.wait(READY_S), "the viewer does not start"
    began_s, cpu_s = time.monotonic(), time.process_time()
    may_begin.set()
    assert is_sent.wait(READY_S), "the fleet is not sent in time"
    took_s, cpu_s = time.monotonic() - began_s, time.process_time() - cpu_s
    stop.set()
    viewer.join()
    may_end.set()
    scorers.join()
    counters = {counter.name: counter.value for counter in healths[0].counters}
    return {
        "fans": fans,
        "message, s": block_s,
        "rate": seconds / took_s,
        "% of a core": 100.0 * cpu_s / took_s,
        "messages followed": sum(line.received for line in healths[0].inputs if line.key.endswith("/score")),
        "samples drawn": counters["samples_drawn"],
        "dropped": counters.get("dropped", 0),
        "peak, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }


def publish(
    endpoint: str,
    fans: int,
    seconds: int,
    block_s: float,
    alarms: int,
    is_made: Event,
    may_begin: Event,
    is_sent: Event,
    may_end: Event,
) -> None:
    """Send what the scorers of a fleet send, in real time; in a process of its own."""
    fleet = FleetScores(fans, block_s=block_s)
    fleet.add_excursions(alarms, 0.0, DELAY_S)
    messages = [message for second in range(seconds) for message in fleet.second(second)]
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        put = {tray.name: _publishers(bus, tray.name) for tray in fleet.trays}
        is_made.set()
        may_begin.wait()
        began_s = time.monotonic()
        for message in messages:
            is_score = isinstance(message, Envelope)
            t_ns = message.received_t_ns if is_score else message.t_ns
            early_s = began_s + (t_ns - START_NS) / NS_PER_S - time.monotonic()
            if early_s > 0.0:
                time.sleep(early_s)
            put[message.header.tray][is_score](message)
        is_sent.set()
        may_end.wait()


def _publishers(bus: Bus, tray: str) -> dict[bool, Callable[[Any], None]]:
    def publisher(topic: str, kind: type[Score | Alarm]) -> Publisher:
        return bus.publisher(tray_key(SITE, tray, topic), BY_NAME[topic], type_name(kind), "scorer-all-0123abcd")

    scores, alarms = publisher("score", Score), publisher("alarm", Alarm)
    return {True: lambda score: scores.put(score.payload), False: lambda alarm: alarms.put(encode(alarm))}


def _config(endpoint: str, fans: int, block_s: float, folder: Path) -> Config:
    trays = FleetScores(fans, block_s=block_s).trays
    port = free_endpoint().rpartition(":")[2]
    lines = [f'site = "{SITE}"', f'[bus]\nendpoint = "{endpoint}"', f"[viewer]\ngrpc_port = {port}"]
    lines += [f'[[tray]]\nname = "{tray.name}"\nfans = {tray.fans}\nspeed_unit = "rpm"' for tray in trays]
    return parse_config("\n".join(lines), folder / "fantwin.toml", stages=("viewer",))


if __name__ == "__main__":
    typer.run(main)

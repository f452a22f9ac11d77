"""Trays of simulated fans whose raw samples are made beforehand and published on the bus, as a device would send them.

The fans are those of the demo, so its twin fits them. One fan after the other is disturbed for a while: so there is
nearly always an alarm that a shard which dies may raise again, or forget. All trays have the same fans, each a little
later than the one before.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.bus.session import Bus
from fantwin.schemas.codec import decode, encode, type_name
from fantwin.schemas.device_sample import DeviceSample
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health, Output
from fantwin.schemas.messages import Raw, Score
from fantwin.schemas.topics import ALL_TRAYS, BY_NAME, health_key, tray_key
from fantwin.schemas.units import NS_PER_S
from fantwin.simulation.faults import Fault
from fantwin.simulation.tray import SimulatedTray, TraySettings

SITE, PRODUCER, FANS, RATE_HZ = "fleet", "feed-1", 8, 100
FAULT_S, PERIOD_S = 6.0, 10.0
"""a fault of this length begins once in each period"""
FREE_RUN_BEGINS_AGAIN_S = 13.0
"""by how much an alarm may move where resampler or integrator are restarted: the free run begins again and is valid
after the warm-up of 3 s, and the ten seconds for which a fan must be like a healthy one are counted again. Where only
scorer and recorder are restarted, no alarm moves"""
SHIFT = 50
"""samples by which a tray begins later in the run of the fans than the one before"""
BUSY = "watchdog_s = 120\n"
"""settings of [launcher] for a machine that has other things to do"""
TWIN = Path(__file__).parents[2] / "pipeline" / "demo" / "twin.onnx"


@dataclass(frozen=True)
class Load:
    """What is fed.

    Attributes:
        seconds: of samples that are fed in real time, with faults.
        block: samples of a message.
        beginning_s: seconds of healthy samples before that, which are fed as fast as they are taken.
    """

    trays: int
    seconds: float
    block: int = 5
    beginning_s: float = 20.0

    @property
    def names(self) -> list[str]:
        """Of the trays."""
        return [f"tray{number}" for number in range(1, self.trays + 1)]

    @property
    def tables(self) -> str:
        """The part of a configuration that is about the trays.

        The resampler waits for samples however late they come: on a busy machine the feed may be behind, which is no
        gap.
        """
        of_tray = '[[tray]]\nname = "{}"\nfans = {}\nspeed_unit = "rpm"\ntwin = "{}"\n'
        timing = f"[resampler]\nrate_hz = {RATE_HZ}\nwatermark_s = 600\n"
        return timing + "".join(of_tray.format(name, FANS, TWIN) for name in self.names)

    def made_beforehand(self) -> dict[str, list[Raw]]:
        """The messages of each tray. The last sample is of the present."""
        samples = list(_samples(self._device()))
        wanted = len(samples) - self.trays * SHIFT
        epoch_ns = time.time_ns() - wanted * NS_PER_S // RATE_HZ
        return {
            name: list(_raws(name, samples[number * SHIFT : number * SHIFT + wanted], epoch_ns, self.block))
            for number, name in enumerate(self.names)
        }

    def _device(self) -> SimulatedTray:
        end_s = self.beginning_s + self.seconds
        latest_s = end_s - PERIOD_S - FREE_RUN_BEGINS_AGAIN_S  # so that the last alarm clears in time, if it moves too
        times = np.arange(self.beginning_s, latest_s + 1.0, PERIOD_S).tolist()
        faults = (Fault("rotor", n % FANS, start_s, start_s + FAULT_S, 1.0) for n, start_s in enumerate(times))
        run_s = end_s + self.trays * SHIFT / RATE_HZ
        return SimulatedTray(TraySettings(seed=7, duration_s=run_s, faults=tuple(faults)))


class Feed:
    """Publishes what was made beforehand, and inside `with` once a second, as a stage does, how much that is: so that
    what is lost with a connection is asked for."""

    def __init__(self, bus: Bus, load: Load, messages: Mapping[str, Sequence[Raw]]) -> None:
        topic = BY_NAME["raw"]
        self._publishers: dict[str, Publisher] = {
            tray: bus.publisher(tray_key(SITE, tray, "raw"), topic, type_name(Raw), PRODUCER) for tray in messages
        }
        self._messages = list(zip(*messages.values(), strict=True))
        self._block_s = load.block / RATE_HZ
        self._beginning = round(load.beginning_s / self._block_s)
        key = health_key(SITE, "feed", ALL_TRAYS)
        self._health = bus.publisher(key, BY_NAME["health"], type_name(Health), PRODUCER)
        self._has_ended = threading.Event()
        self._reporting = threading.Thread(target=self._report)

    def __enter__(self) -> Feed:
        self._reporting.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._has_ended.set()
        self._reporting.join()

    def begin(self) -> None:
        """Publish the beginning; waits while a consumer is behind."""
        for together in self._messages[: self._beginning]:
            self._publish(together)

    def run(self) -> None:
        """Publish the rest in real time."""
        began_s = time.monotonic()
        for number, together in enumerate(self._messages[self._beginning :]):
            time.sleep(max(0.0, began_s + number * self._block_s - time.monotonic()))
            self._publish(together)

    def _report(self) -> None:
        began_s = time.monotonic()
        while not self._has_ended.wait(1.0):
            health = Health(
                header=Header(PRODUCER, self._health.published, ""),
                stage="feed",
                instance=ALL_TRAYS,
                status=StageStatus.OK,
                t_ns=time.time_ns(),
                uptime_s=time.monotonic() - began_s,
                outputs=tuple(Output(key=each.key, published=each.published) for each in self._publishers.values()),
            )
            self._health.put(encode(health))

    def _publish(self, together: Sequence[Raw]) -> None:
        for publisher, raw in zip(self._publishers.values(), together, strict=True):
            publisher.put(encode(raw))


class NewestScores:
    """The time of the newest scored sample of each tray, as heard on the bus."""

    def __init__(self, bus: Bus) -> None:
        self._newest_ns: dict[str, int] = {}
        bus.subscribe(tray_key(SITE, "*", "score"), self._hear)

    def have_reached(self, load: Load, messages: Mapping[str, Sequence[Raw]], seconds: float) -> bool:
        """Whether so many seconds of samples are scored in all trays, but for what waits for the next sample."""
        length_ns = round((seconds - 3 * load.block / RATE_HZ) * NS_PER_S)
        return all(
            self._newest_ns.get(tray, 0) >= int(raws[0].host_receive_t_ns[0]) + length_ns
            for tray, raws in messages.items()
        )

    def _hear(self, key: str, payload: bytes) -> None:
        tray, newest_ns = key.split("/")[2], int(decode(Score, payload).t_ns[-1])
        self._newest_ns[tray] = max(newest_ns, self._newest_ns.get(tray, 0))


def _raws(tray: str, samples: Sequence[DeviceSample], epoch_ns: int, length: int) -> Iterator[Raw]:
    for sequence, first in enumerate(range(0, len(samples), length)):
        block = samples[first : first + length]
        t_ns = [epoch_ns + round((sample.t_s - samples[0].t_s) * NS_PER_S) for sample in block]
        yield Raw(
            header=Header(PRODUCER, sequence, tray),
            fans=FANS,
            host_receive_t_ns=np.array(t_ns, np.int64),
            device_clock_us=np.array([sample.clock_us for sample in block], np.uint32),
            device_sequence=np.array([sample.sequence for sample in block], np.uint32),
            command=np.array([sample.command for sample in block]),
            speed_rad_s=np.array([sample.speed_rad_s for sample in block]),
        )


def _samples(tray: SimulatedTray) -> Iterator[DeviceSample]:
    while tray.due_s() is not None:
        yield tray.take()

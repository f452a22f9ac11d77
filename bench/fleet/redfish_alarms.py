"""Alarms in a hall of controllers: false ones of healthy fans, and faults that are found.

Simulated controllers (`redfish_controllers.py`) are asked by the source as in service, in simulated time: each request
takes a while, and now and then much longer. The stages judge what comes of it as fast as they can, so that the load of
this computer decides nothing. Each tray has a twin of its own, from two recordings, calibrated with a third.

    python -m bench.fleet.redfish_alarms
    python -m bench.fleet.redfish_alarms --controllers 5 --hours 0.5
"""

from __future__ import annotations

import math
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import numpy as np
import typer

import fantwin
from bench.detection.plant import START_NS
from bench.fleet.hall_fans import FANS, SHOWN_S, HallFans, HallFault
from bench.fleet.redfish_controllers import SHAPES, answer
from bench.printing import JsonOption, progress, show
from bench.stage_context import stage_context
from fantwin.pipeline.acquisition.sample_blocks import ReceivedReading, raw_message
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.recordings.reading import TACHO_KEY
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.runtime.stage import load_stage
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.redfish.config import RedfishConfig
from fantwin.pipeline.sources.redfish.source import RedfishSource
from fantwin.pipeline.sources.source import Reading, SourceContext
from fantwin.pipeline.timebase.device_clock import UINT32
from fantwin.schemas.enums import Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Raw
from fantwin.schemas.tacho import tachos_to_json
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S

SITE, PERIOD_S = "hall", 1.0
REQUEST_S, STALL_S, STALLS = (0.03, 0.15), (0.2, 0.9), 0.01
"""duration of a request; what it takes longer for a share of them"""
STAGES = ("resampler", "twin_integrator", "scorer")
FAULTS = {
    "10 % slower": (0.10, False),
    "5 % slower": (0.05, False),
    "clogs by 6 % in 3 min": (0.06, True),
    "blocked": (1.0, False),
    "15 % slower": (0.15, False),
}
FAULTY_S = 600.0
TACHO = f'{{ kind = "average", window_s = 1.0, update_s = {SHOWN_S:g} }}'


class SimulatedClient:
    """Takes the place of `RedfishClient`; `now_s` goes on with each request."""

    def __init__(self, hall: HallFans, number: int, seed: int) -> None:
        self.now_s = 0.0
        self._hall, self._number, self._rng = hall, number, np.random.default_rng([seed, number])

    def log_in(self) -> None:
        """No user."""

    def close(self) -> None:
        """Nothing is open."""

    def get(self, path: str) -> Any:
        """The object at a path, as it is somewhere within the request."""
        took_s = self._rng.uniform(*REQUEST_S) + (self._rng.random() < STALLS) * self._rng.uniform(*STALL_S)
        before_s = took_s * self._rng.uniform(0.2, 0.8)
        fans = self._hall.at(self._number, self.now_s + before_s)
        self.now_s += took_s
        status, found = answer(self._number, path.partition("?")[0], fans)
        if status != 200:
            raise DeviceError(f"{path}: refused with HTTP status {status}")
        return found


def samples(hall: HallFans, number: int, seconds: float, seed: int, config: Config, t_ns: int) -> Iterator[Raw]:
    """What acquisition makes of a controller that is polled. t_ns: of the beginning."""
    command = list(SHAPES.values())[number % len(SHAPES)]
    source_config = RedfishConfig.model_validate({"url": "http://bmc", "command": command or ()})
    client = SimulatedClient(hall, number, seed)
    source = RedfishSource(source_config, SourceContext(FANS, "rpm", Path()))
    with mock.patch("fantwin.pipeline.sources.redfish.source.RedfishClient", lambda *_: client):
        source.connect()
    due_s, sequence = client.now_s, 0
    while client.now_s < seconds:
        began_s = client.now_s
        reading = source.read()
        assert isinstance(reading, Reading)
        middle_us = round((began_s + client.now_s) / 2.0 * 1e6) % UINT32
        received = ReceivedReading(
            replace(reading, clock_us=middle_us, sequence=sequence), t_ns + round(client.now_s * NS_PER_S)
        )
        tray = config.trays[0]
        yield replace(raw_message([received], tray), header=Header("acquisition", sequence, tray.name))
        skipped = max(0, math.ceil((client.now_s - due_s) / PERIOD_S) - 1)
        due_s, sequence = due_s + (skipped + 1) * PERIOD_S, sequence + skipped + 1
        client.now_s = max(client.now_s, due_s)


def main(
    controllers: Annotated[int, typer.Option(help="With two fans each.")] = 10,
    hours: Annotated[
        float, typer.Option(help="That healthy fans are judged for, before one of each has a fault.")
    ] = 1.0,
    minutes: Annotated[float, typer.Option(help="Of each recording that is learned from.")] = 30.0,
    model: Annotated[str, typer.Option(help="Of the twins.")] = "hybrid",
    is_declared: Annotated[bool, typer.Option("--declared/--undeclared", help="Whether the tacho is.")] = True,
    json_output: JsonOption = False,
) -> None:
    """Print the alarms of each controller."""
    learned_s, healthy_s = 60.0 * minutes, 3600.0 * hours
    faults = [
        HallFault(number, number // len(FAULTS) % FANS, healthy_s, *list(FAULTS.values())[number % len(FAULTS)])
        for number in range(controllers)
    ]
    progress("simulating the hall")
    learned = [HallFans(controllers, learned_s, seed) for seed in (1, 2, 3)]
    judged = HallFans(controllers, healthy_s + FAULTY_S, 4, faults)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", fantwin.FantwinWarning)
        for number, fault in enumerate(faults):
            progress(f"controller {number}")
            config = _config(Path(folder), f"bmc{number}", is_declared)
            twin = _twin(Path(folder), number, learned, learned_s, config, model)
            config = _config(Path(folder), f"bmc{number}", is_declared, twin)
            alarms = _alarms(samples(judged, number, healthy_s + FAULTY_S, 4, config, START_NS), config)
            rows.append(_row(number, fault, alarms))
    found = [row["found after, s"] for row in rows if not math.isnan(row["found after, s"])]
    about = f"{len(found)} of {len(rows)} faults found; {sum(row['false alarms'] for row in rows)} false alarms"
    show({"alarms": rows}, [f"{about} in {controllers * FANS * hours:g} fan-hours"], as_json=json_output)


def _row(number: int, fault: HallFault, alarms: list[Alarm]) -> dict[str, Any]:
    raised = [((each.t_ns - START_NS) / NS_PER_S, each) for each in alarms if each.transition == Transition.RAISED]
    found = [(t_s, each.message) for t_s, each in raised if each.fan == fault.fan and t_s >= fault.start_s]
    at_s, message = found[0] if found else (math.nan, "")
    return {
        "controller": list(SHAPES)[number % len(SHAPES)],
        "fault": list(FAULTS)[number % len(FAULTS)],
        "false alarms": len(raised) - len(found),
        "found after, s": at_s - fault.start_s,
        "as": message.partition(": ")[2],
    }


def _config(folder: Path, tray: str, is_declared: bool, twin: Path | None = None) -> Config:
    keys = (f"tacho = {TACHO}\n" if is_declared else "") + (f'twin = "{twin}"\n' if twin else "")
    text = (
        f'site = "{SITE}"\nrun_folder = "runs"\n[[tray]]\nname = "{tray}"\nfans = {FANS}\nspeed_unit = "rpm"\n'
        f"speed_max = 50000\ncommand_max = 100\n{keys}"
    )
    return parse_config(text, folder / "fantwin.toml", (), STAGES)


def _twin(folder: Path, number: int, halls: list[HallFans], seconds: float, config: Config, model: str) -> Path:
    """The calibrated twin of a controller's fans."""
    tray, paths = config.trays[0], list[Path]()
    metadata = {"site": SITE, "trays": tray.name, "speed_unit": "rpm"}
    metadata[f"{TACHO_KEY}.{tray.name}"] = tachos_to_json(tray.tachos)
    for seed, hall in enumerate(halls, 1):
        paths.append(folder / f"{tray.name}-{seed}.mcap")
        with RecordingWriter(paths[-1], metadata) as writer:
            for raw in samples(hall, number, seconds, seed, config, START_NS - seed * 86_400 * NS_PER_S):
                writer.add_message(tray_key(SITE, tray.name, "raw"), raw, int(raw.host_receive_t_ns[-1]))
            writer.finish()
    train, validate, more = map(str, paths)
    twin = fantwin.train(train, validate=validate, model=model, name=tray.name)
    fantwin.calibrate(twin, [validate, more], false_alarms_per_day=1, extrapolate=True).save(
        f"{folder}/{tray.name}.onnx"
    )
    return folder / f"{tray.name}.onnx"


@cache
def _stage(name: str) -> Any:
    return load_stage(name)


def _alarms(lines: Iterator[Raw], config: Config) -> list[Alarm]:
    resampler, integrator, scorer = (_stage(name).build(stage_context(config, name)).core for name in STAGES)
    grids = (grid for raw in lines for grid in resampler.step(raw))
    made = (prediction for grid in grids for prediction in integrator.step(grid))
    return [message for prediction in made for message in scorer.step(prediction) if isinstance(message, Alarm)]


if __name__ == "__main__":
    typer.run(main)

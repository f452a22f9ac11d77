"""What becomes of a channel from the payload of a source to every output, of fans that all vibrate alike.

    python -m tests.support.vibrating_fan FOLDER CHANNEL

It prints where the channel was found, as JSON. The package that it imports may have a channel more than this one.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from prometheus_client.parser import text_string_to_metric_families

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.recordings import read_arrays
from fantwin.pipeline.runtime.stage import Core
from fantwin.pipeline.sources.json_samples import batches_of, parse_samples
from fantwin.pipeline.timebase.receipt_times import ReceiptTimes
from fantwin.schemas import wire
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Grid, Message, Prediction, Raw, Score
from fantwin.stages.acquisition import AcquisitionConfig
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore
from fantwin.stages.twin_integrator import TwinIntegratorConfig, TwinIntegratorCore
from fantwin.stages.viewer import build
from tests.support.drawn_views import context, rows_of, sent
from tests.support.fantwin_command import fantwin
from tests.support.made_messages import TOPIC_OF
from tests.support.running_core import FANS, SITE, TRAY
from tests.support.running_gateway import Client, RunningGateway
from tests.support.scored_blocks import core_of
from tests.support.serial_core import FakeLink, SerialCore
from tests.support.small_recordings import write
from tests.support.twin_files import write_twin

START_S, SECONDS, RATE_HZ = 1_790_000_000, 4, 50
KINDS = (Raw, Grid, Prediction, Score)


def payloads(channel: str) -> Iterable[bytes]:
    """Samples as a source over MQTT or HTTP gets them, in which the channel rises from 0 to 1."""
    for number in range(SECONDS * RATE_HZ):
        values = {"command": 50.0, "speed": 300.0, channel: number / (SECONDS * RATE_HZ)}
        yield json.dumps({"t": START_S + number / RATE_HZ, "fans": [values] * FANS}).encode()


def through(core: Core, messages: Iterable[Message]) -> list[Any]:
    """What a stage makes of messages that come over the bus."""
    made: list[Any] = []
    for message in messages:
        made += core.step(decode(type(message), encode(message)))
    return [*made, *core.close()]


def raw_of(channel: str) -> list[Any]:
    """What acquisition publishes."""
    tray = TrayConfig.model_validate({"name": TRAY, "fans": FANS, "port": "p", "command_max": 100.0})
    core = SerialCore(tray, AcquisitionConfig(), FakeLink())
    receipts, made = ReceiptTimes(), []
    for number, payload in enumerate(payloads(channel)):
        received_t_ns = START_S * 10**9 + number * 10**9 // RATE_HZ
        for batch in batches_of(parse_samples(payload), received_t_ns, receipts, len(payload)):
            made += core.step(batch)
    return [*made, *core.close()]


def all_messages(folder: Path, channel: str) -> list[Message]:
    """Messages of all stages, with headers as the runner gives them."""
    twin = TwinFile.load(write_twin(folder / "twin.onnx", fans=FANS), FANS)
    raws = raw_of(channel)
    grids = through(ResamplerCore(FANS, ResamplerConfig(rate_hz=RATE_HZ)), raws)
    of_integrator = through(TwinIntegratorCore(twin, TwinIntegratorConfig(), 0), grids)
    predictions = [each for each in of_integrator if isinstance(each, Prediction)]
    scores = [each for each in through(core_of(FANS), predictions) if isinstance(each, Score)]
    return [
        type(message)(**{**vars(message), "header": Header(f"{TOPIC_OF[type(message)]}-all-1", number, TRAY)})
        for messages in (raws, grids, predictions, scores)
        for number, message in enumerate(messages)
    ]


def main(folder: Path, channel: str) -> None:
    """Print, by output, the values of fan 1 there, or which names it has."""
    messages = all_messages(folder, channel)
    scores = [message for message in messages if isinstance(message, Score)]
    metadata = {"site": SITE, "trays": TRAY, f"fans.{TRAY}": str(FANS), f"speed_unit.{TRAY}": "rpm"}
    path = write(folder / "r.mcap", messages, metadata, start=START_S * 10**9)
    every = tuple(float(np.float32(-1.1754944e-38)) * (1 + fan % 2) for fan in range(wire.MAX_FANS))
    longest = wire.Sample(2**32 - 1, 2**32 - 1, every, every, {each.name: every for each in CHANNELS})
    found: dict[str, Any] = {
        "line": wire.Decoder("text", wire.MAX_FANS).feed(wire.encode("text", longest)) == [longest]
    }
    for kind in KINDS:
        topic = TOPIC_OF[kind]
        of_topic = [block[channel][:, 1] for block in read_arrays(path, topic) if len(block[channel])]
        found[f"recording, {topic}"] = np.concatenate(of_topic).tolist()
    table = folder / "table.csv"
    exported = fantwin("export", path, "--topic", "raw", "--to", "csv", "-o", table)
    assert exported.exit_code == 0, exported.output
    rows = pd.read_csv(table)
    found["export"] = rows.loc[rows["fan"] == 1, channel].tolist()
    gateway = RunningGateway(folder)
    gateway.feed(*scores)
    client = Client(gateway)
    range_s = f"from={START_S}&to={START_S + 60}&points=4000"
    found["page"] = client.ask("GET", f"/api/v1/fans/{TRAY}/1/series?{range_s}")[1]["columns"][channel]["max"]
    found["page, words"] = client.ask("GET", "/api/v1/site")[1]["channels"]
    families = text_string_to_metric_families(client.ask("GET", "/metrics")[1])
    found["metrics"] = [
        sample.value
        for family in families
        if family.name == f"fantwin_fan_{channel}"
        for sample in family.samples
        if sample.labels["fan"] == "1"
    ]
    gateway.close()
    viewer = build(context(folder, fans=FANS)).core
    for score in scores:
        viewer.step(sent(score))
        viewer.tick(int(score.t_ns[-1]))
    viewer.close()
    shown = [row["Scalars:scalars"][0] for _, row in rows_of(folder / "view.rrd")[f"/{TRAY}/{channel}/fan_1"]]
    found["Rerun"] = [value for value in shown if np.isfinite(value)]
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])

"""Acquisitions in threads of this process, and what they publish."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import BusConfig, Config
from fantwin.pipeline.config.shards import chosen_shard
from fantwin.schemas.codec import decode
from fantwin.schemas.fields import Array
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import tray_key
from fantwin.stages.acquisition import STAGE
from tests.support.running_chain import eventually
from tests.support.running_stage import RunningStage

SITE, TRAY = "plant", "tray1"


def push_config(
    endpoint: str, folder: Path, fans: int | str = 2, source: str = '{ kind = "push" }', more: str = ""
) -> Config:
    """A site of one tray."""
    text = f"""
site = "{SITE}"
run_folder = "{folder}"
[bus]
endpoint = "{endpoint}"
[launcher]
stages = ["acquisition"]
[[tray]]
name = "{TRAY}"
fans = {fans}
speed_unit = "rpm"
speed_max = 20000
source = {source}
{more}
"""
    return parse_config(text, folder / "fantwin.toml")


class Raws:
    """The raw samples that are published, as long as the bus is open."""

    def __init__(self, bus: Bus) -> None:
        self.messages: list[Raw] = []
        bus.subscribe(tray_key(SITE, TRAY, "raw"), lambda _key, payload: self.messages.append(decode(Raw, payload)))

    def column(self, name: str) -> Array:
        return np.concatenate([getattr(message, name) for message in self.messages])

    @property
    def count(self) -> int:
        return sum(len(message.host_receive_t_ns) for message in self.messages)

    def wait_for(self, samples: int) -> None:
        eventually(lambda: self.count >= samples, f"{samples} samples are published")


@contextmanager
def raws_of(endpoint: str) -> Iterator[Raws]:
    """What a site at this endpoint publishes. It listens there, so that acquisitions come and go."""
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        yield Raws(bus)


@contextmanager
def acquisition(config: Config) -> Iterator[RunningStage]:
    """A session of acquisition that ends with the block."""
    with RunningStage(STAGE, config, chosen_shard("acquisition", config)) as running:
        yield running

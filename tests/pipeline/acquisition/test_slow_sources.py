"""Acquisition of a source that is slow: what is normal for it."""

from __future__ import annotations

from pathlib import Path

from fantwin.pipeline.acquisition.acquisition_core import AcquisitionCore
from fantwin.pipeline.acquisition.sample_blocks import ReadingBlock
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.sources.source import LinkUp, Noted, Reading, ReadingBatch
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.acquisition import STAGE

START_NS = 1_790_000_000 * NS_PER_S
CONFIGURATION = """
[[tray]]
name = "node7"
fans = 2
speed_unit = "rpm"
speed_max = 10000
command_max = 100
source = { kind = "prometheus", url = "http://127.0.0.1:9", fan = [{ speed = "rpm" }, { speed = "rpm2" }] }
"""


def core() -> AcquisitionCore:
    config = parse_config(CONFIGURATION, Path("fantwin.toml"), stages=("acquisition",))
    context = Context("site", config.trays, config.sections["acquisition"], Path(), Path("runs"), started_t_ns=START_NS)
    made = STAGE.build(context).core
    assert isinstance(made, AcquisitionCore)
    made.step(LinkUp())
    return made


def take(made: AcquisitionCore, after_s: float, command: float) -> int:
    """Hand over a reading; the number of samples that are published."""
    reading = Reading((40.0, command), (1000.0, 1100.0))
    batch = ReadingBatch(START_NS + round(after_s * NS_PER_S), (reading,))
    return sum(len(raw.host_receive_t_ns) for raw in made.step(ReadingBlock((batch,))))


def test_silence_is_measured_by_the_period_of_the_source() -> None:
    made = core()
    assert take(made, 1, 50.0) == 1
    made.tick(START_NS + 38 * NS_PER_S)
    assert made.problem() == ""
    made.tick(START_NS + 39 * NS_PER_S)
    assert "nothing received for 37.5 s" in made.problem()


def test_what_is_noted_beside_a_reading_makes_its_source_no_faster() -> None:
    made = core()
    for after_s in (15, 30, 45):
        noted = ReadingBatch(START_NS + after_s * NS_PER_S, (Noted("unread_objects", "/Fans/3"),))
        made.step(ReadingBlock((noted,) * 4))
        assert take(made, after_s, 50.0) == 1
    made.tick(START_NS + 59 * NS_PER_S)
    assert made.problem() == ""

"""Acquisition of a source that is slow: what is normal for it."""

from __future__ import annotations

from pathlib import Path

import pytest

from fantwin.pipeline.acquisition.acquisition_core import AcquisitionCore
from fantwin.pipeline.acquisition.sample_blocks import ReadingBlock
from fantwin.pipeline.config.loading import ConfigError, parse_config
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


def core(more: str = "") -> AcquisitionCore:
    config = parse_config(f"{CONFIGURATION}{more}", Path("fantwin.toml"), stages=("acquisition",))
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


def test_a_stand_in_that_the_source_does_not_have_is_said_and_others_are_two_fans_or_more() -> None:
    made = core('command_from = "temperature"\n')
    assert take(made, 1, 50.0) == 1, "its speeds are kept"
    assert made.counters()["unknown_command"] == 1
    said = "command_from = temperature: the source gives no such value of any fan; none is judged (unknown_command 1)"
    assert said in made.notes()
    made = core('command_from = "others"\n')
    assert take(made, 1, 50.0) == 1 and made.counters()["fans_without_command"] == 0
    alone = CONFIGURATION.replace("fans = 2", 'fans = 1\ncommand_from = "others"')
    with pytest.raises(ConfigError, match="it needs two or more"):
        parse_config(alone, Path("fantwin.toml"), stages=("acquisition",))

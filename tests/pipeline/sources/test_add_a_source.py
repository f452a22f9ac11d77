"""A source of samples is one file and one row: a toy one runs through acquisition, and nothing else knows of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from fantwin.pipeline.acquisition.sample_blocks import BlockEvent, SampleBlocks
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import ConfigError
from fantwin.pipeline.plugins import SourceKind
from fantwin.pipeline.runtime.stage import BuiltStage, Context
from fantwin.pipeline.sources.kinds import SOURCE_KINDS
from fantwin.pipeline.sources.serial.config import SerialConfig
from fantwin.schemas.messages import Raw, StatedTacho
from fantwin.schemas.tacho import Tacho
from fantwin.stages.acquisition import STAGE
from tests.support.toy_source import ToyConfig, ToySource

CONFIGURATION = """
[[tray]]
name = "bench"
fans = 2
speed_unit = "rpm"
speed_max = 1000
source = { kind = "toy", speeds = [60.0, 2000.0, 120.0] }
[acquisition]
block_s = 0.1
"""


@pytest.fixture(autouse=True)
def _toy_row(monkeypatch: pytest.MonkeyPatch) -> None:
    row = SourceKind("tests.support.toy_source:ToyConfig", "tests.support.toy_source:ToySource")
    monkeypatch.setitem(SOURCE_KINDS, "toy", row)


def context(text: str = CONFIGURATION) -> Context:
    config = parse_config(text, Path("fantwin.toml"))
    return Context("site", config.trays, config.sections["acquisition"], Path(), Path("runs"), started_t_ns=0)


def built(text: str = CONFIGURATION) -> tuple[BuiltStage, ToySource]:
    parts = STAGE.build(context(text))
    assert isinstance(parts.source, SampleBlocks) and isinstance(parts.source.source, ToySource)
    return parts, parts.source.source


def events_of(parts: BuiltStage) -> list[BlockEvent]:
    """What the source delivers, up to its end."""
    events: list[BlockEvent] = []
    assert parts.source
    parts.source.start(events.append)
    parts.source.stop()
    return events


def test_the_configuration_of_a_new_kind_is_checked_by_its_own_model() -> None:
    (tray,) = parse_config(CONFIGURATION, Path("fantwin.toml")).trays
    assert tray.source == ToyConfig(speeds=(60.0, 2000.0, 120.0))
    with pytest.raises(ConfigError, match=r"tray.0.source.speeds.1 = 'fast': input should be a valid number"):
        parse_config(CONFIGURATION.replace("2000.0", '"fast"'), Path("fantwin.toml"))


def test_what_a_source_states_to_measure_is_in_its_messages_unless_the_tray_says_otherwise() -> None:
    def messages(text: str) -> list[Raw]:
        parts, _source = built(text)
        return [each for event in events_of(parts) for each in parts.core.step(event) if isinstance(each, Raw)]

    stated = CONFIGURATION.replace("speeds", "average_s = 0.5, speeds")
    average, count = Tacho(kind="average", window_s=0.5), Tacho(kind="count", window_s=1.0)
    (tray,) = parse_config(stated, Path("fantwin.toml")).trays
    assert tray.tachos == (average,)
    assert [raw.tachos for raw in messages(stated)] == [(StatedTacho.of(average),)]
    overridden = stated.replace("speed_unit", 'tacho = { kind = "count", window_s = 1.0 }\nspeed_unit')
    assert parse_config(overridden, Path("fantwin.toml")).trays[0].tachos == (count,)
    assert [raw.tachos for raw in messages(overridden)] == [(StatedTacho.of(count),)]
    # A configuration that says it of a source that does not know is no statement of the source.
    assert [raw.tachos for raw in messages(overridden.replace("average_s = 0.5, ", ""))] == [()]


TRAY = '[[tray]]\nname = "a"\nfans = 1\n'


def test_port_baud_and_protocol_in_the_tray_are_the_short_form_of_a_serial_source() -> None:
    def source_of(text: str, *overrides: str) -> object:
        (tray,) = parse_config(TRAY + text, Path("fantwin.toml"), overrides).trays
        return tray.source

    usb = 'port = "/dev/ttyUSB0"\n'
    keys = 'kind = "serial", port = "/dev/ttyUSB0", baud = 9600, protocol = "text"'
    expected = SerialConfig(port="/dev/ttyUSB0", baud=9600, protocol="text")
    assert source_of(usb + 'baud = 9600\nprotocol = "text"\n') == source_of(f"source = {{ {keys} }}\n") == expected
    assert source_of(usb, "tray.0.port=/dev/ttyACM1") == SerialConfig(port="/dev/ttyACM1")
    long = 'source = { kind = "serial" }'
    assert source_of(long, "tray.0.source.port=/dev/ttyACM1") == SerialConfig(port="/dev/ttyACM1")

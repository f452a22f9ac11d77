"""Acquisition of pushed samples: whatever a program sends on topic `reading` is published or counted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.acquisition.acquisition_core import AcquisitionCore
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.sources.push.source import SILENT_NS, PushSource
from fantwin.schemas.header import Header
from fantwin.schemas.messages import PushedSamples, Raw
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.acquisition import STAGE
from tests.support.running_acquisition import push_config

S = NS_PER_S


def make_core(folder: Path, **tray: object) -> AcquisitionCore:
    """A core of two fans whose samples are pushed."""
    config = push_config("tcp/127.0.0.1:7447", folder, **tray)  # type: ignore[arg-type]
    section = config.sections["acquisition"].model_copy(update={"block_s": 0.0})
    core = STAGE.build(Context("plant", config.trays, section, Path(), Path("runs"), started_t_ns=0)).core
    assert isinstance(core, AcquisitionCore)
    return core


def pushed(client: str = "a", t_ns: tuple[int, ...] = (1, 2), **change: object) -> PushedSamples:
    samples = len(t_ns)
    values: dict[str, object] = {
        "fans": 2,
        "t_ns": np.array(t_ns, np.int64),
        "newest_t_ns": t_ns[-1] if t_ns else 0,
        "command": np.zeros((samples, 2)),
        "speed_rad_s": np.zeros((samples, 2)),
    }
    return PushedSamples(header=Header(client, 0, "tray1"), **(values | change))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({"t_ns": (2, 1)}, "time_order"),
        ({"newest_t_ns": 0}, "absurd_age"),
        ({"newest_t_ns": (1 << 63) - 1}, "absurd_age"),
        ({"fans": 1, "command": np.zeros((2, 1)), "speed_rad_s": np.zeros((2, 1))}, "wrong_fan_count"),
        ({"command": np.full((2, 2), np.inf)}, "absurd_command"),
    ],
)
def test_samples_that_cannot_be_used_are_counted_by_kind(tmp_path: Path, change: dict[str, Any], kind: str) -> None:
    core = make_core(tmp_path)
    assert core.step(pushed(**change)) == []
    counts = core.counters()
    assert (counts[kind], counts["lost_refused"], counts["refused_input"]) == (2, 2, 2)


def test_only_a_tray_whose_samples_are_pushed_reads_and_takes_them(tmp_path: Path) -> None:
    core = make_core(tmp_path, source='{ kind = "serial", port = "/dev/ttyUSB0" }')
    assert core.step(pushed()) == []
    assert core.counters()["refused_readings"] == 2
    assert core.accepts() is None
    pushes = push_config("tcp/127.0.0.1:7447", tmp_path)
    serial = push_config("tcp/127.0.0.1:7447", tmp_path, source='{ kind = "serial" }')
    assert STAGE.reads_as_configured(pushes) == ("command", "reading")
    assert STAGE.reads_as_configured(serial) == ("command",)


def test_a_lost_sample_shows_in_the_numbers(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    assert core.step(pushed(t_ns=())) == [], "it asks whether all has arrived"
    core.step(pushed(first_number=0))
    core.step(pushed(t_ns=(5, 6), first_number=4))
    assert core.counters()["lost_on_line"] == 2


def test_an_earlier_client_gets_the_tray_back_when_the_later_one_is_silent(tmp_path: Path) -> None:
    (tray,) = push_config("tcp/127.0.0.1:7447", tmp_path).trays
    core = make_core(tmp_path)
    source = core._source
    assert isinstance(source, PushSource) and tray.source.takes_pushed

    def samples_at(client: str, t_ns: int) -> int:
        return sum(
            len(raw.t_ns) if isinstance(raw, PushedSamples) else len(raw.host_receive_t_ns)
            for event in source.events(pushed(client), t_ns)
            for block in core._blocks.add(event)
            for raw in core._take(block)
            if isinstance(raw, Raw)
        )

    assert [samples_at("a", S), samples_at("b", 2 * S), samples_at("a", 3 * S)] == [2, 2, 0]
    assert "two clients push samples: a is ignored, because b came later" in source.problem(4 * S)
    assert samples_at("a", 2 * S + SILENT_NS + 1) == 2
    assert samples_at("b", 3 * S + SILENT_NS) == 0
    assert source.problem(200 * S) == ""

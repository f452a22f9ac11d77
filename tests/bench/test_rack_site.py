"""bench.detection.rack_site: a month that was interrupted goes on from its last whole day."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bench.detection import rack_site
from bench.detection.plant import START_NS
from bench.detection.rack_site import RackMonth, RackSite
from pipeline.learning.healthy_history import recorded_raws
from schemas.messages import Raw
from schemas.units import NS_PER_S

DAY_S, BLOCK_S = 60, 10


def lines(days: int) -> list[Raw]:
    """Of four fans at 2 Hz under one command: nothing is learned from them."""
    blocks = []
    for first_s in range(0, days * DAY_S, BLOCK_S):
        number = 2 * first_s + np.arange(2 * BLOCK_S)
        blocks.append(
            Raw(
                fans=4,
                host_receive_t_ns=START_NS + number * NS_PER_S // 2,
                device_clock_us=(number * 500_000).astype(np.uint32),
                device_sequence=number.astype(np.uint32),
                command=np.full((len(number), 4), 0.5),
                speed_rad_s=np.full((len(number), 4), 100.0),
            )
        )
    return blocks


def test_an_interrupted_month_goes_on_from_its_last_whole_day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rack_site, "DAY_NS", DAY_S * NS_PER_S)
    whole = lines(3)
    first = RackSite(tmp_path, "rack1", ())
    with pytest.raises(InterruptedError):
        first.live(_interrupted(whole[: round(2.5 * DAY_S / BLOCK_S)]), tmp_path)
    assert RackMonth.read(tmp_path / "rack1.json").days == 2
    RackSite(tmp_path, "rack1", ()).live(whole, tmp_path)
    month = RackMonth.read(tmp_path / "rack1.json")
    assert month.days == 3
    assert sorted(month.in_force) == [0, 1, 2]
    learned = tmp_path / "rack1" / "runs" / "learned" / "rack1"
    times_s = np.concatenate([(raw.host_receive_t_ns - START_NS) / NS_PER_S for raw in recorded_raws(learned)])
    assert (np.diff(times_s) > 0.0).all(), "no line was taken twice"
    assert times_s[-1] == pytest.approx(2 * DAY_S, abs=BLOCK_S)


def _interrupted(blocks: list[Raw]) -> Iterator[Raw]:
    yield from blocks
    raise InterruptedError

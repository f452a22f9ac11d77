"""bench.fleet.page_load: every alarm that is published arrives at every page, and the gateway's cost is seen."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.fleet.page_load import load_of


@pytest.mark.slow
def test_every_alarm_arrives_at_every_page(tmp_path: Path) -> None:
    load = load_of(3, 70, 2, 10.0, 0.1, tmp_path)
    assert load["alarms lost"] == 0 and load["missed"] == 0
    assert load["% of a core"] > 0.0 and load["peak, MB"] > 10.0 and load["MB/s"] > 0.0
    assert 0.0 < load["median, ms"] <= load["p99, ms"] <= load["max, ms"]

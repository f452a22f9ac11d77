"""bench.detection.faulty: which fans have a fault in which run."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from bench.detection import faulty
from bench.detection.plant import START_NS, TRAY_FANS
from bench.detection.simulated import Fleet
from simulation.plant import tray_of_fans


def test_a_fifth_of_the_fans_of_a_run_has_a_fault_and_every_kind_is_equally_frequent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fans = 2 * TRAY_FANS
    monkeypatch.setattr(Fleet, "sigmas", lambda _: (np.full(fans, 4.0), np.full(fans, 0.02)))
    shown = faulty.campaign(Fleet(tray_of_fans(fans, 11), ()), 3, 60.0, 7)
    assert len(shown.events) == len(shown.cells) == 3 * fans
    of_runs = Counter(event.run for event in shown.events)
    assert len(of_runs) == 2 * 3 * faulty.FAULTY_ONE_IN  # trays times runs
    assert set(of_runs.values()) == {TRAY_FANS // faulty.FAULTY_ONE_IN}
    assert set(Counter((event.run, event.fan) for event in shown.events).values()) == {1}
    assert {count for _, count in Counter(event.fan for event in shown.events).items()} == {6}
    counts = Counter(shown.cells)
    assert set(counts) == set(faulty.cells())
    assert max(counts.values()) - min(counts.values()) <= 1
    begins_s = [(event.start_ns - START_NS) / 1e9 for event in shown.events]
    assert 60.0 <= min(begins_s) <= max(begins_s) <= 60.0 + faulty.ONSET_WITHIN_S
    assert [cell.kind.name for cell in shown.cells] == [event.kind for event in shown.events]

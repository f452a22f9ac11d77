"""`fantwin view`: a recording looks as the live view did."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.support.drawn_views import chunks_of, rows_of
from tests.support.recorded_views import live_view, recorded_view

pytest.importorskip("rerun")


def parts_of(path: Path) -> dict[str, set[str]]:
    """Entity -> its components and timelines."""
    parts: dict[str, set[str]] = {}
    for chunk in chunks_of(path):
        names = [n for n in chunk.to_record_batch().schema.names if ":" in n or n in ("time", "day")]
        parts.setdefault(chunk.entity_path, set()).update(names)
    return {entity: names for entity, names in parts.items() if not entity.startswith("/__")}


def test_a_recording_has_the_entities_and_components_of_the_live_view_and_the_same_samples(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    live, recorded = live_view(tmp_path), recorded_view(tmp_path)
    document = json.loads(capsys.readouterr().out)
    assert document["fans"] == 3 and document["damage"] == []
    parts = parts_of(recorded)
    assert parts == parts_of(live)
    shown = ("/tray1/fan_2/speed", "/tray1/fan_2/deviation", "/tray1/balance/page_0", "/tray1/score/page_0")
    for entity in (*shown, "/tray1/temperature_c/fan_0", "/tray1/state/fan_2", "/tray1/log", "/site/alarms"):
        assert "time" in parts[entity], entity
    assert parts["/wear/tray1/fan_2"] == {"day", "Measurements:values", "Measurements:variances"} | {
        f"Measurements:{name}" for name in ("names", "colors", "widths")
    }
    for entity in shown:
        np.testing.assert_array_equal(samples(recorded, entity), samples(live, entity))


def samples(path: Path, entity: str) -> np.ndarray:
    """Times and values of an entity, without what depends on the flushes: the ends of the band, and rows of NaN."""
    rows = rows_of(path)[entity]
    component = next(name for name in rows[0][1] if name.endswith((":values", ":scalars")))
    count = 2 if entity.endswith("/speed") else None
    of_entity = np.array([[t_ns, *row[component][:count]] for t_ns, row in rows], float)
    return of_entity[np.isfinite(of_entity[:, 1:]).any(axis=1)]

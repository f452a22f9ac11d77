"""`fantwin view`: a recording looks as the live view did."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.cli.recordings.view import view
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.topics import tray_key
from tests.support.drawn_views import chunks_of, rows_of
from tests.support.recorded_views import live_view, recorded_view, recording
from tests.support.score_data import START_NS, made_up_tray

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


def test_an_existing_view_is_kept_and_a_recording_without_scores_is_one_line(tmp_path: Path) -> None:
    path = recording(tmp_path)
    (tmp_path / "kept.rrd").write_bytes(b"kept")
    with pytest.raises(UserError, match="exists; name another file with -o, or use --force"):
        view([path], tmp_path / "kept.rrd")
    assert (tmp_path / "kept.rrd").read_bytes() == b"kept"
    with RecordingWriter(tmp_path / "none.mcap", {"site": "site"}, {}) as writer:
        writer.add_message(tray_key("site", "tray1", "alarm"), made_up_tray(seconds=10)[1][0], START_NS)
    with pytest.raises(UserError, match="holds no scores to show"):
        view([writer.path], tmp_path / "new.rrd")
    assert not (tmp_path / "new.rrd").exists()
